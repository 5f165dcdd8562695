"""Structural defects against loops over blocks, and known schemes' models and orders."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.optimize import least_squares
from torch import Tensor

from tests.problems import model_form, normal
from torch_qpmpc.analysis import structure
from torch_qpmpc.analysis.structure import (
    PredictionForm,
    causality_defect,
    nearest_model,
    prediction_form,
    stage_models,
    toeplitz_defect,
)
from torch_qpmpc.mpc.layout import banded_matrix

N_X, N_U, N = 3, 2, 4
generator = torch.Generator().manual_seed(0)
A = torch.randn(N_X, N_X, generator=generator, dtype=torch.float64)
B = torch.randn(N_X, N_U, generator=generator, dtype=torch.float64)
C_0 = banded_matrix(A, B, N)


def form_of(C: Tensor, b: Tensor | None = None) -> PredictionForm:
    return prediction_form(C, N_X, N_U, b)


def free_form(seed: int = 0) -> PredictionForm:
    """Make a prediction form of no MPC scheme: every block of Gamma is full."""
    return form_of(banded_matrix(0.5 * A, B, N) + 0.1 * normal(*C_0.shape, seed=seed))


def scheme_with(*earlier: Tensor) -> Tensor:
    """Make C of x_{k+1} = A x_k + B u_k plus terms in (x_j, u_j) for j = k - 1, k - 2, ..."""
    C, n = banded_matrix(0.3 * A, B, N), N_X + N_U
    for back, block in enumerate(earlier, start=1):
        for k in range(back, N):
            first = (k - back) * n
            C[k * N_X : (k + 1) * N_X, first : first + n] = block
    return C


def test_defects_are_sums_over_blocks():
    form = free_form()
    total = above = departure = 0.0
    by_lag = {lag: [] for lag in range(1 - N, N)}
    for k in range(N):
        for j in range(N):
            block = form.Gamma[k * N_X : (k + 1) * N_X, j * N_U : (j + 1) * N_U]
            by_lag[k - j].append(block)
            total += block.square().sum().item()
            above += block.square().sum().item() if j > k else 0.0
    for blocks in by_lag.values():
        mean = sum(blocks) / len(blocks)
        departure += sum((block - mean).square().sum().item() for block in blocks)
    assert causality_defect(form).item() == pytest.approx((above / total) ** 0.5, rel=1e-12)
    assert toeplitz_defect(form).item() == pytest.approx((departure / total) ** 0.5, rel=1e-12)
    assert above > 0.01 * total


def test_a_time_varying_scheme_is_markovian_but_no_tied_one():
    A_k, B_k = A + 0.1 * normal(N, N_X, N_X, seed=3), B + 0.1 * normal(N, N_X, N_U, seed=4)
    c_k = normal(N, N_X, seed=5)
    form = model_form(A_k, B_k, N, c_k)
    found = stage_models(form)
    for part, expected in (("A", A_k), ("B", B_k), ("offset", c_k)):
        torch.testing.assert_close(getattr(found, part), expected, rtol=0, atol=1e-9)
    assert found.residual.max() < 1e-9
    assert causality_defect(form) < 1e-12
    assert toeplitz_defect(form) > 0.01
    assert nearest_model(form).residual > 0.01


@pytest.mark.parametrize("seed", range(3))
def test_no_other_search_finds_a_nearer_model(seed):
    form = free_form(seed)
    scale = form.maps[1:, :, :-1].norm()

    def distance(flat):
        A, B, offset = torch.as_tensor(flat).view(N_X, -1).split((N_X, N_U, 1), -1)
        return ((model_form(A, B, N, offset[:, 0]).maps - form.maps) / scale).flatten().numpy()

    found = nearest_model(form)
    flat = torch.cat((found.A, found.B, found.offset.unsqueeze(-1)), -1).flatten()
    assert np.linalg.norm(distance(flat)) == pytest.approx(found.residual.item(), rel=1e-9)
    for start in (flat, flat + 0.1 * normal(len(flat), seed=seed)):
        other = least_squares(distance, start.numpy())
        assert np.sqrt(2 * other.cost) > found.residual.item() - 1e-7
    assert 0.01 < found.residual < 1


def test_a_search_ends_whose_minimum_is_far(monkeypatch):
    """Predictions of an unstable model, all different: thousands of steps gain little."""
    fits = []

    def recorded(*args, **options):
        fits.append(least_squares(*args, **options))
        return fits[-1]

    monkeypatch.setattr(structure, "least_squares", recorded)
    form = model_form(1.5 * A / A.norm(), B, 20)
    form = replace(
        form, **{x: 9 * normal(*getattr(form, x).shape, seed=1) for x in ("Phi", "Gamma")}
    )
    near = nearest_model(form).residual
    assert fits[0].nfev == structure.EVALUATIONS
    monkeypatch.setattr(structure, "MULTIPLICATIONS", 0)
    assert near < nearest_model(form).residual <= 1
    assert len(fits) == 1


@pytest.mark.parametrize(("stages", "most"), [((1.0, 1e4), 0.01), ((1.0, 1e6, 1e-6) * 20, 1.0)])
def test_a_one_step_fit_that_explodes_is_no_start(stages, most):
    """Over the horizon it predicts worse than zero, or overflows."""
    A_k = torch.tensor(stages, dtype=torch.float64).view(-1, 1, 1)
    found = nearest_model(model_form(A_k, torch.zeros_like(A_k), len(stages)))
    assert found.residual <= most


def test_directions_that_no_prediction_reaches_are_not_made_up():
    """x_1 does not depend on x_0's second entry, which no action changes."""
    nilpotent = torch.tensor([[0.5, 1.0], [0.0, 0.0]], dtype=torch.float64)
    B = torch.tensor([[1.0], [0.0]], dtype=torch.float64)
    form = model_form(nilpotent, B, N)
    found = stage_models(form)
    torch.testing.assert_close(found.A[0], nilpotent)
    expected = torch.tensor([[0.5, 0.0], [0.0, 0.0]], dtype=torch.float64)
    torch.testing.assert_close(found.A[1:], expected.expand(N - 1, 2, 2))
    assert nearest_model(form).residual < 1e-12
    torch.testing.assert_close(nearest_model(form).A, nilpotent)


def test_an_older_pair_is_in_the_residual_of_the_stages():
    """In any gauge, and causally."""
    T = normal(N * N_X, N * N_X, seed=8)
    form = form_of(T @ scheme_with(0.3 * normal(N_X, N_X + N_U, seed=9)))
    assert stage_models(form).residual[1:].min() > 1e-3
    assert causality_defect(form) < 1e-10
    assert stage_models(form_of(T @ scheme_with())).residual.max() < 1e-9
