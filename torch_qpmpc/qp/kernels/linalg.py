"""Linear algebra as loops that Numba compiles for the CPU. Arrays are float64 and contiguous.

The second half runs once for each theta. LAPACK and NumPy take several times as long.
"""

import math
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Any

import numba
import numpy as np
from numba.core.dispatcher import Dispatcher
from numba.core.event import Event, Listener, register
from numba.experimental import structref

#: Largest matrix size times number of vectors in one call of BLAS, which then uses one thread.
ONE_THREAD = 2**18


def compiled(function: Callable[..., Any], **options: Any) -> Callable[..., Any]:
    """Compile ``function``; cache it on disk, if writable, until a file that it uses changes."""
    try:
        kernel = numba.njit(cache=True, error_model="numpy", **options)(function)
    except RuntimeError:
        return numba.njit(error_model="numpy", **options)(function)
    with suppress(AttributeError):  # these are private to Numba
        kernels: list[Any] = [kernel]
        kernels += [x for x in function.__globals__.values() if isinstance(x, Dispatcher)]
        own, *called = (x._cache._cache_file for x in kernels)
        own._source_stamp = {own._source_stamp}.union(*(x._source_stamp for x in called))
    return kernel


class Progress(Listener):
    """A line on a terminal while kernels are compiled, once on each machine."""

    def __init__(self) -> None:
        self._bars: list[Any] = []

    def on_start(self, event: Event) -> None:
        from tqdm import tqdm  # most processes load what is compiled

        assert event.data is not None
        kernel, text = event.data["dispatcher"].py_func, "compiling for this processor, once"
        own = f"{kernel.__module__}".startswith("torch_qpmpc") and not self._bars
        hidden = None if own else True  # None: without a terminal
        self._bars.append(tqdm(desc=text, unit=" kernels", leave=False, disable=hidden))
        self._bars[0].set_postfix_str(kernel.__name__)

    def on_end(self, event: Event) -> None:
        self._bars[0].update()
        self._bars.pop().close()


register("numba:compile", Progress())


class Held(structref.StructRefProxy):
    """``parts`` of arrays that a kernel takes as one argument, see `held`."""


@structref.register
class _HeldType(numba.types.StructRef):
    pass


structref.define_proxy(Held, _HeldType, ["parts"])


@compiled
def held(parts):
    """Convert a tuple of arrays once: dozens of them take as long as a kernel in each call."""
    return Held(parts)


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

    ``spans`` are the matrices' `row_spans`, or empty. Matrices of their own may share a vector.
    """
    (M, rows, _), n = matrices.shape, len(vectors)
    chunk, B, spans = _ways(matrices, group, vectors, spans)
    out = np.empty((B, rows))
    for i in range(0, B if chunk else 0, max(1, chunk)):
        np.dot(vectors[i : i + chunk], matrices[0].T, out[i : i + chunk])
    for i in range(0 if chunk else B):
        matrix, vector = matrices[group[i] % M], vectors[i % n]
        for j in range(rows):
            first, end = spans[j]
            out[i, j] = dot(matrix[j, first:end], vector[first:end])
    return out


@compiled
def transposed_products(matrices, group, vectors, spans):
    """Do as `products` with transposed matrices: ``(M, i, j)`` and ``(B, i)`` to ``(B, j)``."""
    (M, rows, columns), n = matrices.shape, len(vectors)
    chunk, B, spans = _ways(matrices, group, vectors, spans)
    out = np.zeros((B, columns))
    for i in range(0, B if chunk else 0, max(1, chunk)):
        np.dot(vectors[i : i + chunk], matrices[0], out[i : i + chunk])
    for i in range(0 if chunk else B):
        matrix, vector, total = matrices[group[i] % M], vectors[i % n], out[i]
        for j in range(rows):
            factor = vector[j]
            for k in range(spans[j, 0], spans[j, 1] if factor != 0 else 0):
                total[k] += factor * matrix[j, k]
    return out


@compiled
def _ways(matrices, group, vectors, spans):
    """Return how many vectors BLAS multiplies at once, the number of products, and the spans.

    BLAS is slower for matrices of their own, one vector, or short spans.
    """
    (M, rows, columns), widest = matrices.shape, 0
    for j in range(len(spans)):
        widest = max(widest, spans[j, 1] - spans[j, 0])
    short = len(vectors) == 1 or (len(spans) > 0 and widest <= 1)
    if len(spans) == 0:
        spans = np.zeros((rows, 2), np.int64)
        spans[:, 1] = columns
    chunk = 0 if M > 1 or short or matrices.size == 0 else max(1, ONE_THREAD // matrices.size)
    return chunk, len(group) if M > 1 else len(vectors), spans


@compiled
def row_spans(matrices):
    """Return the first and the end of the nonzero entries in each row of any, ``(i, 2)``."""
    M, rows, columns = matrices.shape
    spans = np.zeros((rows, 2), np.int64)
    for i in range(rows):
        start, end = columns, 0
        for m in range(M):
            for j in range(columns):  # LLVM vectorises it
                start = min(start, j if matrices[m, i, j] != 0 else columns)
                end = max(end, j + 1 if matrices[m, i, j] != 0 else 0)
        spans[i, 0], spans[i, 1] = min(start, end), end
    return spans


@summing
def row_sums(matrices):
    """Return the sums of the absolute entries of the rows of ``(M, i, j)``."""
    sums = np.empty(matrices.shape[:2])
    for m in range(len(matrices)):
        for i in range(matrices.shape[1]):
            total = 0.0
            for j in range(matrices.shape[2]):
                total += abs(matrices[m, i, j])
            sums[m, i] = total
    return sums


@compiled
def eliminate(C, n_kept, independent, threshold):
    """Solve C z = b for some entries of z: return T, with ``z = T y`` if b = 0, and factors of C.

    Each equation is solved for its last entry after ``n_kept`` of at least ``threshold`` times the
    largest: x_{k+1} in a linear MPC scheme, for which T is its prediction form. For a banded C, the
    cost grows with the square of N, as T does.

    Returns:
        T ``(M, n_z, n_y)`` of C ``(M, n_c, n_z)``; the unit lower and the upper triangular factor,
        in one, of C in its columns ``pivots``, ``(M, n_c, n_c)``; these, ``(M, n_c)``; and False if
        rows have infinite pivots: others explain all but the fraction ``independent`` of them.
    """
    (M, n_c, n_z), of_C, regular = C.shape, row_spans(C), True
    T, factors = np.zeros((M, n_z, max(0, n_z - n_c))), np.zeros((M, n_c, n_c))
    pivots, rules = np.zeros((M, n_c), np.int64), (n_kept, independent, threshold)
    for m in range(M):
        regular &= _eliminate(C[m].copy(), rules, of_C.copy(), T[m], factors[m], pivots[m])
    return T, factors, pivots, regular


@compiled
def _eliminate(C, rules, spans, T, factors, pivots):
    (n_c, n_z), (n_kept, independent, threshold), regular = C.shape, rules, True
    equation, last, norms = np.full(n_z, -1), np.zeros(n_z, np.int64), np.zeros(n_c)
    for i in range(n_c):
        for j in range(spans[i, 0], spans[i, 1]):
            if C[i, j] != 0:
                last[j] = i
                norms[i] += C[i, j] ** 2
    for k in range(n_c):
        (start, end), pivot, largest = spans[k], -1, 0.0
        for j in range(max(start, n_kept), end):
            if equation[j] < 0:
                largest = max(largest, abs(C[k, j]))
        small = independent * math.sqrt(norms[k])
        for j in range(max(start, n_kept), end if largest > small else 0):
            if equation[j] < 0 and abs(C[k, j]) >= max(small, threshold * largest):
                pivot = j
        if pivot < 0:
            regular, factors[k, k] = False, np.inf
            continue
        pivots[k], equation[pivot] = pivot, k
        for i in range(k + 1, last[pivot] + 1):
            if C[i, pivot] != 0:
                factors[i, k] = C[i, pivot] / C[k, pivot]
                add(C[i, start:end], -factors[i, k], C[k, start:end])
                C[i, pivot], spans[i, 0] = 0.0, min(spans[i, 0], start)
                spans[i, 1] = max(spans[i, 1], end)
        for j in range(start, end):
            last[j] = max(last[j], last[pivot])
    for k in range(n_c - 1, -1, -1):
        for j in range(spans[k, 0], spans[k, 1]):
            i = equation[j]
            if i >= k and factors[k, k] < np.inf:
                factors[k, i] = C[k, j]
                if i > k and C[k, j] != 0:
                    start, end = spans[i]
                    add(C[k, start:end], -C[k, j] / C[i, j], C[i, start:end])
                    C[k, j], spans[k, 0] = 0.0, min(spans[k, 0], start)
                    spans[k, 1] = max(spans[k, 1], end)
    column = np.cumsum(equation < 0) - 1
    for j in range(n_z if regular else 0):
        k = equation[j]
        if k < 0:
            T[j, column[j]] = 1.0
            continue
        for i in range(spans[k, 0], spans[k, 1]):
            if equation[i] < 0:
                T[j, column[i]] = -C[k, i] / C[k, j]
    return regular


@compiled
def particular(factors, pivots, spans, group, b, n_z):
    """Return solutions of C z = b ``(B, n_c)``, ``(B, n_z)``; Y b without ``pivots``."""
    M, _, n_c = factors.shape
    if pivots.shape[1] < n_c:
        return products(factors, group, b, spans)
    z, x = np.zeros((len(group) if M > 1 else len(b), n_z)), np.empty(n_c)
    for i in range(len(z)):
        L_U = factors[group[i] % M]
        copy(x, b[i % len(b)])
        for k in range(n_c):
            first = spans[k, 0]
            x[k] -= dot(L_U[k, first:k], x[first:k])
        for k in range(n_c - 1, -1, -1):
            end = spans[k, 1]
            x[k] = (x[k] - dot(L_U[k, k + 1 : end], x[k + 1 : end])) / L_U[k, k]
            z[i, pivots[group[i] % M, k]] += x[k]
    return z


@compiled
def multipliers(factors, pivots, spans, group, left):
    """Return chi ``(B, n_c)`` with ``left + C'chi = 0`` in the pivots' columns, or ``-Y'left``."""
    M, _, n_c = factors.shape
    if pivots.shape[1] < n_c:
        return transposed_products(factors, group, -left, spans)
    chi = np.empty((len(left), n_c))
    for i in range(len(left)):
        L_U, x = factors[group[i] % M], chi[i]
        for k in range(n_c):
            x[k] = -left[i, pivots[group[i] % M, k]]
        for k in range(n_c):
            x[k] /= L_U[k, k]
            factor = x[k]
            for j in range(k + 1, spans[k, 1]):
                x[j] -= factor * L_U[k, j]
        for k in range(n_c - 1, -1, -1):
            factor = x[k]
            for j in range(spans[k, 0], k):
                x[j] -= factor * L_U[k, j]
    return chi


@compiled
def sparse_products(left, right, of_left, of_right):
    """Multiply ``(M or 1, i, j)`` by ``(M or 1, j, k)``, with their `row_spans`, without zeros."""
    M = max(len(left), len(right))
    out = np.zeros((M, left.shape[1], right.shape[2]))
    for m in range(M):
        A, B, product = left[m % len(left)], right[m % len(right)], out[m]
        for i in range(left.shape[1]):
            for j in range(of_left[i, 0], of_left[i, 1]):
                factor = A[i, j]
                for k in range(of_right[j, 0], of_right[j, 1] if factor != 0 else 0):
                    product[i, k] += factor * B[j, k]
    return out
