"""Gains against finite differences and the regulator; maps against solves of single states."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from tests.problems import normal, random_mpc
from torch_qpmpc import QPMPC, QPError
from torch_qpmpc.analysis.policy import local_gain, policy_map, spectral_radius
from torch_qpmpc.mpc.riccati import lqr_gain, stage_weight

A = torch.tensor([[1.0, 0.2], [-0.1, 1.1]], dtype=torch.float64)
B = torch.tensor([[0.0, 0.1], [0.3, 0.1]], dtype=torch.float64)


def free_regulator(horizon: int = 4, **options: Any) -> QPMPC:
    """Make an MPC scheme with inactive bounds, which equals the regulator at any horizon."""
    weight = torch.diag(torch.tensor([2.0, 1.0, 0.3, 0.5])) + 0.1
    settings: dict[str, Any] = {"gamma": 0.9, "stage_weight": weight, "solver": "daqp"}
    return QPMPC.linear_mpc(A, B, horizon, **(settings | options))


def test_gain_at_one_state_leaves_no_gradient():
    mpc = random_mpc()
    with torch.no_grad():
        K = local_gain(mpc, torch.zeros(2))
    assert K.shape == (1, 2)
    assert not K.requires_grad
    assert all(p.grad is None for p in mpc.parameters())


@pytest.mark.parametrize("horizon", [1, 4])
def test_an_mpc_scheme_with_riccati_terminal_cost_is_the_regulator(horizon):
    mpc = free_regulator(horizon)
    K = lqr_gain(A, B, stage_weight(mpc), 0.9)
    torch.testing.assert_close(local_gain(mpc, torch.zeros(2).double()), K, rtol=1e-7, atol=1e-7)
    assert spectral_radius(A, B, K) < 0.9**-0.5


def test_the_regulator_minimises_the_discounted_cost():
    """Its gain is a fixed point of policy improvement."""
    W, gamma = stage_weight(free_regulator()), 0.9
    K = lqr_gain(A, B, W, gamma)
    closed, pair = A - B @ K, torch.cat((torch.eye(2).double(), -K))
    P = torch.zeros(2, 2).double()
    for _ in range(2000):
        P = pair.mT @ W @ pair + gamma * closed.mT @ P @ closed
    next_pair = torch.cat((A, B), dim=-1)
    of_pairs = W + gamma * next_pair.mT @ P @ next_pair
    improved = torch.linalg.solve(of_pairs[2:, 2:], of_pairs[2:, :2])
    torch.testing.assert_close(improved, K, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("hessian", ["diagonal", "block", "full"])
def test_stage_weight_is_that_of_the_first_pair(hessian):
    weight = torch.tensor([2.0, 1.0, 0.3, 0.5])
    mpc = QPMPC.from_model(A, B, 3, hessian=hessian, stage_weight=weight, learn=("H", "C"))
    torch.testing.assert_close(stage_weight(mpc), torch.diag(weight).double())


def test_spectral_radius():
    diagonal = torch.diag(torch.tensor([0.5, -1.2])).double()
    nothing = torch.zeros(2, 2).double()
    assert spectral_radius(diagonal, B, nothing).item() == pytest.approx(1.2)
    rotation = torch.tensor([[0.0, -0.9], [0.9, 0.0]]).double()
    both = spectral_radius(torch.stack((diagonal, rotation)), B, nothing)
    assert both.tolist() == pytest.approx([1.2, 0.9])


def test_policy_map_is_the_solutions_of_its_states():
    mpc = QPMPC.of(
        3,
        2,
        3,
        state_bounds=([-1.0] * 3, [1.0] * 3),
        action_bounds=([-0.5] * 2, [0.5] * 2),
        stage_weight=[1.0, 0.5, 0.3, 0.1, 0.2],
        A=torch.eye(3) + 0.2 * normal(3, 3, seed=1),
        B=normal(3, 2, seed=2),
        solver="daqp",
    )
    x, y = torch.linspace(-1.5, 1.5, 7), torch.linspace(-1, 1, 5)
    found = policy_map(mpc, x, y, axes=(2, 0), at=[9.0, 0.2, 9.0])
    for i in (0, 3, 6):
        for j in (1, 4):
            s = torch.tensor([y[j], 0.2, x[i]], dtype=torch.float64)
            assert torch.equal(found.states[i, j], s)
            alone = mpc.solve(s)
            torch.testing.assert_close(found.values[i, j], alone.value.detach())
            torch.testing.assert_close(found.actions[i, j], mpc.policy(s).detach())
            torch.testing.assert_close(found.gains[i, j], local_gain(mpc, s))
            assert torch.equal(found.active_sets[found.regions[i, j]], alone.active)
    counts = found.regions.flatten().bincount()
    assert len(counts) == len(found.active_sets) > 3
    assert (counts.diff() <= 0).all(), "the most frequent first"


def test_states_without_a_solution_are_no_region():
    mpc = random_mpc(free=0.0, state_slack=torch.inf, on_failure="mask")
    x, y = torch.linspace(-2, 2, 9), torch.linspace(-0.1, 0.1, 3)
    found = policy_map(mpc, x, y)
    failed = found.regions == -1
    assert failed[0].all(), "beyond the hard bound"
    assert not failed[4].any()
    assert torch.equal(found.values.isnan(), failed)
    assert torch.equal(found.actions.isnan().all(-1), failed)
    assert torch.equal(found.gains.isnan().all(-1).all(-1), failed)
    assert len(found.active_sets) == found.regions.max() + 1
    assert found.active_sets.abs().max() <= 2


GRID = torch.linspace(-1, 1, 3)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"axes": (0, 0)}, r"axes: got \(0, 0\), expected two different states among 0 to 1"),
        ({"axes": (0, 2)}, r"axes: got \(0, 2\)"),
        ({"x": 1.0}, r"x, y: got shapes \(\) and \(3,\)"),
        ({"at": [0.0]}, r"at: got shape \(1,\), expected shape \(2,\)"),
    ],
)
def test_bad_slices(arguments, message):
    with pytest.raises(QPError, match=message):
        policy_map(random_mpc(), **({"x": GRID, "y": GRID} | arguments))
