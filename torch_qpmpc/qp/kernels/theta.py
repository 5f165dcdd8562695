"""Computations on theta alone, as loops that Numba compiles for the CPU.

They check theta, choose its units, and eliminate C z = b (eq:qp2c1) and the fixed entries from the
QPs (eq:qp2, eq:qp3): dozens of operations on small arrays, each of which takes microseconds in
NumPy or torch. Arrays are float64 and contiguous; a vector that the whole batch shares has one row.
"""

from __future__ import annotations

import math

import numpy as np

from torch_qpmpc.qp.kernels.linalg import (
    add_product,
    compiled,
    factorise,
    summing,
    transposed_products,
)


@compiled
def inspect(theta, group):
    """Find the QPs with finite data, lb <= ub and w >= 0, and shared diagonal matrices.

    Returns:
        The mask of QPs with valid data, ``(B or 1,)``, or None if all are valid; and two flags,
        True if all QPs share one diagonal H, and one diagonal G.
    """
    H, C, G, q, c, b, lb, ub, w = theta
    M = len(H)
    finite = np.empty(M, np.bool_)
    for m in range(M):
        finite[m] = np.isfinite(_sum(H[m]) + _sum(C[m]) + _sum(G[m]))
    shared = max(max(len(q), len(c), len(b)), max(len(lb), len(ub), len(w)))
    valid = np.empty(shared if M == 1 else len(group), np.bool_)
    for i in range(len(valid)):
        # A sum is finite if its terms are (except on overflow, which no solver survives either).
        vectors = q[i % len(q)].sum() + b[i % len(b)].sum() + c[i % len(c)]
        ok = np.isfinite(vectors) and finite[0 if M == 1 else group[i]]
        i_lb, i_ub, i_w = i % len(lb), i % len(ub), i % len(w)
        for j in range(lb.shape[1]):
            # False for NaN, such as inf - inf where both bounds are the same infinity.
            ok = ok and ub[i_ub, j] - lb[i_lb, j] >= 0 and w[i_w, j] >= 0
        valid[i] = ok
    mask = None if valid.all() else valid
    return mask, M == 1 and _is_diagonal(H[0]), M == 1 and _is_diagonal(G[0])


@summing
def _sum(matrix):
    total = 0.0
    for i in range(matrix.shape[0]):
        for j in range(matrix.shape[1]):
            total += matrix[i, j]
    return total


@compiled
def _is_diagonal(matrix):
    for i in range(matrix.shape[0]):
        for j in range(matrix.shape[1]):
            if i != j and matrix[i, j] != 0:
                return False
    return matrix.shape[0] == matrix.shape[1]


@compiled
def units(theta, group, small, large):
    """Return the fields of `torch_qpmpc.qp.pipeline.scaling.Units`, or None if all are one.

    Sizes from ``small`` to ``large`` have the unit one.
    """
    H, C, G, q, _, b, lb, ub, w = theta
    M, n_g, n_c = len(H), G.shape[1], C.shape[1]
    G_sums, C_sums = _sums(G), _sums(C)
    q_sizes, b_sizes = _sizes(q, group, M), _sizes(b, group, M)
    lb_sizes, ub_sizes, w_sizes = _sizes(lb, group, M), _sizes(ub, group, M), _sizes(w, group, M)
    cost, length = np.empty((M, 1)), np.empty((M, 1))
    rows, equalities, reach = np.empty((M, n_g)), np.empty((M, n_c)), np.empty(n_g + n_c)
    extreme = False
    for m in range(M):
        for j in range(n_g):
            reach[j] = max(lb_sizes[m, j], ub_sizes[m, j]) / G_sums[m, j]
        for j in range(n_c):
            reach[n_g + j] = b_sizes[m, j] / C_sums[m, j]
        unit = _typical(reach, small, large)
        size = 0.0
        for j in range(H.shape[1]):
            size = _larger(size, q_sizes[m, j] * unit)
            for k in range(H.shape[2]):
                size = _larger(size, abs(H[m, j, k]) * unit**2)
        if not size > 0:  # the slacks are the only cost
            for j in range(n_g):
                size = _larger(size, w_sizes[m, j] * G_sums[m, j] * unit)
        cost[m, 0], length[m, 0] = _power_above(size, small, large), unit
        extreme = extreme or cost[m, 0] != 1 or unit != 1
        for j in range(n_g):
            rows[m, j] = _power_above(G_sums[m, j] * unit, small, large)
            extreme = extreme or rows[m, j] != 1
        for j in range(n_c):
            equalities[m, j] = _power_above(C_sums[m, j] * unit, small, large)
            extreme = extreme or equalities[m, j] != 1
    return (cost, length, rows, equalities) if extreme else None


@compiled
def _larger(x, y):
    """Return the larger of two numbers, or NaN."""
    return x if x >= y or x != x else y


@compiled
def _sizes(vectors, group, M):
    """Return the largest finite absolute entries over the QPs of each matrix, ``(M, n)``."""
    largest = np.zeros((M, vectors.shape[1]))
    for i in range(max(len(vectors), M)):
        m = i if len(vectors) == 1 else group[i]
        row = i % len(vectors)
        for j in range(vectors.shape[1]):
            size = abs(vectors[row, j])
            if size < np.inf:  # false for NaN
                largest[m, j] = max(largest[m, j], size)
    return largest


@summing
def _sums(matrices):
    """Return the absolute sums of rows, ``(M, i, j)`` to ``(M, i)``."""
    sums = np.empty(matrices.shape[:2])
    for m in range(matrices.shape[0]):
        for i in range(matrices.shape[1]):
            total = 0.0
            for j in range(matrices.shape[2]):
                total += abs(matrices[m, i, j])
            sums[m, i] = total
    return sums


@compiled
def _typical(sizes, small, large):
    """Return `_power_above` of the lower median of the positive, finite sizes."""
    counts, known = np.zeros(2200, np.int64), 0
    for size in sizes:
        if 0 < size < np.inf:
            # The powers have the same order as the sizes; counting sorts them.
            counts[1100 + math.frexp(_power_above(size, small, large))[1]] += 1
            known += 1
    at, passed = 0, counts[0]
    while known and passed <= (known - 1) // 2:
        at += 1
        passed += counts[at]
    return math.ldexp(1.0, at - 1101) if known else 1.0


@compiled
def _power_above(size, small, large):
    """Return the next larger power of two, or one for an ordinary, zero or infinite size."""
    if 0 < size < small or large < size < np.inf:
        return math.ldexp(1.0, math.frexp(size)[1])
    return 1.0


@compiled
def eliminate(C, n_kept, independent):
    """Solve C z = b for some entries of z: return T and -Y with ``z = T y + Y b``.

    LU with row pivoting on the transpose of C picks columns that are safe to solve for. For a
    linear MPC scheme they are x_1..x_N, and then T is its prediction form.

    Args:
        C: ``(M, n_c, n_z)``.
        n_kept: the number of leading columns that are not solved for.
        independent: smallest pivot, relative to its row's norm, of linearly independent rows.

    Returns:
        T ``(M, n_z, n_y)``, -Y ``(M, n_z, n_c)``, and False if the rows of C are linearly
        dependent in the columns after ``n_kept``.
    """
    M, n_c, n_z = C.shape
    regular = n_c <= n_z - n_kept
    T, Y_neg = np.zeros((M, n_z, max(0, n_z - n_c))), np.zeros((M, n_z, n_c))
    for m in range(M):
        regular = regular and _eliminate(C[m], n_kept, independent, T[m], Y_neg[m])
    return T, Y_neg, regular


@compiled
def _eliminate(C, n_kept, independent, T, Y_neg):
    n_c, n_z = C.shape
    n_y, n_rest = n_z - n_c, n_z - n_kept
    factors, order, stays = np.empty((n_rest, n_c)), np.arange(n_z), np.ones(n_z, np.bool_)
    for i in range(n_c):
        for j in range(n_rest):
            factors[j, i] = C[i, n_kept + j]
    for k in range(n_c):
        pivot, size = k, 0.0
        for j in range(n_rest):
            size += C[k, n_kept + j] ** 2
        for j in range(k + 1, n_rest):
            if abs(factors[j, k]) > abs(factors[pivot, k]):
                pivot = j
        if not abs(factors[pivot, k]) > independent * math.sqrt(size):
            return False
        if pivot != k:
            for i in range(n_c):
                factors[k, i], factors[pivot, i] = factors[pivot, i], factors[k, i]
            order[n_kept + k], order[n_kept + pivot] = order[n_kept + pivot], order[n_kept + k]
        stays[order[n_kept + k]] = False
        for j in range(k + 1, n_rest):
            factors[j, k] /= factors[k, k]
            for i in range(k + 1, n_c):
                factors[j, i] -= factors[j, k] * factors[k, i]
    # The right-hand sides are -C in the remaining columns, and the identity. The system's matrix is
    # C in the dependent columns, the transpose of the first n_c rows of L times U.
    right, k = np.zeros((n_c, n_z)), 0
    for j in range(n_z):
        if stays[j]:
            T[j, k] = 1.0
            for i in range(n_c):
                right[i, k] = -C[i, j]
            k += 1
    for i in range(n_c):
        right[i, n_y + i] = 1.0
        add_product(right[i], -factors[:i, i], right)
        for j in range(n_z):
            right[i, j] /= factors[i, i]
    for i in range(n_c - 1, -1, -1):
        add_product(right[i], -factors[i + 1 : n_c, i], right[i + 1 :])
        dependent = order[n_kept + i]
        for j in range(n_y):
            T[dependent, j] = right[i, j]
        for j in range(n_c):
            Y_neg[dependent, j] = -right[i, n_y + j]
    return True


@compiled
def condense(H, G, T, Y_neg, convex):
    """Return the QPs' matrices in y, T'HT, GT, T'HY and GY, and True if all T'HT are convex.

    Eigenvalues down to minus ``convex``, relative to the largest entry, count as convex.
    """
    M, _, n_y = T.shape
    n_g, n_c = G.shape[1], Y_neg.shape[2]
    H_y, G_y = np.empty((M, n_y, n_y)), np.empty((M, n_g, n_y))
    H_b, G_b = np.empty((M, n_y, n_c)), np.empty((M, n_g, n_c))
    surely_convex = True
    for m in range(M):
        H_is_diagonal, G_is_diagonal = _is_diagonal(H[m]), _is_diagonal(G[m])
        H_T, G_y[m] = _times(H[m], T[m], H_is_diagonal), _times(G[m], T[m], G_is_diagonal)
        T_HT = np.dot(T[m].T, H_T)
        H_y[m] = (T_HT + T_HT.T) / 2.0
        H_b[m] = -np.dot(H_T.T, Y_neg[m])
        G_b[m] = -_times(G[m], Y_neg[m], G_is_diagonal)
        surely_convex = surely_convex and _has_factor(H_y[m], convex)
    return H_y, G_y, H_b, G_b, surely_convex


@compiled
def _times(left, right, diagonal):
    if not diagonal:
        return np.dot(left, right)
    product = np.empty(right.shape)
    for i in range(right.shape[0]):
        for j in range(right.shape[1]):
            product[i, j] = left[i, i] * right[i, j]
    return product


@compiled
def _has_factor(H, convex):
    """True if a Cholesky factor, which is faster than eigenvalues, proves that H is convex."""
    shift = 0.0
    for j in range(len(H)):
        shift = max(shift, H[j, j])
    L = H.copy()
    for j in range(len(H)):
        L[j, j] += convex * (1.0 + shift)
    return factorise(L)


@compiled
def forces(H, G):
    """Return the fields of `torch_qpmpc.qp.pipeline.condensing.Forces`.

    They are NaN if H has no Cholesky factor.
    """
    M, r, d = G.shape
    rise, push = np.full((M, d, d + r), np.nan), np.full((M, r, d + r), np.nan)
    for m in range(M):
        L, inverse = H[m].copy(), np.eye(d)
        if not factorise(L):
            continue
        for i in range(d):
            add_product(inverse[i], -L[i, :i], inverse)
            inverse[i] /= L[i, i]
        for i in range(d - 1, -1, -1):
            add_product(inverse[i], -L[i + 1 :, i], inverse[i + 1 :])
            inverse[i] /= L[i, i]
        y = np.dot(G[m], inverse)
        K = np.dot(y, G[m].T)
        for i in range(d):
            rise[m, i, :d] = inverse[i]
            for j in range(r):
                rise[m, i, d + j] = y[j, i]
        for j in range(r):
            push[m, j, :d] = y[j]
            push[m, j, d:] = K[j]
    return rise, push


@compiled
def reduce(condensed, theta, group, n_f, enters):
    """Return the fields of `torch_qpmpc.qp.pipeline.condensing.Reduced`, except T and Y_neg.

    Coefficients up to ``enters``, relative to their row, count as rounding.
    """
    T, Y_neg, H, G, H_b, G_b = condensed
    q, b, lb, ub, w = theta.q, theta.b, theta.lb, theta.ub, theta.w
    M, n_z, n_y = T.shape
    n_g, n_c, d = G.shape[1], b.shape[1], n_y - n_f
    last, r, s = _last_entered(G, theta.G, T, lb, ub, enters), 0, 0
    for i in range(n_g):
        r += last[i] > n_f
    rows, others, w_v = np.empty(r, np.int64), np.empty(n_g - r, np.int64), np.empty((len(w), r))
    for i in range(n_g):
        if last[i] > n_f:
            rows[i - s] = i
            for k in range(len(w)):
                w_v[k, i - s] = w[k, i]
        else:
            others[s] = i
            s += 1
    H_v, G_v, matrix = np.empty((M, d, d)), np.empty((M, r, d)), np.empty((M, n_f, d + 2 * r))
    # map_q takes q to g, and map_b takes b to g, y and z.
    map_q, map_b = np.empty((M, n_z, d)), np.empty((M, n_c, d + r + n_z))
    for m in range(M):
        for i in range(d):
            for j in range(d):
                H_v[m, i, j] = H[m, n_f + i, n_f + j]
            for j in range(n_f):
                matrix[m, j, i] = H[m, n_f + i, j]
            for j in range(n_c):
                map_b[m, j, i] = H_b[m, n_f + i, j]
        for i in range(r):
            for j in range(d):
                G_v[m, i, j] = G[m, rows[i], n_f + j]
            for j in range(n_f):
                matrix[m, j, d + i] = matrix[m, j, d + r + i] = -G[m, rows[i], j]
            for j in range(n_c):
                map_b[m, j, d + i] = G_b[m, rows[i], j]
        for i in range(n_z):
            for j in range(d):
                map_q[m, i, j] = T[m, i, n_f + j]
            for j in range(n_c):
                map_b[m, j, d + r + i] = -Y_neg[m, i, j]
    count = max(max(len(q), len(b)), max(len(lb), len(ub)))
    if M != 1:
        count = len(group)
        q, b = _repeated(q, count), _repeated(b, count)
    mapped_q = transposed_products(map_q, group, q, False)
    mapped_b = transposed_products(map_b, group, b, False)
    constant, z_0 = np.empty((count, d + 2 * r)), np.empty((len(b), n_z))
    for k in range(count):
        k_q, k_b, k_lb, k_ub = k % len(q), k % len(b), k % len(lb), k % len(ub)
        for i in range(d):
            constant[k, i] = mapped_q[k_q, i] + mapped_b[k_b, i]
        for i in range(r):
            y = mapped_b[k_b, d + i]
            constant[k, d + i] = lb[k_lb, rows[i]] - y
            constant[k, d + r + i] = ub[k_ub, rows[i]] - y
    for k in range(len(b)):
        for i in range(n_z):
            z_0[k, i] = mapped_b[k, d + r + i]
    return rows, others, H_v, G_v, matrix, constant, z_0, w_v


@compiled
def _repeated(vectors, count):
    """Return the vectors ``(count, n)``, a shared one repeated for each QP."""
    repeated = np.empty((count, vectors.shape[1]))
    for i in range(count):
        repeated[i] = vectors[i % len(vectors)]
    return repeated


@compiled
def _last_entered(G, G_z, T, lb, ub, enters):
    """Return one plus the index of the last variable in each row of G ``(M, n_g, n_y)``.

    It is zero for a row without a finite bound. The elimination leaves rounding errors on variables
    that a row does not contain, and only those in a row that C implies: coefficients are compared
    with the row's size before the elimination, from G_z and T.
    """
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
