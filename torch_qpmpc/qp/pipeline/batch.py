"""A batch of QPs (eq:qp2, eq:qp3), and what condensing leaves of it, from step to step.

Plain tensors or arrays, without anything that autograd looks on.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from torch_qpmpc.qp.batching import broadcast, flatten
from torch_qpmpc.qp.kernels import per_sample, per_theta
from torch_qpmpc.qp.program import NDIMS, Sizes, crossed
from torch_qpmpc.qp.twofold import Twofold

T = TypeVar("T")


class ContentMemo(threading.local):
    """The latest results of a function of tensors, found again by the *content* of the tensors.

    No in-place update, copied module or functional call can make such a result stale. The tensors
    of a call are of one dtype, on one device.
    """

    SIZE = 4

    def __init__(self) -> None:
        self.entries: list[tuple[list[np.ndarray], Any, Any]] = []

    def get(self, tensors: Sequence[Tensor], options: Any, make: Callable[..., T]) -> T:
        """What ``make`` returned for equal tensors and ``options``, or returns now.

        It gets them as arrays of their own, so that its result may contain them.
        """
        arrays = per_sample.arrays(*tensors)
        kind = (options, arrays[0].dtype, tensors[0].device, [x.shape for x in arrays])
        for position, (known, of_kind, result) in enumerate(self.entries):
            if of_kind == kind and all(map(per_sample.are_equal, known, arrays)):
                self.entries.insert(0, self.entries.pop(position))
                return result
        own = [x.copy() for x in arrays]
        result = make(*own)
        self.entries.insert(0, (own, kind, result))
        del self.entries[self.SIZE :]
        return result


_memo = ContentMemo()
#: The group of a single QP.
_ONE = np.zeros(1, np.int64)


class ProgramArrays(NamedTuple):
    """`FlatPrograms` but for group and fixed, as NumPy arrays."""

    H: np.ndarray
    C: np.ndarray
    G: np.ndarray
    q: np.ndarray
    c: np.ndarray
    b: np.ndarray
    lb: np.ndarray
    ub: np.ndarray
    w: np.ndarray


@dataclass(frozen=True, eq=False)
class FlatPrograms(Twofold[ProgramArrays]):
    """A batch of B QPs over M distinct matrix triples, float64 on one device.

    H ``(M, n_z, n_z)``, C ``(M, n_c, n_z)``, G ``(M, n_g, n_z)``; ``group`` ``(B,)`` says which
    triple a QP has; q ``(B, n_z)``, c ``(B,)``, b ``(B, n_c)``, lb, ub, w ``(B, n_g)``, fixed
    ``(B, n_f)``. A vector that the batch shares has one row (q, c, b, lb, ub, w, not fixed). H is
    symmetric: its antisymmetric part, if any, is no part of the cost.
    """

    Arrays = ProgramArrays

    H: Tensor
    C: Tensor
    G: Tensor
    group: Tensor
    q: Tensor
    c: Tensor
    b: Tensor
    lb: Tensor
    ub: Tensor
    w: Tensor
    fixed: Tensor
    # What follows from all but `fixed`; those that differ in nothing else share it.
    _known: dict[Any, Any] = field(default_factory=dict)

    @classmethod
    def of(
        cls, *operands: Tensor, device: torch.device | str = "cpu"
    ) -> tuple[FlatPrograms, torch.Size]:
        """Broadcast H, q, c, C, b, G, lb, ub, w, fixed of any batch shapes, and flatten.

        Also returns the batch shape. Matrices are not repeated for the samples that share them.
        What was worked out for the same theta is found again where the batch shares all of it.
        """
        *theta, fixed = operands
        if any(t.ndim > n for t, n in zip(theta, NDIMS, strict=True)):
            batch = broadcast(Sizes.of(theta).batch_shape, fixed.shape[:-1])
            fixed = flatten(fixed, batch, device)
            return cls._flat([tensor.detach() for tensor in theta], batch, fixed), batch
        batch = fixed.shape[:-1]
        fixed = flatten(fixed, batch, device)
        programs = _memo.get(theta, str(device), lambda *own: cls._shared(own, fixed))
        return programs._with(_one_group(len(fixed), fixed.device), fixed), batch

    @classmethod
    def _shared(cls, theta: Sequence[np.ndarray], fixed: Tensor) -> FlatPrograms:
        """What all QPs of this theta share, for `_with`, on the device of ``fixed``."""
        device = fixed.device
        H, q, c, C, b, G, lb, ub, w = (x[np.newaxis] for x in theta)
        arrays = ProgramArrays(H, C, G, q, c, b, lb, ub, w)
        inspected = _Inspected.of(arrays, _ONE, device) if H.dtype == np.float64 else None
        if inspected is not None and inspected.regular:
            known = {"inspected": inspected}
            made = cls.of_arrays(arrays, device, _known=known)
            if device.type != "cpu":  # moved once, for all that share theta
                made.all_tensors()
            return made
        given = (x.unsqueeze(0) for x in _prepared(per_sample.tensors(theta, device), fixed))
        H, q, c, C, b, G, lb, ub, w = given
        return cls(H, C, G, _one_group(1, device), q, c, b, lb, ub, w, fixed[:1])

    @classmethod
    def _flat(cls, theta: Sequence[Tensor], batch: torch.Size, fixed: Tensor) -> FlatPrograms:
        H, q, c, C, b, G, lb, ub, w = _prepared(theta, fixed)
        matrices = (H, C, G)
        of_matrices = broadcast(*(m.shape[:-2] for m in matrices))
        count = of_matrices.numel()
        H, C, G = (
            m.expand(*of_matrices, *m.shape[-2:]).reshape(count, *m.shape[-2:]) for m in matrices
        )
        group = torch.arange(count, device=H.device).reshape(of_matrices).expand(batch).reshape(-1)
        q, c, b, lb, ub, w = (
            v.reshape(1, -1) if v.numel() == v.shape[-1] else flatten(v, batch, v.device)
            for v in (q, c.unsqueeze(-1), b, lb, ub, w)
        )
        return cls(H, C, G, group, q, c.squeeze(-1), b, lb, ub, w, fixed)

    def __len__(self) -> int:
        return self.group.shape[0]

    def known(self, name: Any, make: Callable[[], T]) -> T:
        """What ``make()`` works out from all but ``fixed``, once; ``name`` names it."""
        if name not in self._known:
            self._known[name] = make()
        return self._known[name]

    def take(self, index: Tensor) -> FlatPrograms:
        """The QPs at ``index``, with the matrices as they are."""
        group, fixed = self.group[index], self.fixed[index]
        if self.share_theta:
            return self._with(group, fixed)
        vectors = (self.q, self.c, self.b, self.lb, self.ub, self.w)
        q, c, b, lb, ub, w = (v if len(v) == 1 else v[index] for v in vectors)
        return FlatPrograms(self.H, self.C, self.G, group, q, c, b, lb, ub, w, fixed)

    def compacted(self) -> FlatPrograms:
        """The same QPs with no matrices but their own, and nothing known of them."""
        used, group = self.group.unique(return_inverse=True)
        H, C, G = self.H[used], self.C[used], self.G[used]
        return replace(self, H=H, C=C, G=G, group=group, _known={})

    @cached_property
    def share_theta(self) -> bool:
        """Whether they differ in nothing but their fixed entries."""
        return all(len(x) == 1 for x in self.arrays)

    def _with(self, group: Tensor, fixed: Tensor) -> FlatPrograms:
        """QPs of the same theta, which share what is known of it."""
        others = object.__new__(FlatPrograms)
        own = vars(others)
        own.update(vars(self), group=group, fixed=fixed)
        for name in ("group_array", "fixed_array"):
            own.pop(name, None)
        return others

    def without_nan(self) -> FlatPrograms:
        """The same, with zeros for NaN and inf in matrices whose QPs are not going to be solved."""
        finite = {name: getattr(self, name).nan_to_num(0, 0, 0) for name in ("H", "C", "G")}
        return replace(self, **finite, _known={})

    @cached_property
    def group_array(self) -> np.ndarray:
        """group for the kernels."""
        return per_sample.arrays(self.group)[0]

    @cached_property
    def fixed_array(self) -> np.ndarray:
        """fixed for the kernels."""
        return per_sample.arrays(self.fixed)[0]

    def valid(self) -> Tensor | None:
        """Which QPs have finite data and lb <= ub, ``(B,)``, or None if all do."""
        valid, fixed = self._inspected.valid, self.fixed
        # A sum is finite if its terms are (but for overflow, which no solver survives either).
        if per_sample.is_finite(self.fixed_array) if fixed.is_cpu else fixed.sum().isfinite():
            return valid
        finite = fixed.sum(-1).isfinite()
        return finite if valid is None else valid & finite

    @property
    def _inspected(self) -> _Inspected:
        return self.known(
            "inspected", lambda: _Inspected.of(self.arrays, self.group_array, self.device)
        )

    def times_H(self, z: Tensor) -> Tensor:
        """H z, ``(B, n_z)``."""
        return self._times("H", z)

    def times_G(self, z: Tensor, *, transposed: bool = False) -> Tensor:
        """G z ``(B, n_g)``, or G'lam ``(B, n_z)``."""
        return self._times("G", z, transposed)

    def _times(self, name: str, vectors: Tensor, transposed: bool = False) -> Tensor:
        matrices, diagonal = getattr(self, name), self.diagonal(name)
        if diagonal is not None:
            return vectors * diagonal
        return self.multiply(matrices, vectors, transposed=transposed)

    def diagonal(self, name: str) -> Tensor | None:
        """The diagonal ``(n,)`` of H or of G where all QPs share one that has nothing else."""
        # H is often diagonal, and G the identity.
        if not self.is_diagonal(name):
            return None
        return self.known(("diagonal", name), lambda: getattr(self, name)[0].diagonal().clone())

    def is_diagonal(self, name: str) -> bool:
        """Whether there is such a diagonal."""
        return self._inspected.diagonal[name]

    def multiply(self, matrices: Tensor, vectors: Tensor, *, transposed: bool = False) -> Tensor:
        """Row-wise matrix-vector products: ``(M, i, j)`` by ``(B, j)`` to ``(B, i)``.

        Or, by the transposed matrices, ``(B, i)`` to ``(B, j)``. A vector shared by the batch,
        ``(1, j)``, gives ``(1, i)`` if the matrices are shared too.
        """
        if transposed and matrices.shape[0] == 1:
            return vectors @ matrices[0]
        return multiply(matrices.mT if transposed else matrices, self.group, vectors)

    def affine(self, matrices: Tensor, vectors: Tensor, constant: Tensor) -> Tensor:
        """`multiply`, plus ``constant`` ``(B or 1, i)``."""
        if matrices.shape[0] == 1:
            return torch.addmm(constant, vectors, matrices[0].mT)
        return self.multiply(matrices, vectors) + constant


@lru_cache(maxsize=16)
def _one_group(n: int, device: torch.device) -> Tensor:
    """``group`` of n QPs that share their matrices, made once: not to be written to."""
    return per_sample.tensors([np.zeros(n, np.int64)], device)[0]


def _prepared(theta: Sequence[Tensor], like: Tensor) -> tuple[Tensor, ...]:
    """H, .., w in the dtype and on the device of ``like``.

    H is symmetric, and lb = ub where rounding alone, in the dtype that came, has them cross.
    """
    H, q, c, C, b, G, lb, ub, w = (tensor.to(like) for tensor in theta)
    swapped = theta[6] > theta[7]
    if swapped.any():
        lb = torch.where(swapped & ~crossed(*theta[6:8]), ub, lb)
    return (H + H.mT) / 2.0, q, c, C, b, G, lb, ub, w


class _Inspected(NamedTuple):
    """`FlatPrograms.valid` of all but the fixed entries, and `FlatPrograms.is_diagonal`.

    ``regular`` says of a single QP that it is valid, and H symmetric.
    """

    valid: Tensor | None
    diagonal: dict[str, bool]
    regular: bool

    @classmethod
    def of(cls, a: ProgramArrays, group: np.ndarray, device: torch.device) -> _Inspected:
        given = (a.H, a.C, a.G, group, a.q, a.c, a.b, a.lb, a.ub, a.w)
        valid, H, G, symmetric = per_theta.inspect(*given)
        some = None if valid is None else per_sample.tensors([valid], device)[0]
        return cls(some, {"H": H, "G": G}, symmetric and valid is None)


def multiply(matrices: Tensor, group: Tensor, vectors: Tensor) -> Tensor:
    """`FlatPrograms.multiply` for the matrices ``group`` of any."""
    if matrices.shape[0] == 1:
        return F.linear(vectors, matrices[0])
    vectors = vectors.expand(len(group), -1)
    return torch.bmm(matrices[group], vectors.unsqueeze(-1)).squeeze(-1)


class SoftArrays(NamedTuple):
    """`SoftQPs` as NumPy arrays."""

    H: np.ndarray
    G: np.ndarray
    group: np.ndarray
    g: np.ndarray
    l: np.ndarray  # noqa: E741 - the literature's name for the lower bound
    u: np.ndarray
    w: np.ndarray


@dataclass(frozen=True)
class SoftQPs(Twofold[SoftArrays]):
    """What a backend solves: B problems of d variables and r rows, float64 on one device,

        min over v:  1/2 v'Hv + g'v + sum_i w_i dist(G_i v, [l_i, u_i]),

    with H ``(M, d, d)``, G ``(M, r, d)``, group ``(B,)``, g ``(B, d)``, l, u, w ``(B, r)``;
    ``w_i = inf`` means a hard row. The arrays need not be contiguous.
    """

    Arrays = SoftArrays

    H: Tensor
    G: Tensor
    group: Tensor
    g: Tensor
    l: Tensor  # noqa: E741
    u: Tensor
    w: Tensor

    def take(self, index: Tensor) -> SoftQPs:
        """The problems at ``index``, with the matrices as they are."""
        vectors = (v[index] for v in (self.group, self.g, self.l, self.u, self.w))
        return SoftQPs(self.H, self.G, *vectors)
