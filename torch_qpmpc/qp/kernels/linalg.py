"""Linear algebra as loops that Numba compiles for the CPU. Arrays are float64 and contiguous.

The second half runs once for each theta: the elimination of C z = b (eq:qp2c1), and sizes of its
entries. LAPACK and NumPy, called from Python, take several times as long.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import numba
import numpy as np
from numba.core.event import Event, Listener, register

#: Largest matrix size times number of vectors in one call of BLAS, which then uses one thread.
ONE_THREAD = 2**18
TINY = np.finfo(float).tiny


def compiled(function: Callable[..., Any], **options: Any) -> Callable[..., Any]:
    """Compile ``function``; cache the machine code on disk if its folder is writable."""
    try:
        return numba.njit(cache=True, error_model="numpy", **options)(function)
    except RuntimeError:
        return numba.njit(error_model="numpy", **options)(function)


class Progress(Listener):
    """A line on a terminal while kernels are compiled, once on each machine."""

    def __init__(self) -> None:
        self._bars: list[Any] = []

    def on_start(self, event: Event) -> None:
        from tqdm import tqdm  # most processes load what is compiled

        assert event.data is not None
        kernel, text = event.data["dispatcher"].py_func, "compiling for this processor, once"
        own = kernel.__module__.startswith("torch_qpmpc") and not self._bars
        hidden = None if own else True  # None: without a terminal
        self._bars.append(tqdm(desc=text, unit=" kernels", leave=False, disable=hidden))
        self._bars[0].set_postfix_str(kernel.__name__)

    def on_end(self, event: Event) -> None:
        self._bars[0].update()
        self._bars.pop().close()


register("numba:compile", Progress())


# LLVM vectorises loops whose sums may be reordered.
summing = partial(compiled, fastmath={"reassoc", "contract"})


@compiled
def equal(x, y):
    """Return True if two arrays of bytes, or of words, are equal."""
    difference = y.dtype.type(0)
    for j in range(len(y)):
        difference |= x[j] ^ y[j]
    return difference == 0


@compiled
def copy(x, y):
    """x = y, as a loop: Numba's assignment to a slice takes seconds to compile."""
    for j in range(len(x)):
        x[j] = y[j]


@compiled
def add(x, factor, y):
    """Add ``factor y`` to x in place."""
    for j in range(len(x)):
        x[j] += factor * y[j]


@compiled
def add_product(x, factors, matrix):
    """Add ``matrix' factors`` to x in place, four rows at a time to save reads and writes of x."""
    whole = len(factors) - len(factors) % 4
    for j in range(0, whole, 4):
        f, g, h, p = factors[j], factors[j + 1], factors[j + 2], factors[j + 3]
        for k in range(len(x)):
            x[k] += (f * matrix[j, k] + g * matrix[j + 1, k]) + (
                h * matrix[j + 2, k] + p * matrix[j + 3, k]
            )
    if whole + 2 <= len(factors):
        f, g = factors[whole], factors[whole + 1]
        for k in range(len(x)):
            x[k] += f * matrix[whole, k] + g * matrix[whole + 1, k]
    if len(factors) % 2:
        for k in range(len(x)):
            x[k] += factors[-1] * matrix[len(factors) - 1, k]


@summing
def dot(x, y):
    """Return x'y."""
    total = 0.0
    for j in range(len(x)):
        total += x[j] * y[j]
    return total


@compiled
def products(matrices, group, vectors, spans):
    """Multiply each QP's matrix by its vector: ``(M, i, j)`` and ``(B, j)`` to ``(B, i)``.

    ``spans`` are the `row_spans` of the only matrix, or empty.
    """
    out = np.empty((len(vectors), matrices.shape[1]))
    if _pays(spans, vectors):
        for i in range(len(vectors)):
            for j in range(len(spans)):
                first, end = spans[j]
                out[i, j] = dot(matrices[0, j, first:end], vectors[i, first:end])
    elif len(matrices) == 1 and matrices.size:
        chunk = max(1, ONE_THREAD // matrices.size)
        for i in range(0, len(vectors), chunk):
            np.dot(vectors[i : i + chunk], matrices[0].T, out[i : i + chunk])
    else:
        for i in range(len(vectors)):
            for j in range(out.shape[1]):
                out[i, j] = dot(matrices[group[i], j], vectors[i])
    return out


@compiled
def transposed_products(matrices, group, vectors, spans):
    """Do as `products` with transposed matrices: ``(M, i, j)`` and ``(B, i)`` to ``(B, j)``."""
    out = np.zeros((len(vectors), matrices.shape[2]))
    if _pays(spans, vectors):
        for i in range(len(vectors)):
            for j in range(len(spans)):
                first, end = spans[j]
                add(out[i, first:end], vectors[i, j], matrices[0, j, first:end])
    elif len(matrices) == 1 and matrices.size:
        chunk = max(1, ONE_THREAD // matrices.size)
        for i in range(0, len(vectors), chunk):
            np.dot(vectors[i : i + chunk], matrices[0], out[i : i + chunk])
    else:
        for i in range(len(vectors) if matrices.size else 0):
            add_product(out[i], vectors[i], matrices[group[i]])
    return out


@compiled
def row_spans(matrices):
    """Return the first and the end of the nonzero entries in each row, ``(i, 2)``.

    Of more than one matrix they are empty, ``(0, 2)``.
    """
    spans = np.zeros((matrices.shape[1] if len(matrices) == 1 else 0, 2), np.int64)
    for i in range(len(spans)):
        for j in range(matrices.shape[2]):
            if matrices[0, i, j] != 0:
                spans[i, 0] = j if spans[i, 1] == 0 else spans[i, 0]
                spans[i, 1] = j + 1
    return spans


@compiled
def _pays(spans, vectors):
    """Return True if loops over spans are faster than BLAS: of one vector, or short ones."""
    widest = 0
    for j in range(len(spans)):
        widest = max(widest, spans[j, 1] - spans[j, 0])
    return len(spans) > 0 and (len(vectors) == 1 or widest <= 1)


@compiled
def eliminate(C, n_kept, independent):
    """Solve C z = b for some entries of z: return T and -Y with ``z = T y + Y b``.

    LU with row pivoting on the transpose of C picks columns that are safe to solve for. For a
    linear MPC scheme they are x_1..x_N, and then T is its prediction form. For a banded C, the cost
    grows with the square of N, as T does: the loops skip the zeros outside the band.

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
            if factors[j, k] != 0:  # few are not, in a banded C
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
        first = 0
        while first < i and factors[first, i] == 0:
            first += 1
        add_product(right[i], -factors[first:i, i], right[first:])
        for j in range(n_z):
            right[i, j] /= factors[i, i]
    for i in range(n_c - 1, -1, -1):
        end = n_c
        while end > i + 1 and factors[end - 1, i] == 0:
            end -= 1
        add_product(right[i], -factors[i + 1 : end, i], right[i + 1 :])
        dependent = order[n_kept + i]
        for j in range(n_y):
            T[dependent, j] = right[i, j]
        for j in range(n_c):
            Y_neg[dependent, j] = -right[i, n_y + j]
    return True


@compiled
def sparse_products(left, right):
    """Multiply ``(M, i, j)`` by ``(M, j, k)``, ignoring the left matrices' zeros."""
    out = np.zeros((len(left), left.shape[1], right.shape[2]))
    for m in range(len(left)):
        for i in range(left.shape[1]):
            for j in range(left.shape[2]):
                if left[m, i, j] != 0:
                    add(out[m, i], left[m, i, j], right[m, j])
    return out
