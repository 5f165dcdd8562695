"""Linear algebra as loops that Numba compiles for the CPU. Arrays are float64 and contiguous."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numba
import numpy as np
from llvmlite import ir
from numba.core import config
from numba.extending import intrinsic

from torch_qpmpc.errors import QPError

#: Largest matrix size times number of vectors in one call of BLAS, which then uses one thread.
ONE_THREAD = 2**18

if config.DISABLE_JIT:  # pyright: ignore[reportAttributeAccessIssue] -- set from the environment
    remedy = "Unset it before the import: the kernels do not run in plain Python."
    raise QPError.expected("NUMBA_DISABLE_JIT", "1", "0", remedy)


def compiled(function: Callable[..., Any], **options: Any) -> Callable[..., Any]:
    """Compile ``function``; cache the machine code on disk if its folder is writable."""
    try:
        return numba.njit(cache=True, error_model="numpy", **options)(function)
    except RuntimeError:
        return numba.njit(error_model="numpy", **options)(function)


# LLVM vectorises loops whose sums may be reordered, or whose entries are never NaN.
summing = partial(compiled, fastmath={"reassoc", "contract"})
comparing = partial(compiled, fastmath={"nnan", "nsz"})


def _larger(_, x, y):
    """Return max(x, y) of numbers that are not NaN; Python's max is not vectorised."""

    def generate(_, builder, signature, numbers):
        double = ir.DoubleType()
        kind = ir.FunctionType(double, (double, double))
        maximum = builder.module.declare_intrinsic("llvm.maxnum", (double,), kind)
        return builder.call(maximum, numbers)

    return numba.float64(numba.float64, numba.float64), generate


larger: Any = intrinsic(_larger)


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
def products(matrices, group, vectors, diagonal):
    """Multiply each QP's matrix by its vector: ``(M, i, j)`` and ``(B, j)`` to ``(B, i)``.

    With ``diagonal``, all QPs share one diagonal matrix.
    """
    out = np.empty((len(vectors), matrices.shape[1]))
    if diagonal:
        _scale(matrices[0], vectors, out)
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
def transposed_products(matrices, group, vectors, diagonal):
    """Do as `products` with transposed matrices: ``(M, i, j)`` and ``(B, i)`` to ``(B, j)``."""
    out = np.zeros((len(vectors), matrices.shape[2]))
    if diagonal:
        _scale(matrices[0], vectors, out)
    elif len(matrices) == 1 and matrices.size:
        chunk = max(1, ONE_THREAD // matrices.size)
        for i in range(0, len(vectors), chunk):
            np.dot(vectors[i : i + chunk], matrices[0], out[i : i + chunk])
    else:
        for i in range(len(vectors) if matrices.size else 0):
            add_product(out[i], vectors[i], matrices[group[i]])
    return out


@compiled
def _scale(matrix, vectors, out):
    for i in range(len(vectors)):
        for j in range(len(matrix)):
            out[i, j] = vectors[i, j] * matrix[j, j]
