from __future__ import annotations

import os
import subprocess
import sys

import numba
import numpy as np
import pytest

from tests.problems import normal
from torch_qpmpc.qp.kernels import linalg
from torch_qpmpc.qp.kernels.linalg import products, transposed_products


def test_without_a_writable_cache_kernels_are_compiled_each_time(monkeypatch):
    njit = numba.njit

    def refuses(*arguments, cache=False, **options):
        if cache:
            raise RuntimeError("cannot cache function: no locator available")
        return njit(*arguments, **options)

    monkeypatch.setattr(numba, "njit", refuses)

    @linalg.compiled
    def twice(x):
        return 2 * x

    assert twice(3.0) == 6.0


def test_without_the_compiler_the_import_ends_in_a_sentence():
    ended = subprocess.run(
        [sys.executable, "-c", "import torch_qpmpc"],
        env=os.environ | {"NUMBA_DISABLE_JIT": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.stderr.splitlines()[-1] == (
        "torch_qpmpc.errors.QPError: NUMBA_DISABLE_JIT: got 1, expected 0. Unset it before the "
        "import: the kernels do not run in plain Python."
    )


@pytest.mark.parametrize("n", range(10))
def test_a_product_takes_every_row(n):
    x, factors, matrix = normal(5).numpy(), normal(n).numpy(), normal(n, 5, seed=1).numpy()
    expected = x + matrix.T @ factors
    linalg.add_product(x, factors, matrix)
    np.testing.assert_allclose(x, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(("i", "j"), [(4, 7), (7, 4), (1, 6), (0, 3), (3, 0)])
@pytest.mark.parametrize("M", [1, 3])
def test_products_are_those_of_each_matrix(M, i, j):
    matrices, group = normal(M, i, j).numpy(), np.arange(6) % M
    left, right = normal(6, i, seed=1).numpy(), normal(6, j, seed=2).numpy()
    expected = np.einsum("bij,bj->bi", matrices[group], right)
    np.testing.assert_allclose(products(matrices, group, right, False), expected, atol=1e-12)
    expected = np.einsum("bij,bi->bj", matrices[group], left)
    found = transposed_products(matrices, group, left, False)
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_more_than_one_thread_would_take_is_multiplied_in_parts(monkeypatch):
    matrix, vectors = normal(1, 300, 400).numpy(), normal(5, 400, seed=1).numpy()
    assert matrix.size > linalg.ONE_THREAD // 5
    found = products(matrix, np.zeros(5, np.int64), vectors, False)
    np.testing.assert_allclose(found, vectors @ matrix[0].T, atol=1e-11)


def test_a_diagonal_matrix_is_multiplied_as_such():
    matrix, vectors = np.diag(np.arange(4.0))[None], normal(3, 4).numpy()
    for product in (products, transposed_products):
        found = product(matrix, np.zeros(3, np.int64), vectors, True)
        np.testing.assert_array_equal(found, vectors * np.arange(4.0))
