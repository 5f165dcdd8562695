"""Condensing: eliminate C z = b once per theta, so that samples differ only in vectors.

With y = (z[:n_kept], v), the kept leading entries and the independent ones among the rest, every
solution of C z = b is ``z = z_0 + T y``. All samples of a batch, and V, Q and the policy, share T,
T'HT and GT; fixing the first n_f <= n_kept entries then only changes the linear cost and bounds.
"""

from functools import partial
from typing import NamedTuple

import numpy as np
import torch

from torch_qpmpc.qp.kernels import batched
from torch_qpmpc.qp.kernels import linalg as kernels
from torch_qpmpc.qp.pipeline.arrays import Array, Theta

#: A pivot below this fraction of its row's norm means that rows of C are linearly dependent.
RANK_TOLERANCE = 1e-10
#: Largest share of nonzero entries of a matrix that BLAS does not multiply faster.
SPARSE = 0.1
#: A coefficient up to this fraction of its row's absolute sum counts as rounding.
ENTERS = 1e-12
#: Each pivot is at least this fraction of the largest.
THRESHOLD = 0.3
#: A reduced row with a smaller fraction of its terms contains no variable at all.
ABSENT = 1e-15
#: A pivot of H below this fraction of the largest diagonal entry means that H is singular, ..
DEFINITE = 1e-11
#: .. and that this fraction of it is added for the bound of a value's error.
SHIFT = 1e-10
#: The least curvature of a proximal step, and its share of the largest one.
PROXIMAL = 1e-5
#: H is indefinite if an eigenvalue is below minus this fraction of the largest.
CONVEX = 1e-9
TINY = np.finfo(float).tiny


class Elimination(NamedTuple):
    """The null space of C, T ``(M, n_z, n_y)``, and factors of C, see `kernels.eliminate`.

    Without ``pivots``, the factors are a dense Y ``(M, n_z, n_c)`` with ``C Y b = b``.
    ``padding`` ``(M, n_y)`` marks zero columns of T, where C has a lower rank elsewhere in the
    batch; None if C has full row rank in the columns after ``n_kept``.
    """

    T: np.ndarray
    factors: np.ndarray
    pivots: np.ndarray
    padding: np.ndarray | None


class Condensed(NamedTuple):
    """The QPs' matrices in y: those of `Elimination`, T'HT and GT, with a leading M.

    If ``deficient``, the columns of C after the kept entries do not have full row rank, and the
    arrays are valid only for QPs that fix exactly these. ``enters`` ``(n_g, n_y)`` is True where a
    row of G contains a variable of y, but for rounding, relative to its ``terms`` ``(M, n_g)``
    before the elimination. ``sums`` are those of the absolute entries in the rows of H, G and C,
    and ``spans`` the `row_spans` of H, C, G, T and the factors.
    """

    T: np.ndarray
    factors: np.ndarray
    pivots: np.ndarray
    H: np.ndarray
    G: np.ndarray
    enters: np.ndarray
    terms: np.ndarray
    sums: tuple[np.ndarray, np.ndarray, np.ndarray]
    deficient: bool
    spans: tuple[np.ndarray, ...]


class Reduced(NamedTuple):
    """The QPs in v, the entries of y after the n_f fixed ones.

    A leading B is 1 where the batch shares the vector.
    """

    #: The indices of G's rows with a finite bound and a free variable, ``(r,)``, and of the rest.
    rows: Array
    others: Array
    #: ``(M, d, d)`` and ``(M, r, d)``.
    H: Array
    G: Array
    #: ``(M, n_f, d + 2 r)`` and ``(B, d + 2 r)``. The g, l and u of a sample are
    #: ``constant + matrix' fixed``.
    matrix: Array
    constant: Array
    z_0: Array  # ``(B, n_z)``, z if the fixed entries and v are zero
    w: Array  # ``(B, r)``


class Sizes(NamedTuple):
    """Sizes that bound the error of a value, see `torch_qpmpc.qp.kernels.sample`."""

    #: The inverse of the Cholesky factor of H + shift I, ``(M, d, d)``; inf if there is none.
    inverse: Array
    shift: Array  # zero for a definite H, ``(M,)``
    stiffness: Array  # a bound of H's eigenvalues, ``(M,)``
    steps: Array  # the norms of G's rows in v, ``(M, n_g)``, zero where they contain no variable
    hard: Array  # the indices of rows that are hard in some QP, ``(h,)``
    box: Array  # the index of a row that contains only v_k, for each k, ``(d,)``; -1 without one
    bounds: Array  # the same for the entries of z, ``(n_z,)``, of rows of G itself
    units: Array  # the hard rows in v, of unit length, ``(M, h, d)``


class Dual(NamedTuple):
    """The QPs in the multipliers of their rows: v is ``-inverse g - rows' lam``, and G v its rows.

    In units ``unit`` ``(M, r)`` of the rows they are ``-rows g - K lam``, and ``K = G H^-1 G'``
    ``(M, r, r)`` has a unit diagonal. ``inverse`` is that of H, ``(M, d, d)``, ``rows = G H^-1``,
    ``(M, r, d)``. To a singular H `shift` ``(M,)`` is added, which proximal steps take back.
    """

    K: Array
    unit: Array
    inverse: Array
    rows: Array
    shift: Array


@np.errstate(all="ignore")  # predictions of unstable models may overflow
def condense(theta: Theta, n_kept: int, elimination: Elimination | None = None) -> Condensed:
    """Condense M matrix triples, keeping the first ``n_kept`` entries of z."""
    T, factors, pivots, padding = elimination or eliminate(theta.C, n_kept)
    T_v = T[:, :, n_kept:]
    T_v[kernels.row_sums(np.ascontiguousarray(T_v)) < ENTERS] = 0.0  # rounding
    spans = of_H, _, of_G, of_T, _ = (*map(kernels.row_spans, (*theta[:3], T, factors)),)
    H = T.swapaxes(1, 2) @ _products(theta.H, T, of_H, of_T)
    H = (H + H.swapaxes(1, 2)) / 2
    if padding is not None:  # a unit curvature sets the variables of zero columns to zero
        H = H + padding[:, :, None] * np.eye(H.shape[1])
    G = _products(theta.G, T, of_G, of_T)
    M = max(len(H), len(G))
    H, G = (x if len(x) == M else x.repeat(M, 0) for x in (H, G))
    # Rounding leaves traces of variables that a row does not contain, and all of a row that C
    # implies: sizes are compared with those before the elimination.
    terms = kernels.products(np.abs(theta.G), np.arange(M), kernels.row_sums(T), of_G)
    enters = (np.abs(G) > ENTERS * terms[:, :, None]).any(0)
    sums = map(kernels.row_sums, (theta.H, theta.G, theta.C))
    sums = tuple(x if len(x) == M else x.repeat(M, 0) for x in sums)
    return Condensed(T, factors, pivots, H, G, enters, terms, sums, padding is not None, spans)


def _products(left: np.ndarray, right: np.ndarray, *spans: np.ndarray) -> np.ndarray:
    """Multiply ``(M, i, j)`` by ``(M, j, k)``, of these `row_spans`; an MPC's H, G are sparse."""
    if np.diff(spans[0]).sum() > SPARSE * left[:1].size:
        return left @ right
    return kernels.sparse_products(left, right, *spans)


@np.errstate(all="ignore")
def reduce(condensed: Condensed, theta: Theta, group: np.ndarray, n_f: int) -> Reduced:
    """Reduce condensed QPs to those with the first n_f entries fixed."""
    T, H, G = condensed.T, condensed.H, condensed.G
    bounded = ((theta.lb > -np.inf) | (theta.ub < np.inf)).any(0)
    entering = bounded & condensed.enters[:, n_f:].any(-1)
    rows, others = np.flatnonzero(entering), np.flatnonzero(~entering)
    H, G = H[:, n_f:], G[:, rows]
    fixed_g, fixed_y = H[:, :, :n_f].swapaxes(1, 2), -G[:, :, :n_f].swapaxes(1, 2)
    matrix = np.concatenate((fixed_g, fixed_y, fixed_y), axis=-1)
    d, r, lb, ub = H.shape[1], len(rows), theta.lb[:, rows], theta.ub[:, rows]
    of_H, _, of_G, of_T, of_C = condensed.spans
    z_0 = kernels.particular(*condensed[1:3], of_C, group, theta.b, T.shape[1])
    of_y = kernels.products(theta.G, group, z_0, of_G)[:, rows]
    slope = theta.q + kernels.products(theta.H, group, z_0, of_H)
    of_v = kernels.transposed_products(T, group, slope, of_T)[:, n_f:]
    constant = np.empty((max(map(len, (of_v, of_y, lb, ub))), d + 2 * r))
    constant[:, :d], constant[:, d : d + r], constant[:, d + r :] = of_v, lb - of_y, ub - of_y
    arrays = (H[:, :, n_f:], G[:, :, n_f:], matrix, constant, z_0, theta.w[:, rows])
    return Reduced(rows, others, *map(np.ascontiguousarray, arrays))


@np.errstate(all="ignore")
def sizes(condensed: Condensed, theta: Theta, n_f: int) -> Sizes:
    """Return the `Sizes` of QPs with the first n_f entries fixed."""
    H = np.ascontiguousarray(condensed.H[:, n_f:, n_f:])
    G = np.ascontiguousarray(condensed.G[:, :, n_f:])
    steps = np.linalg.norm(G, axis=-1)
    steps[steps <= ABSENT * condensed.terms] = 0.0
    enters = condensed.enters[:, n_f:]
    single = enters & (enters.sum(-1) == 1)[:, None]
    box = _index_of(single)
    alone = (theta.G != 0).any(0)
    bounds = _index_of(alone & (alone.sum(-1) == 1)[:, None] & (theta.G != 0).all(0))
    bounds[:n_f] = -1
    hard = np.flatnonzero(np.isinf(theta.w).any(0) & (steps > 0).any(0))
    # Contiguous whatever the indices, or the kernels would be compiled for each layout.
    units = np.ascontiguousarray(G[:, hard] / np.where(steps > 0, steps, 1.0)[:, hard, None])
    inverse, shift = inverse_factors(H)
    stiffness = kernels.row_sums(H).max(-1, initial=0.0)
    return Sizes(inverse, shift, stiffness, steps, hard, box, bounds, units)


def inverse_factors(
    H: np.ndarray, share: float = SHIFT, least: float = TINY
) -> tuple[np.ndarray, np.ndarray]:
    """Return the inverses of the Cholesky factors of H ``(M, d, d)``, and the shifts ``(M,)``.

    A singular H is shifted by this share of its largest entry, at least by ``least``. The inverse
    is inf if that has no factor either.
    """
    matrices, one = torch.from_numpy(H), torch.eye(H.shape[-1], dtype=torch.float64)
    largest = H.diagonal(axis1=1, axis2=2).max(-1, initial=0.0)
    factors, failed = torch.linalg.cholesky_ex(matrices)
    pivots = factors.numpy().diagonal(axis1=1, axis2=2).min(-1, initial=np.inf) ** 2
    singular = (failed.numpy() > 0) | ~(pivots > DEFINITE * largest)
    shift = np.where(singular, np.maximum(share * largest, least), 0.0)
    if singular.any():
        shifted = matrices + torch.from_numpy(shift)[:, None, None] * one
        factors, failed = torch.linalg.cholesky_ex(shifted)
    # LAPACK writes columns. Contiguous, or the kernels would be compiled for each layout.
    inverses = torch.linalg.solve_triangular(factors, one, upper=False).contiguous().numpy()
    inverses[failed.numpy() > 0] = np.inf
    return inverses, shift


def _index_of(rows: np.ndarray) -> np.ndarray:
    """Return the first row that is True in each column; -1 without one."""
    return np.where(rows.any(0), rows.argmax(0) if len(rows) else 0, -1)


@np.errstate(all="ignore")
def dual(H: np.ndarray, G: np.ndarray, least: float | None = None) -> Dual:
    """Return the `Dual` of reduced QPs, with ``least`` added to H, or made for proximal steps."""
    shifts = (PROXIMAL, PROXIMAL) if least is None else ()
    inverse, shift = inverse_factors(H + (least or 0.0) * np.eye(H.shape[-1]), *shifts)
    R = G @ inverse.swapaxes(1, 2)
    unit = np.linalg.norm(R, axis=-1)
    R = R / unit[:, :, None]
    return Dual(R @ R.swapaxes(1, 2), unit, inverse.swapaxes(1, 2) @ inverse, R @ inverse, shift)


def convex(H: np.ndarray) -> np.ndarray:
    """Return the mask of H ``(M, d, d)`` that are positive semidefinite up to rounding."""
    eigenvalues = np.linalg.eigvalsh(H) if H.shape[-1] else np.zeros((len(H), 1))
    return eigenvalues[:, 0] >= -CONVEX * (1 + np.abs(eigenvalues).max(-1))


@np.errstate(all="ignore")
def eliminate(C: np.ndarray, n_kept: int, threshold: float = THRESHOLD) -> Elimination:
    """Eliminate C z = b by LU, or by the SVD if rows of C ``(M, n_c, n_z)`` are dependent.

    With a ``threshold`` of zero, each equation is solved for its last entry, whatever its size. If
    the actions of an unstable model are at their bounds and its states grow, only this recursion is
    accurate in every entry.
    """
    T, *factors, regular = kernels.eliminate(C, n_kept, RANK_TOLERANCE, threshold)
    return Elimination(T, *factors, padding=None) if regular else null_space(C, n_kept)


def null_space(C: np.ndarray, n_kept: int) -> Elimination:
    """Eliminate C z = b in an orthonormal basis, from the SVD, for a C of any rank.

    This elimination is the best conditioned, though not the sparsest. The factors are the
    pseudo-inverse: the certificate rejects an inconsistent C z = b.
    """
    (M, n_c, n_z), n_rest = C.shape, C.shape[2] - n_kept
    # In torch, which uses the caller's number of threads.
    parts = batched.null_space(torch.from_numpy(C[:, :, n_kept:].copy()), RANK_TOLERANCE)
    inverse, null, rank = (x.numpy() for x in parts)
    lowest = int(rank.min(initial=n_rest)) if M else 0
    padded = np.arange(lowest, n_rest) < rank[:, None]
    T, Y = np.zeros((M, n_z, n_z - lowest)), np.zeros((M, n_z, n_c))
    T[:, :n_kept, :n_kept], Y[:, n_kept:] = np.eye(n_kept), inverse
    T[:, n_kept:, :n_kept] = -inverse @ C[:, :, :n_kept]
    T[:, n_kept:, n_kept:] = null[:, lowest:].swapaxes(1, 2)
    padding = np.concatenate((np.zeros((M, n_kept)), padded), axis=1)
    return Elimination(T, Y, np.zeros((M, 0), np.int64), padding)


#: Alternatives for QPs that no solver solves accurately after `eliminate`.
OTHER_ELIMINATIONS = null_space, partial(eliminate, threshold=0.0)
