"""Condensing: eliminate C z = b once per theta, so that a sample only moves vectors.

With y = (z[:keep], v), the kept leading entries and the independent ones among the rest, every
solution of C z = b is ``z = Y b + T y``. All samples of a batch, and V, Q and the policy, share T,
Y, T'HT and GT; fixing the first n_f <= keep entries then only changes a linear term and offsets.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from torch_qpmpc.batching import flatten

#: A pivot below this fraction of its row's norm means that the rows of C depend on each other.
RANK_TOLERANCE = 1e-10
#: A coefficient below this fraction of its row's absolute sum is rounding.
ENTERS = 1e-12
#: H is indefinite if an eigenvalue is below minus this fraction of the largest.
CONVEX = 1e-9
MEMO_SIZE = 4


@dataclass(frozen=True)
class FlatPrograms:
    """A batch of B QPs over M distinct matrix triples, float64 on one device.

    H ``(M, n_z, n_z)``, C ``(M, n_c, n_z)``, G ``(M, n_g, n_z)``; ``group`` ``(B,)`` says which
    triple a QP has; q ``(B, n_z)``, c ``(B,)``, b ``(B, n_c)``, lb, ub, w ``(B, n_g)``, fixed
    ``(B, n_f)``. A vector that the batch shares has one row (q, c, b, lb, ub, w, not fixed). H is
    symmetric: its antisymmetric part, if any, is no part of the cost.
    """

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

    @classmethod
    def of(cls, *operands: Tensor) -> tuple[FlatPrograms, torch.Size]:
        """Broadcast H, q, c, C, b, G, lb, ub, w, fixed of any batch shapes, and flatten.

        Also returns the batch shape. Matrices are not repeated for the samples that share them.
        """
        H, q, c, C, b, G, lb, ub, w, fixed = (
            operand.detach().to("cpu", torch.float64) for operand in operands
        )
        matrices = ((H + H.mT) / 2, C, G)
        vectors = (q, c.unsqueeze(-1), b, lb, ub, w, fixed)
        of_matrices = torch.broadcast_shapes(*(m.shape[:-2] for m in matrices))
        batch = torch.broadcast_shapes(of_matrices, *(v.shape[:-1] for v in vectors))
        count = of_matrices.numel()
        flat_matrices = [
            m.expand(*of_matrices, *m.shape[-2:]).reshape(count, *m.shape[-2:]) for m in matrices
        ]
        group = torch.arange(count).reshape(of_matrices).expand(batch).reshape(-1)
        q, c, b, lb, ub, w = (_flat(v, batch) for v in vectors[:-1])
        fixed = flatten(vectors[-1], batch)
        H, C, G = flat_matrices
        return cls(H, C, G, group, q, c.squeeze(-1), b, lb, ub, w, fixed), batch

    def __len__(self) -> int:
        return len(self.group)

    def take(self, index: Tensor) -> FlatPrograms:
        """The QPs at ``index``, with the matrices as they are."""
        shared = (self.q, self.c, self.b, self.lb, self.ub, self.w)
        q, c, b, lb, ub, w = (v if len(v) == 1 else v[index] for v in shared)
        group, fixed = self.group[index], self.fixed[index]
        return FlatPrograms(self.H, self.C, self.G, group, q, c, b, lb, ub, w, fixed)

    def without_nan(self) -> FlatPrograms:
        """The same, with zeros for NaN and inf in matrices whose QPs are not going to be solved."""
        finite = {name: getattr(self, name).nan_to_num(0, 0, 0) for name in ("H", "C", "G")}
        return replace(self, **finite)

    def multiply(self, matrices: Tensor, vectors: Tensor) -> Tensor:
        """Row-wise matrix-vector products: ``(M, i, j)`` by ``(B, j)`` to ``(B, i)``.

        A vector shared by the batch, ``(1, j)``, gives ``(1, i)`` if the matrices are shared too.
        """
        if matrices.shape[0] == 1:
            return vectors @ matrices[0].mT
        vectors = vectors.expand(len(self.group), -1)
        return torch.bmm(matrices[self.group], vectors.unsqueeze(-1)).squeeze(-1)


@dataclass(frozen=True)
class SoftQPs:
    """What a backend solves, as NumPy arrays: B problems of d variables and r rows,

        min over v:  1/2 v'Hv + g'v + sum_i w_i dist(G_i v, [l_i, u_i]),

    with H ``(M, d, d)``, G ``(M, r, d)``, group ``(B,)``, g ``(B, d)``, l, u, w ``(B, r)``;
    ``w_i = inf`` means a hard row.
    """

    H: np.ndarray
    G: np.ndarray
    group: np.ndarray
    g: np.ndarray
    l: np.ndarray  # noqa: E741 - the literature's name for the lower bound
    u: np.ndarray
    w: np.ndarray


@dataclass(frozen=True)
class Condensed:
    """The part of condensing that depends on (H, C, G) alone.

    T ``(M, n_z, n_y)``, Y ``(M, n_z, n_c)``, H = T'HT ``(M, n_y, n_y)``, G = GT ``(M, n_g, n_y)``,
    and what b contributes: H_b = T'HY ``(M, n_y, n_c)``, G_b = GY ``(M, n_g, n_c)``.
    Where the columns after ``keep`` do not have full row rank, ``deficient`` says so: then it is
    valid only for QPs that fix exactly ``keep`` entries.
    """

    keep: int
    deficient: bool
    T: Tensor
    Y: Tensor
    H: Tensor
    G: Tensor
    H_b: Tensor
    G_b: Tensor
    _entered: dict[int, Tensor] = field(default_factory=dict)
    _convex: dict[int, Tensor] = field(default_factory=dict)

    def soft_qps(self, programs: FlatPrograms) -> tuple[SoftQPs, Tensor]:
        """The backend's problem, and the indices of the rows of G that it contains.

        Rows that no free variable enters, and rows without a finite bound, are left out.
        """
        p, n_f = programs, programs.fixed.shape[-1]
        linear = p.multiply(self.T[:, :, n_f:].mT, p.q) + p.multiply(self.H_b[:, n_f:], p.b)
        linear = linear + p.multiply(self.H[:, n_f:, :n_f], p.fixed)
        bounded = ((p.lb > -torch.inf) | (p.ub < torch.inf)).any(dim=0)
        rows = (bounded & self._rows_entered(n_f)).nonzero().squeeze(-1)
        offset = p.multiply(self.G[:, rows, :n_f], p.fixed) + p.multiply(self.G_b[:, rows], p.b)
        return SoftQPs(
            H=self.H[:, n_f:, n_f:].numpy(),
            G=self.G[:, rows, n_f:].numpy(),
            group=p.group.numpy(),
            g=linear.numpy(),
            l=(p.lb[:, rows] - offset).numpy(),
            u=(p.ub[:, rows] - offset).numpy(),
            w=p.w[:, rows].expand(len(p), -1).numpy(),
        ), rows

    def _rows_entered(self, n_f: int) -> Tensor:
        """Which rows of G contain a variable that is free with n_f entries fixed, ``(n_g,)``."""
        if n_f not in self._entered:
            # Rounding in the elimination leaves traces of variables that a row does not contain.
            size = self.G.abs()
            trace = ENTERS * size.sum(dim=2, keepdim=True)
            self._entered[n_f] = (size[:, :, n_f:] > trace).any(dim=2).any(dim=0)
        return self._entered[n_f]

    def convex(self, n_f: int) -> Tensor:
        """Where H is positive semidefinite in what is free with n_f entries fixed, ``(M,)``."""
        if n_f not in self._convex:
            H = self.H[:, n_f:, n_f:]
            size = H.shape[-1]
            eigenvalues = torch.linalg.eigvalsh(H) if size else H.new_zeros(len(H), 1)
            self._convex[n_f] = eigenvalues[:, 0] >= -CONVEX * (1 + eigenvalues.abs().amax(-1))
        return self._convex[n_f]

    def particular(self, programs: FlatPrograms) -> Tensor:
        """z at v = 0: ``Y b`` plus what the fixed entries contribute, ``(B, n_z)``."""
        n_f = programs.fixed.shape[-1]
        from_b = programs.multiply(self.Y, programs.b)
        return from_b + programs.multiply(self.T[:, :, :n_f], programs.fixed)

    def expand(self, programs: FlatPrograms, v: Tensor) -> Tensor:
        """The full z ``(B, n_z)`` from the free variables v ``(B, d)``."""
        n_f = programs.fixed.shape[-1]
        return self.particular(programs) + programs.multiply(self.T[:, :, n_f:], v)

    def free_part(self, programs: FlatPrograms, z: Tensor) -> Tensor:
        """The free variables v ``(B, d)`` nearest to a full z; the inverse of `expand`."""
        n_f = programs.fixed.shape[-1]
        inverse = torch.linalg.pinv(self.T[:, :, n_f:])
        return programs.multiply(inverse, z - self.particular(programs))


def _flat(vectors: Tensor, batch: torch.Size) -> Tensor:
    """``(*batch, n)`` as ``(B, n)``, or ``(1, n)`` where the whole batch shares one."""
    n = vectors.shape[-1]
    if vectors.numel() == n:
        return vectors.reshape(1, n)
    return flatten(vectors, batch)


def condense(H: Tensor, C: Tensor, G: Tensor, keep: int) -> Condensed:
    """Condense M matrix triples, keeping the first ``keep`` entries of z as they are.

    The last few results are remembered by the *content* of the matrices, which no in-place
    update, copied module or functional call can make stale.
    """
    entries: list[tuple[tuple[Tensor, ...], Condensed]] = _memo.__dict__.setdefault("entries", [])
    for position, (key, condensed) in enumerate(entries):
        if condensed.keep == keep and all(
            torch.equal(old, new) for old, new in zip(key, (C, H, G), strict=True)
        ):
            entries.insert(0, entries.pop(position))
            return condensed
    eliminated = _eliminate(C, keep)
    T, Y, padding = _null_space(C, keep) if eliminated is None else (*eliminated, None)
    H_y = T.mT @ H @ T
    H_y = (H_y + H_y.mT) / 2
    if padding is not None:
        H_y = H_y + torch.diag_embed(padding)
    condensed = Condensed(keep, eliminated is None, T, Y, H_y, G @ T, T.mT @ H @ Y, G @ Y)
    entries.insert(0, ((C.clone(), H.clone(), G.clone()), condensed))
    del entries[MEMO_SIZE:]
    return condensed


def condensed_for(programs: FlatPrograms, keep: int) -> Condensed:
    """Condensed with ``keep`` entries kept, or just the fixed ones where C does not allow more."""
    H, C, G = programs.H, programs.C, programs.G
    condensed = condense(H, C, G, keep)
    n_f = programs.fixed.shape[-1]
    return condense(H, C, G, n_f) if condensed.deficient and keep > n_f else condensed


_memo = threading.local()


def _eliminate(C: Tensor, keep: int) -> tuple[Tensor, Tensor] | None:
    """T and Y with the dependent columns chosen by LU pivoting; None if rows of C depend.

    Row pivoting on the transpose of C picks columns of C that are safe to solve for: for a linear
    MPC scheme x_1..x_N, and then T is its prediction form.
    """
    M, n_c, n_z = C.shape
    rest = C[:, :, keep:]
    if n_c > rest.shape[-1]:
        return None
    permutation, _, upper = torch.linalg.lu(rest.mT)
    pivots = upper.diagonal(dim1=-2, dim2=-1).abs()
    if (pivots <= RANK_TOLERANCE * torch.linalg.vector_norm(rest, dim=-1)).any():
        return None
    # Which row of the permutation's column has the one; argmax refuses an empty dimension.
    order = permutation.mT.nonzero()[:, -1].reshape(M, n_z - keep) + keep
    dependent, independent = order[:, :n_c], order[:, n_c:].sort(dim=-1).values
    kept = torch.arange(keep, device=C.device).expand(M, keep)
    columns = torch.cat((kept, independent), dim=-1)
    pick = torch.arange(M, device=C.device).unsqueeze(-1)
    C_dependent = C.mT[pick, dependent].mT
    solved = torch.linalg.solve(
        C_dependent,
        torch.cat((torch.eye(n_c).to(C).expand(M, -1, -1), -C.mT[pick, columns].mT), dim=-1),
    )
    Y = C.new_zeros(M, n_z, n_c)
    Y[pick, dependent] = solved[:, :, :n_c]
    T = C.new_zeros(M, n_z, n_z - n_c)
    T[pick, columns] = torch.eye(n_z - n_c).to(C)
    T[pick, dependent] = solved[:, :, n_c:]
    return T, Y


def _null_space(C: Tensor, keep: int) -> tuple[Tensor, Tensor, Tensor]:
    """T and Y from the SVD, for a C of any rank, and the padding of T.

    Where ranks differ within the batch, the T of a higher rank gets zero columns; ``padding``
    ``(M, n_y)`` marks them, so that a unit curvature can pin their variables at zero. Y is then the
    pseudo-inverse: an inconsistent C z = b shows in the certificate.
    """
    M, n_c, n_z = C.shape
    n_rest = n_z - keep
    left, singular, right = torch.linalg.svd(C[:, :, keep:], full_matrices=True)
    scale = singular.amax(-1, keepdim=True) if singular.shape[-1] else singular.new_zeros(M, 1)
    significant = singular > RANK_TOLERANCE * scale
    rank = significant.sum(-1)
    lowest = int(rank.min()) if M else 0
    k = singular.shape[-1]
    inverse = torch.where(significant, 1 / singular, 0.0)
    pseudo_inverse = (right[:, :k].mT * inverse.unsqueeze(-2)) @ left[:, :, :k].mT
    padded = torch.arange(lowest, n_rest, device=C.device) < rank.unsqueeze(-1)
    basis = right[:, lowest:].mT * ~padded.unsqueeze(-2)
    identity = torch.eye(keep).to(C).expand(M, -1, -1)
    top = torch.cat((identity, C.new_zeros(M, keep, n_rest - lowest)), dim=-1)
    bottom = torch.cat((-pseudo_inverse @ C[:, :, :keep], basis), dim=-1)
    T = torch.cat((top, bottom), dim=-2)
    Y = torch.cat((C.new_zeros(M, keep, n_c), pseudo_inverse), dim=-2)
    padding = torch.cat((C.new_zeros(M, keep), padded.to(C)), dim=-1)
    return T, Y, padding
