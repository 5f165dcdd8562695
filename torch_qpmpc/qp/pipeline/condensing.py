"""Condensing: eliminate C z = b once per theta, so that a sample only moves vectors.

With y = (z[:keep], v), the kept leading entries and the independent ones among the rest, every
solution of C z = b is ``z = Y b + T y``. All samples of a batch, and V, Q and the policy, share T,
Y, T'HT and GT; fixing the first n_f <= keep entries then only changes a linear term and offsets.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from scipy.linalg import get_lapack_funcs
from torch import Tensor

from torch_qpmpc.qp.kernels import per_sample, per_theta
from torch_qpmpc.qp.pipeline.batch import ContentMemo, FlatPrograms, SoftArrays, SoftQPs
from torch_qpmpc.qp.twofold import Twofold

#: A pivot below this fraction of its row's norm means that the rows of C depend on each other.
RANK_TOLERANCE = 1e-10
#: A pivot of at least this fraction of the largest serves as well, in the order of equations.
THRESHOLD = 1e-2
#: A coefficient below this fraction of its row's absolute sum is rounding.
ENTERS = 1e-12
#: A row that no free variable enters is violated from here on.
VIOLATED = 1e-9
#: H is indefinite if an eigenvalue is below minus this fraction of the largest.
CONVEX = 1e-9
#: Entries of a matrix up to which one kernel does it all; for larger ones BLAS would start threads.
SMALL = 2**12

_getrf, _getrs, _potrf = get_lapack_funcs(("getrf", "getrs", "potrf"), dtype=np.float64)


class CondensedArrays(NamedTuple):
    """Those of `Condensed` for the kernels."""

    T: np.ndarray
    Y_neg: np.ndarray
    H: np.ndarray
    G: np.ndarray
    H_b: np.ndarray
    G_b: np.ndarray


@dataclass(frozen=True, eq=False)
class Condensed(Twofold[CondensedArrays]):
    """The part of condensing that depends on (H, C, G) alone.

    T ``(M, n_z, n_y)``, Y_neg = -Y ``(M, n_z, n_c)``, H = T'HT ``(M, n_y, n_y)``, G = GT
    ``(M, n_g, n_y)``, and what b contributes: H_b = T'HY ``(M, n_y, n_c)``, G_b = GY
    ``(M, n_g, n_c)``. ``surely_convex`` says that all of H is, so that no part of it need be looked
    at. Where the columns after ``keep`` do not have full row rank, ``deficient`` says so: then it
    is valid only for QPs that fix exactly ``keep`` entries.
    """

    Arrays = CondensedArrays

    keep: int
    deficient: bool
    T: Tensor
    Y_neg: Tensor
    H: Tensor
    G: Tensor
    H_b: Tensor
    G_b: Tensor
    surely_convex: bool

    def reduced(self, programs: FlatPrograms) -> Reduced:
        """The problem in what is free of ``programs``."""
        n_f = programs.fixed.shape[-1]
        return programs.known(("reduced", self.keep, n_f), lambda: Reduced.of(self, programs, n_f))


class ReducedArrays(NamedTuple):
    """Those of `Reduced` for the kernels, in the order of `per_theta.reduce`."""

    rows: np.ndarray
    others: np.ndarray
    H: np.ndarray
    G: np.ndarray
    matrix: np.ndarray
    constant: np.ndarray
    z_0: np.ndarray
    w: np.ndarray
    T: np.ndarray
    Y_neg: np.ndarray


@dataclass(frozen=True, eq=False)
class Reduced(Twofold[ReducedArrays]):
    """The condensed problem with the first n_f entries fixed, in v, the rest of y.

    Of the rows of G, ``rows`` are its own, and ``others`` those that no free variable enters or
    that have no finite bound. A leading B is 1 where the batch shares it.

    Attributes:
        H, G: ``(M, d, d)`` and ``(M, r, d)``.
        matrix, constant: ``(M, n_f, d + 2 r)`` and ``(B, d + 2 r)``. What a sample's fixed entries
            make of g, l and u is ``constant + matrix' fixed``.
        z_0: ``(B, n_z)``, z where the fixed entries and v are zero.
        w: ``(B, r)``.
        T, Y_neg, keep: those of `Condensed`.
        convex: where H is positive semidefinite, ``(M,)``, or None if it is everywhere.
    """

    Arrays = ReducedArrays

    rows: Tensor
    others: Tensor
    H: Tensor
    G: Tensor
    matrix: Tensor
    constant: Tensor
    z_0: Tensor
    w: Tensor
    T: Tensor
    Y_neg: Tensor
    keep: int
    convex: Tensor | None

    @classmethod
    def of(cls, condensed: Condensed, p: FlatPrograms, n_f: int) -> Reduced:
        x, a = condensed.arrays, p.arrays
        given = (*x, p.group_array, a.G, a.q, a.b, a.lb, a.ub, a.w, n_f, ENTERS)
        arrays = ReducedArrays._make((*per_theta.reduce(*given), x.T, x.Y_neg))
        convex = None
        if not condensed.surely_convex:
            convex = _convex(*per_sample.tensors([arrays.H], p.device))
        return cls.of_arrays(arrays, p.device, keep=condensed.keep, convex=convex)

    def at(self, programs: FlatPrograms) -> SoftQPs:
        """What a backend solves, with the rows ``rows``."""
        p, a = programs, self.arrays
        d, r = a.H.shape[-1], len(a.rows)
        if p.device.type != "cpu":
            moved = p.multiply(self.matrix, p.fixed, transposed=True) + self.constant
            g, lower, upper = moved.split_with_sizes((d, r, r), dim=-1)
            w = self.w.expand(len(p), -1)
            return SoftQPs(self.H, self.G, p.group, g, lower, upper, w)
        moved, w = per_sample.affine(p.fixed_array, a.matrix, p.group_array, a.constant), a.w
        if len(w) != len(p):  # for each QP the same row
            w = np.ndarray((len(p), r), buffer=w, strides=(0, w.itemsize))
        of_samples = (moved[:, :d], moved[:, d : d + r], moved[:, d + r :], w)
        return SoftQPs.of_arrays(SoftArrays(a.H, a.G, p.group_array, *of_samples), p.device)

    def expand(self, p: FlatPrograms, v: Tensor) -> Tensor:
        """The full z ``(B, n_z)`` from the free variables v ``(B, d)``."""
        return p.affine(self.T, torch.cat((p.fixed, v), dim=-1), self.z_0)

    def all_rows(self, p: FlatPrograms, lam: Tensor, y: Tensor) -> Tensor:
        """Multipliers ``(B, n_g)`` from those of ``rows``, ``(B, r)``, and y = G z ``(B, n_g)``.

        A row that no free variable enters has w where it is violated.
        """
        beyond = F.hardshrink(y - y.clamp(p.lb, p.ub), VIOLATED)
        # Violated, a hard row stays so.
        full = beyond.sign() * p.w.masked_fill(p.w.isinf(), 0.0)
        full[:, self.rows] = lam.clamp(-self.w, self.w)
        return full


def _convex(H: Tensor) -> Tensor:
    """Where H is positive semidefinite but for rounding, ``(M,)``."""
    eigenvalues = torch.linalg.eigvalsh(H) if H.shape[-1] else H.new_zeros(len(H), 1)
    return eigenvalues[:, 0] >= -CONVEX * (1 + eigenvalues.abs().amax(-1))


def _surely_convex(H: Tensor) -> bool:
    """Whether Cholesky factors prove it of all, in a fraction of the time."""
    return not H.shape[-1] or all(map(_has_factor, H.cpu().numpy()))


def _has_factor(H: np.ndarray) -> bool:
    shifted = H.copy()
    shifted.ravel()[:: len(H) + 1] += CONVEX * (1.0 + H.diagonal().max())
    return _potrf(shifted)[1] == 0


def condense(H: Tensor, C: Tensor, G: Tensor, keep: int) -> Condensed:
    """Condense M matrix triples, keeping the first ``keep`` entries of z as they are.

    The last few results are remembered by the content of the matrices.
    """
    return _memo.get((H, C, G), keep, lambda *own: _condense(own, C.device, keep))


_memo = ContentMemo()


def _condense(matrices: Sequence[np.ndarray], device: torch.device, keep: int) -> Condensed:
    if max(math.prod(x.shape[1:]) for x in matrices) <= SMALL:
        *found, regular, convex = per_theta.condense(*matrices, keep, RANK_TOLERANCE, CONVEX)
        if regular:
            found = CondensedArrays(*found)
            return Condensed.of_arrays(
                found, device, keep=keep, deficient=False, surely_convex=convex
            )
    H, C, G = per_sample.tensors(matrices, device)
    eliminated = _eliminate(C, keep)
    if eliminated is not None:
        return _products(H, G, *eliminated, keep)
    T, Y, padding = null_space(C, keep)
    return _products(H, G, T, Y, keep, padding)


def _products(
    H: Tensor, G: Tensor, T: Tensor, Y: Tensor, keep: int, padding: Tensor | None = None
) -> Condensed:
    """The condensed problem of T and Y; ``padding`` is that of `null_space`."""
    H_T = H.bmm(T)
    H_y = T.mT.bmm(H_T)
    H_y = (H_y + H_y.mT) / 2.0
    if padding is not None:
        H_y = H_y + torch.diag_embed(padding)
    deficient, convex = padding is not None, _surely_convex(H_y)
    return Condensed(keep, deficient, T, -Y, H_y, G.bmm(T), H_T.mT.bmm(Y), G.bmm(Y), convex)


def condensed_for(programs: FlatPrograms, keep: int) -> Condensed:
    """Condensed with ``keep`` entries kept, or just the fixed ones where C does not allow more."""
    p, n_f = programs, programs.fixed.shape[-1]

    def make() -> Condensed:
        if p.share_theta:  # found again by all of theta, with what is known of it
            return _condense(p.arrays[:3], p.device, keep)
        return condense(p.H, p.C, p.G, keep)

    condensed = p.known(("condensed", keep), make)
    return condensed_for(p, n_f) if condensed.deficient and keep > n_f else condensed


def other_eliminations(programs: FlatPrograms) -> Iterator[Condensed]:
    """Condense in two other ways, for what no solver makes accurate after `condensed_for`.

    In an orthonormal basis, for an unstable model that the actions stabilise: the best conditioned
    way, though not the sparsest. And in the order of the equations, each solved for variables that
    no earlier one contains, x_1..x_N of a linear MPC scheme: where actions are at their bounds and
    the states grow, only this recursion is accurate in every entry.
    """
    p, keep = programs, programs.fixed.shape[-1]
    if not p.C.shape[1]:
        return
    T, Y, padding = null_space(p.C, keep)
    yield _products(p.H, p.G, T, Y, keep, padding)
    own = [_eliminate_in_order(C, keep) for C in p.arrays.C]
    if all(own):
        T, Y = (p.H.new_tensor(np.stack(part)) for part in zip(*own, strict=True))
        condensed = _products(p.H, p.G, T, Y, keep)
        if condensed.H.isfinite().all():
            yield condensed


def _eliminate_in_order(C: np.ndarray, keep: int) -> tuple[np.ndarray, np.ndarray] | None:
    n_c, n_z = C.shape
    # Rows are C z - b = 0, with the unit for b; the columns of z that may be solved for come last.
    W = np.concatenate((C, -np.eye(n_c)), axis=1)
    nonzero = C != 0
    first = np.where(nonzero.any(0), nonzero.argmax(0), -1)
    first[:keep] = -1
    pivots = []
    for k in range(n_c):
        entries = np.where(first >= 0, np.abs(W[k, :n_z]), 0.0)
        possible = entries > RANK_TOLERANCE * np.linalg.norm(C[k])
        if not possible.any():
            return None
        newest = np.where(possible & (first == first[possible].max()), entries, 0.0)
        # In z, x_{k+1} comes after the action u_k that is as new.
        pivot = int((newest >= THRESHOLD * newest.max()).nonzero()[0][-1])
        first[pivot] = -1
        pivots.append(pivot)
        W[k] /= W[k, pivot]
        below = k + 1 + W[k + 1 :, pivot].nonzero()[0]
        W[below] -= np.outer(W[below, pivot], W[k])
    for k in range(n_c - 1, -1, -1):
        above = W[:k, pivots[k]].nonzero()[0]
        W[above] -= np.outer(W[above, pivots[k]], W[k])
    columns = np.setdiff1d(np.arange(n_z), pivots)
    T, Y = np.zeros((n_z, len(columns))), np.zeros((n_z, n_c))
    T[columns, np.arange(len(columns))] = 1.0
    T[pivots], Y[pivots] = -W[:, columns], -W[:, n_z:]
    return T, Y


def _eliminate(C: Tensor, keep: int) -> tuple[Tensor, Tensor] | None:
    """T and Y with the dependent columns chosen by LU pivoting; None if rows of C depend."""
    eliminated = [_eliminate_one(one, keep) for one in C.cpu().numpy()]
    if not all(eliminated):
        return None
    M, n_c, n_z = C.shape
    if not M:
        return C.new_zeros(M, n_z, n_z - n_c), C.new_zeros(M, n_z, n_c)
    T, Y = (np.stack(part) for part in zip(*eliminated, strict=True))
    return torch.from_numpy(T).to(C), torch.from_numpy(Y).to(C)


def _eliminate_one(C: np.ndarray, keep: int) -> tuple[np.ndarray, np.ndarray] | None:
    """Row pivoting on the transpose of C picks columns of C that are safe to solve for.

    For a linear MPC scheme they are x_1..x_N, and then T is its prediction form.
    """
    n_c, n_z = C.shape
    rest = C[:, keep:]
    if n_c > rest.shape[1]:
        return None
    order = list(range(keep, n_z))
    if n_c:
        factors, pivots, _ = _getrf(rest.T)
        norms = np.sqrt((rest * rest).sum(axis=1))
        if (np.abs(factors.diagonal()) <= RANK_TOLERANCE * norms).any():
            return None
        for i, pivot in enumerate(pivots.tolist()):
            order[i], order[pivot] = order[pivot], order[i]
    dependent, columns = order[:n_c], [*range(keep), *sorted(order[n_c:])]
    Y, T = np.zeros((n_z, n_c)), np.zeros((n_z, n_z - n_c))
    if n_c:
        right = np.concatenate((np.eye(n_c), -C[:, columns]), axis=1)
        # The dependent columns are the transpose of the first n_c rows of L times U.
        solved, _ = _getrs(factors[:n_c], np.arange(n_c), right, trans=1)
        Y[dependent], T[dependent] = solved[:, :n_c], solved[:, n_c:]
    T[columns, np.arange(n_z - n_c)] = 1
    return T, Y


def null_space(C: Tensor, keep: int) -> tuple[Tensor, Tensor, Tensor]:
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
