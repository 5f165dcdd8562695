"""Condensing: eliminate C z = b once per theta, so that a sample only moves vectors.

With y = (z[:keep], v), the kept leading entries and the independent ones among the rest, every
solution of C z = b is ``z = Y b + T y``. All samples of a batch, and V, Q and the policy, share T,
Y, T'HT and GT; fixing the first n_f <= keep entries then only changes a linear term and offsets.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

#: Pivots below this fraction of the largest mean that the rows of C depend on each other.
RANK_TOLERANCE = 1e-10
#: A coefficient below this fraction of its row's absolute sum is rounding.
ENTERS = 1e-12
MEMO_SIZE = 4


@dataclass(frozen=True)
class FlatPrograms:
    """A batch of B QPs over M distinct matrix triples, float64 on one device.

    H ``(M, n_z, n_z)``, C ``(M, n_c, n_z)``, G ``(M, n_g, n_z)``; ``group`` ``(B,)`` says which
    triple a QP has; q ``(B, n_z)``, c ``(B,)``, b ``(B, n_c)``, lb, ub, w ``(B, n_g)``, fixed
    ``(B, n_f)``. H is symmetric: its antisymmetric part, if any, is no part of the cost.
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
        q, c, b, lb, ub, w, fixed = (
            v.expand(*batch, v.shape[-1]).reshape(batch.numel(), v.shape[-1]) for v in vectors
        )
        H, C, G = flat_matrices
        return cls(H, C, G, group, q, c.squeeze(-1), b, lb, ub, w, fixed), batch

    def __len__(self) -> int:
        return self.q.shape[0]

    def take(self, index: Tensor) -> FlatPrograms:
        """The QPs at ``index``, with the matrices as they are."""
        vectors = (self.group, self.q, self.c, self.b, self.lb, self.ub, self.w, self.fixed)
        return FlatPrograms(self.H, self.C, self.G, *(v[index] for v in vectors))

    def multiply(self, matrices: Tensor, vectors: Tensor) -> Tensor:
        """Row-wise matrix-vector products: ``(M, i, j)`` by ``(B, j)`` to ``(B, i)``."""
        if matrices.shape[0] == 1:
            return vectors @ matrices[0].mT
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

    T ``(M, n_z, n_y)``, Y ``(M, n_z, n_c)``, H = T'HT ``(M, n_y, n_y)``, G = GT ``(M, n_g, n_y)``.
    Where the columns after ``keep`` do not have full row rank, ``deficient`` says so: then it is
    valid only for QPs that fix exactly ``keep`` entries.
    """

    keep: int
    deficient: bool
    T: Tensor
    Y: Tensor
    H: Tensor
    G: Tensor

    def soft_qps(self, programs: FlatPrograms) -> tuple[SoftQPs, Tensor]:
        """The backend's problem, and the indices of the rows of G that it contains.

        Rows that no free variable enters, and rows without a finite bound, are left out.
        """
        n_f = programs.fixed.shape[-1]
        z_0 = self.particular(programs)
        gradient = programs.q + programs.multiply(programs.H, z_0)
        linear = programs.multiply(self.T[:, :, n_f:].mT, gradient)
        offset = programs.multiply(programs.G, z_0)
        bounded = ((programs.lb > -torch.inf) | (programs.ub < torch.inf)).any(dim=0)
        # Rounding in the elimination leaves traces of variables that a row does not contain.
        size = self.G.abs()
        trace = ENTERS * size.sum(dim=2, keepdim=True)
        entered = (size[:, :, n_f:] > trace).any(dim=2).any(dim=0)
        rows = (bounded & entered).nonzero().squeeze(-1)
        return SoftQPs(
            H=self.H[:, n_f:, n_f:].numpy(),
            G=self.G[:, rows, n_f:].numpy(),
            group=programs.group.numpy(),
            g=linear.numpy(),
            l=(programs.lb - offset)[:, rows].numpy(),
            u=(programs.ub - offset)[:, rows].numpy(),
            w=programs.w[:, rows].numpy(),
        ), rows

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
    condensed = Condensed(keep, eliminated is None, T, Y, H_y, G @ T)
    entries.insert(0, ((C.clone(), H.clone(), G.clone()), condensed))
    del entries[MEMO_SIZE:]
    return condensed


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
    if n_c and (pivots.amin(-1) <= RANK_TOLERANCE * pivots.amax(-1)).any():
        return None
    # Which row of the permutation's column has the one; argmax refuses an empty dimension.
    order = permutation.mT.nonzero()[:, -1].reshape(M, -1) + keep
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
