"""The kernels of theta against NumPy."""

from __future__ import annotations

import numpy as np
import pytest

from torch_qpmpc.qp.kernels import linalg as kernels
from torch_qpmpc.qp.pipeline.condensing import DEFINITE, SHIFT

RNG = np.random.default_rng(0)


def matrix_with(eigenvalues: list[float]) -> np.ndarray:
    basis = np.linalg.qr(RNG.normal(size=(len(eigenvalues),) * 2))[0]
    return (basis * eigenvalues) @ basis.T


def test_zeros_of_a_left_matrix_are_skipped():
    left = RNG.normal(size=(2, 7, 5)) * (RNG.random((2, 7, 5)) < 0.2)
    right = RNG.normal(size=(2, 5, 3))
    np.testing.assert_allclose(kernels.sparse_products(left, right), left @ right, rtol=1e-12)


@pytest.mark.parametrize("width", [1, 4, 12])
def test_a_band_is_eliminated(width):
    """The band of each row begins at its own variable, which pivoting need not choose."""
    n_c, n_z = 20, 34
    C = np.triu(np.tril(RNG.normal(size=(2, n_c, n_z)), 2 + width), 2)
    T, Y_neg, regular = kernels.eliminate(C, 2, 1e-10)
    assert regular
    np.testing.assert_allclose(C @ T, 0, atol=1e-9)
    np.testing.assert_allclose(-C @ Y_neg, np.eye(n_c)[None].repeat(2, 0), atol=1e-9)


@pytest.mark.parametrize("size", [1e-6, 1.0, 1e6])
def test_a_definite_matrix_gets_the_inverse_of_its_cholesky_factor(size):
    H = size * np.stack([matrix_with([1.0, 2.0, 5.0, 1e-3]), matrix_with([3.0] * 4)])
    inverses, shifts = kernels.inverse_factors(H, DEFINITE, SHIFT)
    assert (shifts == 0).all()
    np.testing.assert_allclose(
        inverses, np.linalg.inv(np.linalg.cholesky(H)), rtol=1e-9, atol=1e-9 * size**-0.5
    )


def test_a_singular_matrix_is_shifted_by_a_part_of_its_largest_diagonal_entry():
    H = matrix_with([1.0, 2.0, 0.0])[None]
    inverses, shifts = kernels.inverse_factors(H, DEFINITE, SHIFT)
    assert shifts == pytest.approx(SHIFT * H.diagonal(axis1=1, axis2=2).max())
    whole = inverses[0].T @ inverses[0] @ (H[0] + shifts * np.eye(3))
    np.testing.assert_allclose(whole, np.eye(3), atol=1e-5)


def test_zeros_are_shifted_too():
    inverses, shifts = kernels.inverse_factors(np.zeros((1, 2, 2)), DEFINITE, SHIFT)
    assert (shifts > 0).all()
    assert np.isfinite(inverses).all()


def test_an_indefinite_matrix_has_no_factor_and_leaves_its_neighbours_theirs():
    H = np.stack([matrix_with([1.0, -1.0]), np.eye(2)])
    inverses, shifts = kernels.inverse_factors(H, DEFINITE, SHIFT)
    assert np.isposinf(inverses[0]).all()
    assert shifts[1] == 0
    np.testing.assert_allclose(inverses[1], np.eye(2))


def test_nan_has_no_factor():
    H = np.full((1, 2, 2), np.nan)
    assert np.isposinf(kernels.inverse_factors(H, DEFINITE, SHIFT)[0]).all()


def test_rows_up_to_a_size_have_no_length():
    G = RNG.normal(size=(2, 3, 4))
    G[0, 1] *= 1e-9
    lengths = kernels.row_lengths(G, np.full((2, 3), 1e-6))
    expected = np.linalg.norm(G, axis=-1)
    expected[0, 1] = 0
    np.testing.assert_allclose(lengths, expected)


@pytest.mark.parametrize(("cosine", "expected"), [(0.0, True), (0.4, True), (0.6, False)])
def test_rows_are_nearly_orthogonal_up_to_a_cosine_of_a_half(cosine, expected):
    units = np.array([[[1.0, 0.0], [cosine, np.sqrt(1 - cosine**2)]]])
    assert kernels.nearly_orthogonal(units) == expected


def test_sums_of_rows_and_sizes_of_columns():
    matrices = RNG.normal(size=(2, 3, 5))
    np.testing.assert_allclose(kernels.row_sums(matrices), np.abs(matrices).sum(-1))
    np.testing.assert_array_equal(kernels.column_sizes(matrices), np.abs(matrices).max(1))
    assert not kernels.column_sizes(np.zeros((1, 0, 4))).any()


def test_finite_sizes_are_the_largest_of_the_qps_that_share_a_matrix():
    vectors = np.array([[1.0, -np.inf], [-3.0, np.nan], [2.0, 5.0]])
    sizes = kernels.finite_sizes(vectors, np.array([1, 1, 0]), 2)
    np.testing.assert_array_equal(sizes, [[2.0, 5.0], [3.0, 0.0]])
    np.testing.assert_array_equal(
        kernels.finite_sizes(vectors[2:], np.zeros(9, int), 2), [[2, 5]] * 2
    )
