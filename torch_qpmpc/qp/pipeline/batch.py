"""A batch of QPs as arrays (eq:qp2, eq:qp3), and their prepared theta.

Arrays are NumPy's, float64 and contiguous, without autograd, and made here, once.

Each thread caches its latest thetas by the content of their tensors, so that no in-place update,
copied module or functional call can make a result stale.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property, wraps
from typing import Any, Concatenate, ParamSpec, TypeVar

import numpy as np
import torch
from torch import Tensor

from torch_qpmpc.qp.kernels import active_set, sample
from torch_qpmpc.qp.kernels.linalg import Held, held
from torch_qpmpc.qp.pipeline import condensing
from torch_qpmpc.qp.pipeline.arrays import BackendSolution, BatchSolution, SoftQPs, Theta, per_qp
from torch_qpmpc.qp.pipeline.condensing import Condensed, Dual, Elimination, Reduced, Sizes
from torch_qpmpc.qp.pipeline.scaling import Units
from torch_qpmpc.qp.program import NDIMS, UNKNOWN, batch_shape, broadcast

P = ParamSpec("P")
T = TypeVar("T")
#: The positions of H, C and G.
MATRICES = (0, 3, 5)


def kept(make: Callable[Concatenate[Prepared, P], T]) -> Callable[Concatenate[Prepared, P], T]:
    """Keep what a function of prepared QPs returns for its other arguments."""
    name = make.__name__

    @wraps(make)
    def get(self: Prepared, *args: P.args, **kwargs: P.kwargs) -> T:
        key = name, *args
        if key not in self.known:
            self.known[key] = make(self, *args, **kwargs)
        return self.known[key]

    return get


class Prepared:
    """Theta, and the results that depend on it alone, each computed when first needed.

    ``group`` ``(B,)`` is the index of each QP's matrices among the M, zero if theta is shared. The
    elimination of C z = b, by default `condensing.eliminate`, keeps ``n_kept`` leading entries of
    z: V and Q that keep the same ones share it.
    """

    def __init__(self, theta: Theta, group: np.ndarray, n_kept: int) -> None:
        self.theta, self.group, self.n_kept = theta, group, n_kept
        self.elimination: Elimination | None = None
        self.known: dict[tuple, Any] = {}

    def __getstate__(self) -> dict[str, Any]:  # without what `held` made, which has no copy
        return vars(self) | {"known": {k: x for k, x in self.known.items() if k[0] != "held"}}

    @cached_property
    def shared(self) -> bool:
        """True if the QPs differ only in their fixed entries."""
        return all(len(x) == 1 for x in self.theta)

    @cached_property
    @np.errstate(all="ignore")
    def valid(self) -> np.ndarray | None:
        """Mask of finite data, lb <= ub and w >= 0, ``(B or 1,)``; None if all are valid."""
        H, C, G, q, c, b, lb, ub, w = self.theta
        # A sum is finite if its terms are, but for overflow, which no solver survives either.
        finite = per_qp(np.isfinite(sum(x.sum((1, 2)) for x in (H, C, G))), self.group)
        # The widths of bounds are NaN if both are the same infinity.
        valid = np.isfinite(q.sum(-1) + b.sum(-1) + c) & finite
        valid = valid & (ub - lb >= 0).all(-1) & (w >= 0).all(-1)
        return None if valid.all() else valid

    @cached_property
    def units(self) -> Units | None:
        """Units in which the QPs are solved; None if all are one."""
        return Units.of(self.theta, self.group)

    @cached_property
    def scaled(self) -> Prepared:
        """The same theta, in its `units`: it has none of its own."""
        assert self.units is not None
        scaled = Prepared(self.units.scaled(self.theta), self.units.group, self.n_kept)
        vars(scaled)["units"] = None
        return scaled

    def condensed(self, n_f: int) -> Condensed:
        """Return the QPs without C z = b, for n_f fixed entries."""
        condensed = self._condensed(self.n_kept)
        deficient = condensed.deficient and self.n_kept > n_f
        return self._condensed(n_f) if deficient else condensed

    @kept
    def _condensed(self, n_kept: int) -> Condensed:
        return condensing.condense(self.theta, n_kept, self.elimination)

    @kept
    def reduced(self, n_f: int) -> Reduced:
        """Return the QPs in their free variables."""
        return condensing.reduce(self.condensed(n_f), self.theta, self.group, n_f)

    @kept
    def convex(self, n_f: int) -> np.ndarray | None:
        """Return the mask of positive semidefinite reduced H, ``(M,)``; None if all are."""
        # Cholesky factors prove it; eigenvalues take many times as long.
        surely = np.isfinite(self.sizes(n_f).inverse).all()
        return None if surely or (mask := condensing.convex(self.reduced(n_f).H)).all() else mask

    @kept
    def growth(self, n_f: int) -> float:
        """Return the largest change of an entry of z by one of the others, by C z = b."""
        return np.abs(condensing.eliminate(self.theta.C, n_f, 0.0).T).max(initial=0.0)

    @kept
    def sizes(self, n_f: int) -> Sizes:
        """Return the `Sizes` of the reduced QPs."""
        return condensing.sizes(self.condensed(n_f), self.theta, n_f)

    @kept
    def dual(self, n_f: int, least: float | None = None) -> Dual:
        """Return the `Dual` of the reduced QPs, see `condensing.dual`."""
        _, _, H, G, *_ = self.reduced(n_f)
        return condensing.dual(H, G, least)

    @kept
    def held(self, n_f: int) -> Held:
        """Return theta, the condensed and reduced QPs, and sizes as one argument of kernels."""
        return held((self.theta, self.condensed(n_f), self.reduced(n_f), self.sizes(n_f)))

    def bounded(self, lb: np.ndarray, ub: np.ndarray) -> Prepared:
        """Return the same theta with other bounds of the rows that have some, in the same units."""
        theta = self.theta._replace(lb=lb, ub=ub)
        other = Prepared(theta, self.group, self.n_kept)
        other.elimination = self.elimination
        same = ("_condensed", "convex", "dual", "sizes")
        other.known = {key: x for key, x in self.known.items() if key[0] in same}
        vars(other)["units"] = self.units
        if self.units is not None:
            _, _, rows, _ = self.units.per_qp(self.units.group)
            vars(other)["scaled"] = self.scaled.bounded(lb / rows, ub / rows)
        return other

    def part(self, group: np.ndarray, index: np.ndarray) -> tuple[np.ndarray, Prepared]:
        """Return the new group and theta of the QPs at ``index``, whose matrices are ``group``."""
        used, group = np.unique(group, return_inverse=True)
        if len(used) and used[-1] - used[0] == len(used) - 1:
            used = slice(used[0], used[-1] + 1)  # without a copy
        matrices = (x if len(x) == 1 else x[used] for x in self.theta[:3])
        vectors = (x if len(x) == 1 else x[index] for x in self.theta[3:])
        return group, Prepared(Theta(*matrices, *vectors), group, self.n_kept)


#: The least number of QPs that are worth a thread.
MANY = 1024
#: The latest thetas that are kept: V and Q of an online and a target network.
LATEST = 4
_thread = threading.local()


def prepared_for(data: Sequence[np.ndarray], n_kept: int) -> Prepared:
    """Return the cached preparation of H, q, .., w, which the whole batch shares."""
    key = n_kept, data[0].dtype, *(x.shape for x in data), *(x.tobytes() for x in data)
    entries: list[tuple[tuple, Prepared]] = vars(_thread).setdefault("latest", [])
    for position, (other, prepared) in enumerate(entries):
        if other == key:
            entries.insert(0, entries.pop(position))
            return prepared
    theta = Theta.of([x[np.newaxis].copy() for x in data])  # the caller may change its own
    prepared = Prepared(theta, np.zeros(1, np.int64), n_kept)
    entries.insert(0, (key, prepared))
    del entries[LATEST:]
    return prepared


@dataclass(eq=False)
class Programs:
    """B QPs: their prepared theta, and the values ``fixed`` ``(B, n_f)`` of the first entries of z.

    ``group`` ``(B,)`` is the index of each QP's matrices among the M of theta.
    """

    prepared: Prepared
    group: np.ndarray
    fixed: np.ndarray

    @classmethod
    def of(cls, *operands: Tensor, n_kept: int | None = None) -> tuple[Programs, torch.Size]:
        """Return the QPs of H, q, c, C, b, G, lb, ub, w, fixed, flattened, and their batch shape.

        QPs that share matrices, or have equal ones, share one copy. The preparation of a theta that
        the whole batch shares is cached. The elimination of C z = b keeps ``n_kept`` leading
        entries of z, by default the fixed ones.
        """
        *theta, fixed = operands
        n_f = fixed.shape[-1]
        n_kept = n_f if n_kept is None else n_kept
        shared = all(x.ndim == n for x, n in zip(theta, NDIMS, strict=True))
        batch = fixed.shape[:-1]
        if not shared:
            batch = broadcast(batch, batch_shape(theta))
        fixed = np.ascontiguousarray(_flattened(fixed, batch, (n_f,)).numpy(force=True), float)
        flat = [x.numpy(force=True)[np.newaxis] for x in theta]
        group = np.zeros(len(fixed), np.int64)
        if not shared:
            flat, group = _flat_theta(theta, batch)
        if all(len(x) == 1 for x in flat):
            prepared = prepared_for([x[0] for x in flat], n_kept)
        else:
            prepared = Prepared(Theta.of(flat), group, n_kept)
        return cls(prepared, group, fixed), batch

    def __len__(self) -> int:
        return len(self.group)

    @property
    def n_f(self) -> int:
        return self.fixed.shape[-1]

    @property
    def theta(self) -> Theta:
        return self.prepared.theta

    def take(self, index: np.ndarray) -> Programs:
        """Return the QPs at ``index``."""
        prepared, group = self.prepared, self.group[index]
        if not prepared.shared:
            group, prepared = prepared.part(group, index)
        return Programs(prepared, group, self.fixed[index])

    def one(self, i: int) -> Theta:
        """Return a QP without a batch dimension, whose last equations are its fixed entries."""
        H, C, G = (x[self.group[i] % len(x)] for x in self.theta[:3])
        q, c, b, *rows = (x[i % len(x)] for x in self.theta[3:])
        C = np.vstack((C, np.eye(self.n_f, C.shape[1])))
        return Theta(H, C, G, q, c, np.concatenate((b, self.fixed[i])), *rows)

    def scaled(self) -> Programs:
        """Return the same QPs in their own units."""
        if (units := self.prepared.units) is None:
            return self
        group = self.group if len(units.group) == 1 else units.group  # of a shared theta, zeros
        _, length, *_ = units.per_qp(group)
        return Programs(self.prepared.scaled, group, self.fixed / length[:, : self.n_f])

    def solvable(self) -> np.ndarray | None:
        """Return the indices of QPs with valid data and a convex cost; None for all.

        First-order conditions certify an optimum only where the QP is convex.
        """
        programs, valid, index = self, self.valid(), None
        if valid is not None:
            index = np.flatnonzero(valid)
            programs = self.take(index)
        convex = programs.prepared.convex(programs.n_f) if len(programs) else None
        if convex is None:
            return index
        rest = np.flatnonzero(convex[programs.group])
        return rest if index is None else index[rest]

    def unsolved(self, status: np.ndarray | int) -> BatchSolution:
        """Return placeholders of ``status`` ``(B,)``: infinite costs, fixed entries, and zeros."""
        _, C, G, q, *_ = self.prepared.theta
        n, fixed = len(self), self.fixed
        z = np.zeros((n, q.shape[-1]))
        z[:, : self.n_f] = np.nan_to_num(fixed, posinf=0.0, neginf=0.0)
        return BatchSolution(
            value=np.full(n, np.inf),
            z=z,
            chi=np.zeros((n, C.shape[1])),
            lam=np.zeros((n, G.shape[1])),
            xi=np.zeros_like(fixed),
            status=np.full(n, status),
            residual=np.full(n, np.inf),
            value_error=np.full(n, np.inf),
            iterations=np.zeros(n, np.int64),
            active=np.full((n, G.shape[1]), UNKNOWN, np.int8),
        )

    def valid(self) -> np.ndarray | None:
        """Return the mask of QPs with valid data, ``(B,)``; None if all are valid."""
        valid = self.prepared.valid
        if valid is None and np.isfinite(float(self.fixed.sum())):
            return None
        finite = np.isfinite(self.fixed.sum(-1))
        return finite if valid is None else finite & valid

    def reduced_qps(self) -> SoftQPs:
        """Return the QPs for a backend, with C z = b and the fixed entries eliminated."""
        reduced = self.prepared.reduced(self.n_f)
        d, r = reduced.H.shape[-1], len(reduced.rows)
        g_l_u = sample.offsets(self.fixed, self.group, reduced.matrix, reduced.constant)
        w = reduced.w
        if len(w) != len(self.group):  # the same row for each QP, without a copy
            w = np.ndarray((len(self.group), r), buffer=w, strides=(0, w.itemsize))
        g, lower, upper = g_l_u[:, :d], g_l_u[:, d : d + r], g_l_u[:, d + r :]
        return SoftQPs(reduced.H, reduced.G, self.group, g, lower, upper, w)

    def recalled(self, active: np.ndarray) -> BatchSolution:
        """Solve the QPs from active sets ``(B, n_g)``, corrected where needed, and certify them.

        The warm start of every solver, for the whole batch at once. Codes are those of
        `QPSolution.active`; a set with any other code starts as one of a similar QP before.
        """
        dual, qps = self.prepared.dual(self.n_f), self.prepared.held(self.n_f)
        return self._in_threads(active_set.recall, (active, self.group, self.fixed), dual, qps)

    def recover(self, candidate: BackendSolution, passes: int = 0) -> BatchSolution:
        """Complete a backend's solutions of the `reduced_qps`, and certify them.

        ``passes`` iterative refinements of z and chi reduce errors of an ill-conditioned
        elimination.
        """
        rows = *candidate, self.group, self.fixed
        return self._in_threads(sample.recover, rows, self.prepared.held(self.n_f), passes)

    def _in_threads(self, kernel: Callable, rows: Sequence[np.ndarray], *qps: Any) -> BatchSolution:
        """Run a kernel; many QPs of one theta take torch's number of threads."""
        parts = len(self.group) // MANY
        if parts < 2 or not self.prepared.shared:
            return BatchSolution(*kernel(*rows, *qps))
        parts = min(torch.get_num_threads(), parts)
        with ThreadPoolExecutor(parts) as pool:
            split = (np.array_split(x, parts) for x in rows)
            found = pool.map(lambda *part: kernel(*part, *qps), *split)
            return BatchSolution._make(map(np.concatenate, zip(*found, strict=True)))


def _flattened(x: Tensor, batch: torch.Size, event: Sequence[int]) -> Tensor:
    """Broadcast ``x`` to the batch, and flatten the batch to one leading dimension."""
    if len(batch) == 1 and x.shape == (*batch, *event):
        return x
    return x.expand(*batch, *event).reshape(batch.numel(), *event)


def _flat_theta(theta: Sequence[Tensor], batch: torch.Size) -> tuple[list[np.ndarray], np.ndarray]:
    """Return theta with one leading dimension, and the group of each QP.

    What the batch shares has a leading one.
    """
    flat, matrix_batch = [], broadcast(*(theta[i].shape[:-2] for i in MATRICES))
    for x, n in zip(theta, NDIMS, strict=True):
        event = x.shape[x.ndim - n :]
        shape = torch.Size([1]) if x.numel() == event.numel() else matrix_batch if n == 2 else batch
        rows = x.reshape(event) if len(shape) == 1 == shape[0] else x
        rows = _flattened(rows, shape, event).numpy(force=True)
        same = len(rows) > 1 and (rows[-1] == rows[0]).all() and (rows == rows[0]).all()
        flat.append(rows[:1] if same else rows)
    M = matrix_batch.numel()
    if all(len(flat[i]) == 1 for i in MATRICES):
        return flat, np.zeros(batch.numel(), np.int64)
    if not M:
        flat = [x[:0] if i in MATRICES else x for i, x in enumerate(flat)]
    group = np.arange(M).reshape(matrix_batch)
    return flat, np.broadcast_to(group, batch).reshape(-1).astype(np.int64)
