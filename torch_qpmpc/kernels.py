"""Loops over QPs, compiled by Numba for the CPU: what takes torch dozens of small operations.

For the QP of eq:qp2 and eq:qp3: the full solution from that of its condensed form, the certificate,
active sets tried again, which QP to solve after which, and what theta is inspected for. A torch
operation costs some microseconds whatever its size, as much as a whole QP here. On other devices
the torch forms beside the callers do the same; tests hold the two against each other.

Arrays are float64 and contiguous. Of a vector ``(B or 1, n)``, all QPs share a single row.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import numba
import numpy as np
from torch import Tensor

#: Of a product by BLAS, entries of the matrix times vectors: beyond, OpenBLAS starts threads.
SMALL = 2**18


def compiled(function: Callable[..., Any], **options: Any) -> Callable[..., Any]:
    """``function`` in machine code, kept on disk where a folder for that can be written."""
    try:
        return numba.njit(cache=True, error_model="numpy", **options)(function)
    except RuntimeError:
        return numba.njit(error_model="numpy", **options)(function)


def arrays(*tensors: Tensor) -> list[np.ndarray]:
    """The tensors of any device as a kernel takes them."""
    return [tensor.cpu().contiguous().numpy() for tensor in tensors]


@compiled
def _larger(x, y):
    """The larger one, or NaN where either is."""
    return x if x >= y or x != x else y


@compiled
def recover(
    v, lam_v, group, fixed, rows, others, T_T, Y_neg, C, C_T, H, G, G_T, diagonal, at_zero,
    q, c, b, lb, ub, w, violated,
):  # fmt: skip
    """Value, z, sigma, chi, lam, xi and residual of `solvers.chain._recover`.

    ``at_zero`` ``(B or 1, n_z)`` is z where the fixed entries and v are zero, ``T_T``, ``C_T`` and
    ``G_T`` are transposes, and ``diagonal`` says of H and G whether they have nothing else.
    """
    n_qps, n_f = fixed.shape
    kept = np.empty((n_qps, T_T.shape[1]))
    kept[:, :n_f], kept[:, n_f:] = fixed, v
    z = _products(kept, T_T, group, False)
    for i in range(n_qps):
        for j in range(z.shape[1]):
            z[i, j] += at_zero[i % len(at_zero), j]
    Hz, y = _products(z, H, group, diagonal[0]), _products(z, G_T, group, diagonal[1])
    lam = np.zeros(y.shape)
    for i in range(n_qps):
        of_lb, of_ub, of_w = i % len(lb), i % len(ub), i % len(w)
        for k in range(len(rows)):
            push, most = lam_v[i, k], w[of_w, rows[k]]
            lam[i, rows[k]] = most if push > most else -most if push < -most else push
        for j in others:
            if w[of_w, j] < np.inf:  # violated, a hard row stays so
                if y[i, j] - ub[of_ub, j] > violated:
                    lam[i, j] = w[of_w, j]
                elif lb[of_lb, j] - y[i, j] > violated:
                    lam[i, j] = -w[of_w, j]
    G_lam = _products(lam, G, group, diagonal[1])
    left = np.empty(z.shape)
    for i in range(n_qps):
        for j in range(z.shape[1]):
            left[i, j] = Hz[i, j] + q[i % len(q), j] + G_lam[i, j]
    chi = _products(left, Y_neg, group, False)
    C_chi = _products(chi, C, group, False)
    left += C_chi
    xi = -left[:, :n_f]
    left[:, :n_f] *= 0.0
    Cz = _products(z, C_T, group, False)
    value, sigma, residual = judge(
        z, Hz, G_lam, C_chi, left, y, lam, chi, Cz, fixed, q, c, b, lb, ub, w
    )
    return value, z, sigma, chi, lam, xi, residual


@compiled
def _products(vectors, matrices, group, diagonal):
    """Each QP's transposed matrix times its vector, ``(M, i, j)`` and ``(B, i)`` to ``(B, j)``."""
    products = np.zeros((len(vectors), matrices.shape[2]))
    if diagonal:
        for i in range(len(vectors)):
            for j in range(vectors.shape[1]):
                products[i, j] = vectors[i, j] * matrices[0, j, j]
    elif len(matrices) == 1:
        some = max(1, SMALL // max(1, matrices.size))
        for i in range(0, len(vectors) if matrices.size else 0, some):
            np.dot(vectors[i : i + some], matrices[0], products[i : i + some])
    else:
        for i in range(len(vectors)):
            _add_product(products[i], vectors[i], matrices[group[i]])
    return products


@compiled
def judge(z, Hz, G_lam, C_chi, left, y, lam, chi, Cz, fixed, q, c, b, lb, ub, w):
    """Value ``(B,)``, sigma ``(B, n_g)`` and residual ``(B,)`` of `certificate.certify`."""
    n_qps = len(z)
    value, residual, sigma = np.empty(n_qps), np.empty(n_qps), np.empty(y.shape)
    for i in range(n_qps):
        of_q, of_b = i % len(q), i % len(b)
        of_lb, of_ub, of_w = i % len(lb), i % len(ub), i % len(w)
        cost, slip = _cost(z, Hz, left, q, i, of_q)
        charge, gap = _charge(y, lam, lb, ub, w, sigma, i, of_lb, of_ub, of_w)
        cost, slip = cost + charge, slip + gap + _shortage(Cz, b, chi, i, of_b)
        force, slope, length = _forces(z, Hz, G_lam, C_chi, left, q, i, of_q)
        short, size = _distance(Cz, b, i, of_b)
        error = max(slope / (1.0 + force), short / (1.0 + size + length))
        error = max(error, _distance(z, fixed, i, i)[0])
        error = max(error, _excess(y, lam, lb, ub, w, i, of_lb, of_ub, of_w))
        slip /= 1.0 + abs(cost)
        worst = max(error, slip)
        value[i] = cost + c[i % len(c)]
        # A NaN of any entry is in the sums; the largest sizes know nothing of it.
        residual[i] = worst if slip < np.inf and worst < np.inf else np.inf
    return value, sigma, residual


# Four entries at a time: sums in any order, and largest sizes as if nothing were NaN.
_summing = partial(compiled, fastmath={"reassoc", "contract"})
_comparing = partial(compiled, fastmath={"nnan", "nsz"})


@_summing
def _cost(z, Hz, left, q, i, k):
    """(q + Hz / 2) z, and what stationarity left is worth."""
    cost = slip = 0.0
    for j in range(z.shape[1]):
        cost += (q[k, j] + 0.5 * Hz[i, j]) * z[i, j]
        slip += abs(left[i, j] * z[i, j])
    return cost, slip


@_summing
def _charge(y, lam, lb, ub, w, sigma, i, of_lb, of_ub, of_w):
    """w sigma and the rows' complementarity gaps; fills in sigma."""
    total = slip = 0.0
    for j in range(y.shape[1]):
        at, push, weight = y[i, j], lam[i, j], w[of_w, j]
        above, below = ub[of_ub, j], lb[of_lb, j]
        outside = at - above if at > above else below - at if at < below else 0.0
        outside = 0.0 if weight == np.inf else outside
        charge = outside * (0.0 if weight == np.inf else weight)
        # NaN is neither, and stays.
        up, down = 0.0 if push < 0 else push, 0.0 if push > 0 else push
        above, below = 0.0 if above == np.inf else above, 0.0 if below == -np.inf else below
        sigma[i, j] = outside
        total += charge
        slip += abs(charge + (above - at) * up + (below - at) * down)
    return total, slip


@_summing
def _shortage(Cz, b, chi, i, k):
    """What C z = b lacks is worth."""
    slip = 0.0
    for j in range(b.shape[1]):
        slip += abs((Cz[i, j] - b[k, j]) * chi[i, j])
    return slip


@_comparing
def _forces(z, Hz, G_lam, C_chi, left, q, i, k):
    """The largest sizes of the terms of stationarity, of what they leave, and of z."""
    force = slope = length = 0.0
    for j in range(z.shape[1]):
        costs, rows = max(abs(q[k, j]), abs(Hz[i, j])), max(abs(G_lam[i, j]), abs(C_chi[i, j]))
        force = max(force, max(costs, rows))
        slope, length = max(slope, abs(left[i, j])), max(length, abs(z[i, j]))
    return force, slope, length


@_comparing
def _distance(x, y, i, k):
    """The largest difference of x from y, and size of y."""
    difference = size = 0.0
    for j in range(y.shape[1]):
        difference, size = max(difference, abs(x[i, j] - y[k, j])), max(size, abs(y[k, j]))
    return difference, size


@_comparing
def _excess(y, lam, lb, ub, w, i, of_lb, of_ub, of_w):
    """The largest violation of a hard row, multiplier beyond w, or multiplier of no bound."""
    error = 0.0
    for j in range(y.shape[1]):
        at, push, weight = y[i, j], lam[i, j], w[of_w, j]
        above, below = ub[of_ub, j], lb[of_lb, j]
        hard = weight == np.inf
        excess = max(at - above, below - at) if hard else abs(push) - weight
        error = max(error, excess / (1.0 + (abs(at) if hard else weight)))
        error = max(error, push if above == np.inf else 0.0)
        error = max(error, -push if below == -np.inf else 0.0)
    return error


@compiled
def _add(x, factor, y):
    """x += factor y."""
    for j in range(len(x)):
        x[j] += factor * y[j]


@compiled
def _add_product(x, factors, matrix):
    """x += matrix' factors, four rows at a time: x is read and written as much less often."""
    whole = len(factors) - len(factors) % 4
    for j in range(0, whole, 4):
        f, g, h, p = factors[j], factors[j + 1], factors[j + 2], factors[j + 3]
        for k in range(len(x)):
            x[k] += (f * matrix[j, k] + g * matrix[j + 1, k]) + (
                h * matrix[j + 2, k] + p * matrix[j + 3, k]
            )
    for j in range(whole, len(factors)):
        for k in range(len(x)):
            x[k] += factors[j] * matrix[j, k]


@compiled
def condense(H, C, G, keep, independent, convex):
    """T, Y_neg, H, G, H_b and G_b of `condense.Condensed`, and what it says of them.

    That is whether all rows of C are independent of each other in the columns after ``keep``, as
    is needed for the rest, and whether all of H surely are convex.
    """
    M, n_c, n_z = C.shape
    n_y, n_g = max(0, n_z - n_c), G.shape[1]
    T, Y, regular = np.zeros((M, n_z, n_y)), np.zeros((M, n_z, n_c)), n_c <= n_z - keep
    H_y, G_y = np.empty((M, n_y, n_y)), np.empty((M, n_g, n_y))
    H_b, G_b = np.empty((M, n_y, n_c)), np.empty((M, n_g, n_c))
    surely_convex = True
    for m in range(M):
        regular = regular and _eliminate(C[m], keep, independent, T[m], Y[m])
        if regular:
            H_is_diagonal, G_is_diagonal = _is_diagonal(H[m]), _is_diagonal(G[m])
            H_T = _matrix_product(H[m], T[m], H_is_diagonal)
            T_HT = _matrix_product(T[m].T.copy(), H_T, False)
            H_y[m] = (T_HT + T_HT.T) / 2.0
            H_b[m] = _matrix_product(H_T.T.copy(), Y[m], False)
            G_y[m] = _matrix_product(G[m], T[m], G_is_diagonal)
            G_b[m] = _matrix_product(G[m], Y[m], G_is_diagonal)
            surely_convex = surely_convex and _has_factor(H_y[m], convex)
    return T, -Y, H_y, G_y, H_b, G_b, regular, surely_convex


@compiled
def _eliminate(C, keep, independent, T, Y):
    """T and Y of one C, by LU as `condense._eliminate_one`; whether there are such."""
    n_c, n_z = C.shape
    n_y, n_rest = n_z - n_c, n_z - keep
    factors, order = C[:, keep:].T.copy(), np.arange(n_z)
    for k in range(n_c):
        pivot, size = k, 0.0
        for j in range(n_rest):
            size += C[k, keep + j] ** 2
        for j in range(k + 1, n_rest):
            if abs(factors[j, k]) > abs(factors[pivot, k]):
                pivot = j
        if not abs(factors[pivot, k]) > independent * math.sqrt(size):
            return False
        if pivot != k:
            for i in range(n_c):
                factors[k, i], factors[pivot, i] = factors[pivot, i], factors[k, i]
            order[keep + k], order[keep + pivot] = order[keep + pivot], order[keep + k]
        for j in range(k + 1, n_rest):
            factors[j, k] /= factors[k, k]
            for i in range(k + 1, n_c):
                factors[j, i] -= factors[j, k] * factors[k, i]
    dependent = order[keep : keep + n_c]
    columns = np.concatenate((order[:keep], np.sort(order[keep + n_c :])))
    # The dependent columns are the transpose of the first n_c rows of L times U.
    right = np.zeros((n_c, n_z))
    for i in range(n_c):
        for j in range(n_y):
            right[i, j] = -C[i, columns[j]]
        right[i, n_y + i] = 1.0
    for i in range(n_c):
        for j in range(i):
            _add(right[i], -factors[j, i], right[j])
        right[i] /= factors[i, i]
    for i in range(n_c - 2, -1, -1):
        for j in range(i + 1, n_c):
            _add(right[i], -factors[j, i], right[j])
    for i in range(n_c):
        T[dependent[i]], Y[dependent[i]] = right[i, :n_y], right[i, n_y:]
    for j in range(n_y):
        T[columns[j], j] = 1.0
    return True


@compiled
def _matrix_product(left, right, diagonal):
    if not diagonal:
        return np.dot(left, right)
    product = np.empty(right.shape)
    for i in range(len(left)):
        for j in range(right.shape[1]):
            product[i, j] = left[i, i] * right[i, j]
    return product


@compiled
def _has_factor(H, convex):
    """`condense._has_factor`."""
    shift = 0.0
    for j in range(len(H)):
        shift = max(shift, H[j, j])
    L = H.copy()
    for j in range(len(H)):
        L[j, j] += convex * (1.0 + shift)
        for k in range(j):
            for i in range(j, len(H)):
                L[i, j] -= L[j, k] * L[i, k]
        if not L[j, j] > 0:
            return False
        L[j:, j] /= math.sqrt(L[j, j])
    return True


@compiled
def inspect(H, C, G, group, q, c, b, lb, ub, w):
    """Which QPs have finite data and lb <= ub, ``(B or 1,)``, and whether H and G are diagonal."""
    M = len(H)
    finite = np.empty(M, np.bool_)
    for m in range(M):
        finite[m] = np.isfinite(H[m].sum() + C[m].sum() + G[m].sum())
    shared = max(max(len(q), len(c), len(b)), max(len(lb), len(ub), len(w)))
    valid = np.empty(shared if M == 1 else len(group), np.bool_)
    for i in range(len(valid)):
        vectors = q[i % len(q)].sum() + b[i % len(b)].sum() + c[i % len(c)]
        good = np.isfinite(vectors) and finite[0 if M == 1 else group[i]]
        for j in range(lb.shape[1]):
            # False for NaN, as of inf - inf where both bounds are the same infinity.
            good = good and ub[i % len(ub), j] - lb[i % len(lb), j] >= 0 and w[i % len(w), j] >= 0
        valid[i] = good
    return valid, M == 1 and _is_diagonal(H[0]), M == 1 and _is_diagonal(G[0])


@compiled
def _is_diagonal(matrix):
    for i in range(matrix.shape[0]):
        for j in range(matrix.shape[1]):
            if i != j and matrix[i, j] != 0:
                return False
    return matrix.shape[0] == matrix.shape[1]


@compiled
def units(H, C, G, group, q, b, lb, ub, w, small, large):
    """cost, length, rows and equalities of `solvers.units.Units`, and whether any is not one."""
    M, n_g, n_c = len(H), G.shape[1], C.shape[1]
    of_G, of_C = np.abs(G).sum(axis=2), np.abs(C).sum(axis=2)
    of_q, of_b = _sizes(q, group, M), _sizes(b, group, M)
    of_rows, of_w = np.maximum(_sizes(lb, group, M), _sizes(ub, group, M)), _sizes(w, group, M)
    cost, length = np.empty((M, 1)), np.empty((M, 1))
    rows, equalities = np.empty((M, n_g)), np.empty((M, n_c))
    extreme = False
    for m in range(M):
        reach = np.concatenate((of_rows[m] / of_G[m], of_b[m] / of_C[m]))
        reach = np.sort(reach[(reach > 0) & (reach < np.inf)])
        long = _power_above(reach[(len(reach) - 1) // 2], small, large) if len(reach) else 1.0
        size = 0.0
        for j in range(H.shape[1]):
            size = _larger(size, of_q[m, j] * long)
            for k in range(H.shape[2]):
                size = _larger(size, abs(H[m, j, k]) * long**2)
        if not size > 0:  # a QP without any other cost
            for j in range(n_g):
                size = _larger(size, of_w[m, j] * of_G[m, j] * long)
        cost[m], length[m] = _power_above(size, small, large), long
        for j in range(n_g):
            rows[m, j] = _power_above(of_G[m, j] * long, small, large)
        for j in range(n_c):
            equalities[m, j] = _power_above(of_C[m, j] * long, small, large)
        extreme = extreme or cost[m, 0] != 1 or long != 1
        extreme = extreme or (rows[m] != 1).any() or (equalities[m] != 1).any()
    return cost, length, rows, equalities, extreme


@compiled
def _sizes(vectors, group, M):
    """The largest finite sizes ``(M, n)`` of the QPs that share their matrices."""
    largest = np.zeros((M, vectors.shape[1]))
    for i in range(max(len(vectors), M)):
        m = i if len(vectors) == 1 else group[i]
        for j in range(vectors.shape[1]):
            size = abs(vectors[i % len(vectors), j])
            if size < np.inf:  # neither is NaN
                largest[m, j] = max(largest[m, j], size)
    return largest


@compiled
def _power_above(size, small, large):
    """The power of two next above a size, or one if that is ordinary, zero or not finite."""
    if 0 < size < small or large < size < np.inf:
        return math.ldexp(1.0, math.frexp(size)[1])
    return 1.0


@compiled
def last_entered(G, G_z, T, lb, ub, enters):
    """`condense._Affine.last` of the condensed G ``(M, n_g, n_y)``, and G_z and T that it is of."""
    last = np.zeros(G.shape[1], np.int64)
    for j in range(len(last)):
        bounded = False
        for i in range(max(len(lb), len(ub))):
            bounded = bounded or lb[i % len(lb), j] > -np.inf or ub[i % len(ub), j] < np.inf
        if not bounded:
            continue
        for m in range(len(G)):
            whole = 0.0
            for k in range(G_z.shape[2]):
                if G_z[m, j, k] != 0:
                    whole += abs(G_z[m, j, k]) * np.abs(T[m, k]).sum()
            for k in range(G.shape[2] - 1, last[j] - 1, -1):
                if abs(G[m, j, k]) > enters * whole:
                    last[j] = k + 1
                    break
    return last


# Several entries at a time, in any order; a tour of NaN is as good as any.
@partial(compiled, fastmath={"reassoc", "nsz", "nnan", "contract"})
def tour(vectors, near):
    """An order of vectors ``(B, n)``: from each to the nearest of the next ``near`` that are left.

    A nearest-neighbour tour in units of the entries' standard deviations; of more than ``near``
    vectors, the next ones are those in the order of their first entry.
    """
    n_qps, n = vectors.shape
    points = np.empty((n, n_qps), np.float32)
    for k in range(n):
        mean = vectors[:, k].sum() / n_qps
        spread = math.sqrt(((vectors[:, k] - mean) ** 2).sum() / n_qps)
        points[k] = (vectors[:, k] - mean) / (spread if spread > 0 else 1.0)
    order = np.arange(n_qps)
    if n_qps > near and n:
        order = np.argsort(points[0])
        points = points[:, order].copy()
    distance = np.empty(near, np.float32)
    for at in range(n_qps - 1):
        left = min(near, n_qps - 1 - at)
        distance[:left] = 0.0
        for k in range(n):
            for j in range(left):
                distance[j] += (points[k, at + 1 + j] - points[k, at]) ** 2
        nearest = at + 1 + np.argmin(distance[:left])
        order[at + 1], order[nearest] = order[nearest], order[at + 1]
        for k in range(n):
            points[k, at + 1], points[k, nearest] = points[k, nearest], points[k, at + 1]
    return order


@compiled
def recall(free, push, group, codes, lower, upper, w, slip, max_steps, max_passes):
    """v ``(B, d)``, lam ``(B, r)``, steps and which are done ``(B,)`` of `solvers.recall.recall`.

    ``free`` ``(B, d + r)`` is (v, y) without multipliers, and ``push`` ``(M, r, d + r)`` what a
    multiplier takes from it.
    """
    n_qps, r = lower.shape
    d = free.shape[1] - r
    lam, vy, steps = np.zeros((n_qps, r)), free.copy(), np.zeros(n_qps, np.int64)
    done = np.zeros(n_qps, np.bool_)
    code, held, pull = np.empty(r, np.int8), np.empty(r, np.int64), np.empty(r)
    factor = np.empty((r, r))
    for i in range(n_qps):
        code[:] = codes[i]
        by = push[group[i]]
        known = True
        for j in range(r):
            known = known and -2 <= code[j] <= 2
        while known and not done[i] and steps[i] < max_steps:
            steps[i] += 1
            vy[i] = free[i]
            k = 0
            for j in range(r):
                lam[i, j] = 0.0
                if abs(code[j]) == 2:
                    lam[i, j] = math.copysign(w[i, j], code[j])
                    _add(vy[i], -lam[i, j], by[j])
                elif code[j] != 0:
                    held[k] = j
                    k += 1
            if not _factorise(by, held, k, d, factor):
                break
            for _ in range(max_passes):
                unmet = False
                for a in range(k):
                    j = held[a]
                    level = upper[i, j] if code[j] > 0 else lower[i, j]
                    pull[a] = vy[i, d + j] - level
                    unmet = unmet or not abs(pull[a]) <= slip * (1.0 + abs(level))
                if not unmet:
                    break
                _solve_factorised(factor, pull, k)
                for a in range(k):
                    lam[i, held[a]] += pull[a]
                    _add(vy[i], -pull[a], by[held[a]])
            done[i] = not _correct(code, lam[i], vy[i, d:], lower[i], upper[i], w[i], slip)
    return vy[:, :d].copy(), lam, steps, done


@compiled
def _factorise(by, held, k, d, factor):
    """Cholesky's upper factor of the held rows and columns of K; whether there is one."""
    for a in range(k):
        for b in range(a, k):
            factor[a, b] = by[held[a], d + held[b]]
    for a in range(k):
        if not factor[a, a] > 0:
            return False
        root = math.sqrt(factor[a, a])
        for b in range(a, k):
            factor[a, b] /= root
        # Slices of rows, to pass on, would take as long as such loops.
        for b in range(a + 1, k):
            for e in range(b, k):
                factor[b, e] -= factor[a, b] * factor[a, e]
    return True


@compiled
def _solve_factorised(factor, x, k):
    for a in range(k):
        x[a] /= factor[a, a]
        for b in range(a + 1, k):
            x[b] -= x[a] * factor[a, b]
    for a in range(k - 1, -1, -1):
        for b in range(a + 1, k):
            x[a] -= factor[a, b] * x[b]
        x[a] /= factor[a, a]


@compiled
def _correct(code, lam, y, lower, upper, w, slip):
    """Put in place the codes that lam and y ask for; whether they contradict the old ones."""
    contradicted = False
    for j in range(len(code)):
        small = slip * (1.0 + abs(y[j]))
        above, below = y[j] > upper[j] + small, y[j] < lower[j] - small
        over = abs(lam[j]) > (1.0 + slip) * w[j]
        inwards = lam[j] * code[j] < -slip * (1.0 + abs(lam[j]))
        if over or inwards or ((above or below) and abs(code[j]) < 2):
            contradicted = True
        if code[j] == 0:
            code[j] = 1 if above else -1 if below else 0
        elif abs(code[j]) == 2:
            # A saturated row that is back within its bounds is held.
            if y[j] < upper[j] - small if code[j] > 0 else y[j] > lower[j] + small:
                code[j] //= 2
        elif over:
            code[j] = 2 if lam[j] > 0 else -2
        elif inwards and lower[j] < upper[j]:
            # One whose multiplier pulls inwards is let go, unless both its bounds are one.
            code[j] = 0
    return contradicted
