"""Errors of models against averages over samples."""

from __future__ import annotations

import pytest
import torch

from tests.problems import normal, random_mpc, random_states
from torch_qpmpc import QPMPC
from torch_qpmpc.analysis.model_error import first_state_error, one_step_error, second_moment
from torch_qpmpc.analysis.structure import NearestModel

A, B, OFFSET = normal(3, 3, seed=1), normal(3, 2, seed=2), normal(3, seed=3)
S, ACTIONS = 2 * normal(50, 3, seed=4) + 1, normal(50, 2, seed=5)


def model(*stages: int) -> NearestModel:
    residual = torch.zeros(stages)
    return NearestModel(
        A + 0.1 * normal(*stages, 3, 3, seed=6),
        B + 0.1 * normal(*stages, 3, 2, seed=7),
        torch.zeros(*stages, 3, 0),
        OFFSET + 0.1 * normal(*stages, 3, seed=8),
        residual,
    )


def test_error_over_samples_is_their_root_mean_square():
    wrong = model(4)
    found = one_step_error(wrong, A, B, OFFSET, second_moment(S, ACTIONS))
    truth = S @ A.mT + ACTIONS @ B.mT + OFFSET
    for k in range(4):
        error = S @ wrong.A[k].mT + ACTIONS @ wrong.B[k].mT + wrong.offset[k] - truth
        assert found[k].item() == pytest.approx(error.square().sum(-1).mean().sqrt().item())


def test_error_over_unit_variance_is_the_frobenius_norm():
    wrong = model()
    parts = (wrong.A - A, wrong.B - B, wrong.offset)
    expected = sum(part.square().sum().item() for part in parts) ** 0.5
    assert one_step_error(wrong, A, B).item() == pytest.approx(expected)
    right = NearestModel(A, B, torch.zeros(3, 0), OFFSET, torch.zeros(()))
    assert one_step_error(right, A, B, OFFSET) == 0
    assert one_step_error(right, A, B).item() == pytest.approx(OFFSET.norm().item())


def test_the_policys_predicted_next_state():
    A, B = normal(2, 2, seed=1), normal(2, 1, seed=2)
    settings = {"action_bounds": ([-0.5], [0.5]), "solver": "daqp", "offset": [0.1, 0.2]}
    settings["stage_weight"] = [1.0, 1.0, 0.1]
    mpc, s = QPMPC.from_model(A, B, 3, **settings), random_states(20)
    offset = torch.tensor([0.1, 0.2], dtype=torch.float64)
    assert first_state_error(mpc, s, A, B, offset) < 1e-6
    assert first_state_error(mpc, s, A, B).item() == pytest.approx(0.05**0.5, abs=1e-6)
    dA = torch.tensor([[0.0, 0.3], [0.0, 0.0]], dtype=torch.float64)
    expected = (0.3 * s[:, 1]).square().mean().sqrt().item()
    assert first_state_error(mpc, s, A + dA, B, offset).item() == pytest.approx(expected, abs=1e-6)


def test_states_without_a_solution_are_left_out():
    mpc = random_mpc(free=0.0, state_slack=torch.inf, on_failure="mask")
    s = torch.tensor([[0.1, 0.0], [5.0, 0.0]], dtype=torch.float64)
    A, B = mpc.C[:2, :2].detach(), mpc.C[:2, 2:3].detach()
    assert first_state_error(mpc, s, A, B) < 1e-6
