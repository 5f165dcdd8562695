import pytest
import torch
from torch.testing import assert_close

from tests.problems import normal
from tests.refused import refused
from torch_qpmpc.mpc.parametrizations import Cholesky, SquareRoot

FACTOR = normal(4, 4)
DIRECTION = normal(4, 1)
UNITS = torch.tensor([[1.0], [1e9], [1e-3], [1e4]]).double()
MATRICES = {
    "positive definite": FACTOR @ FACTOR.mT,
    "rank one": DIRECTION @ DIRECTION.mT,
    "zero": torch.zeros(4, 4).double(),
    "diagonal with zeros": torch.diag(torch.tensor([0.0, 2.0, 0.0, 3.0])).double(),
    "batch": torch.stack((FACTOR @ FACTOR.mT, DIRECTION @ DIRECTION.mT)),
    "tiny": 1e-12 * FACTOR @ FACTOR.mT,
    "far units": UNITS * (FACTOR @ FACTOR.mT) * UNITS.mT,
    "far units, rank one": UNITS * (DIRECTION @ DIRECTION.mT) * UNITS.mT,
}


@pytest.mark.parametrize("name", MATRICES)
def test_cholesky_factor_of_any_semidefinite_matrix(name):
    H = MATRICES[name]
    factor = Cholesky().right_inverse(H)
    size = H.diagonal(dim1=-2, dim2=-1).sqrt().unsqueeze(-1)
    size = torch.where(size > 0, size, size.amax(-2, keepdim=True))
    error = (Cholesky()(factor) - H).abs()
    assert (error <= 1e-12 * size * size.mT).all()
    assert (factor.triu(1) == 0).all()
    assert (factor.diagonal(dim1=-2, dim2=-1) >= 0).all()


def test_cholesky_factor_of_a_matrix_that_rounding_left_indefinite():
    H = torch.tensor([[1.0, 1e-5], [1e-5, 1e-20]]).double()
    assert_close(Cholesky()(Cholesky().right_inverse(H)), H, rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", ["rank one", "diagonal with zeros"])
def test_cholesky_factor_of_singular_matrices_in_single_precision(name):
    H = MATRICES[name].float()
    assert_close(Cholesky()(Cholesky().right_inverse(H)), H)


def test_the_entries_above_the_diagonal_do_not_count():
    factor = normal(4, 4).requires_grad_()
    H = Cholesky()(factor)
    assert_close(H, Cholesky()(factor.tril()))
    H.sum().backward()
    assert (factor.grad.triu(1) == 0).all()


@refused(
    (SquareRoot(), torch.tensor([1.0, -0.5]), "diagonal: got smallest eigenvalue -0.5, ex"),
    (Cholesky(), torch.diag(torch.tensor([1.0, -0.5])), "H: got smallest eigenvalue -0.5, expecte"),
)
def test_a_start_that_is_not_semidefinite_is_named(kind, value):
    kind.right_inverse(value)
