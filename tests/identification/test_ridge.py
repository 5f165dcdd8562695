import pytest
import torch
from torch.testing import assert_close

from torch_qpmpc.identification.ridge import ridge


def problem(n: int, m: int = 5, noise: float = 0.1, seed: int = 0):
    random = torch.Generator().manual_seed(seed)
    X, W, e = (torch.randn(*size, generator=random).double() for size in ((n, m), (m, 2), (n, 2)))
    return X * torch.tensor([1.0, 10, 1, 0.1, 1][:m]), W, e * noise


@pytest.mark.parametrize(("n", "strength"), [(4, 0.3), (40, 0.3), (40, 0.0)])
def test_a_strength_penalises_coefficients_in_the_units_of_their_columns(n, strength):
    X, W, e = problem(n)
    Y = X @ W + e
    D = X.square().mean(0)
    expected = torch.linalg.solve(X.mT @ X / n + strength * torch.diag(D), X.mT @ Y / n)
    assert_close(ridge(X, Y, torch.tensor([strength]), 1.0), expected)


def test_units_do_not_matter():
    X, W, e = problem(30)
    scale = torch.tensor([1e-3, 1, 1e6, 1, 10])
    assert_close(ridge(X * scale, X @ W + e), ridge(X, X @ W + e) / scale.unsqueeze(-1))


def test_exact_data_have_exact_coefficients():
    X, W, _ = problem(30)
    assert_close(ridge(X, X @ W), W, rtol=1e-11, atol=1e-11)


def test_the_evidence_chooses_well_where_data_are_few():
    def error(*options) -> float:
        errors = []
        for seed in range(30):
            X, W, e = problem(12, noise=3.0, seed=seed)
            X = X / X.square().mean(0).sqrt()
            errors.append((ridge(X, X @ W + e, *options) - W).square().sum())
        return torch.stack(errors).mean().item()

    best = min(error(torch.tensor([10.0**i]), 1.0) for i in range(-3, 3))
    assert error() < 2.2 * best
    assert error() < 0.8 * error(torch.zeros(1), 1.0)


def test_a_column_of_zeros_has_the_coefficient_zero():
    X, W, e = problem(30)
    X[:, 2] = 0
    found = ridge(X, X @ W + e)
    assert (found[2] == 0).all()
    assert found.isfinite().all()
    assert (ridge(X, torch.zeros(30, 2).double()) == 0).all()
