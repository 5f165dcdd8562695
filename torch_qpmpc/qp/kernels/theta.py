"""The elimination of C z = b (eq:qp2c1), in loops that Numba compiles for the CPU.

It runs once per theta; LAPACK, called from Python, takes three times as long.
"""

from __future__ import annotations

import math

import numpy as np

from torch_qpmpc.qp.kernels.linalg import add_product, compiled


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
