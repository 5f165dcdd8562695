"""The integrator with actuator noise: dynamics, cost, signals and starts, by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from torch_qpmpc.envs import ActuatorNoise
from torch_qpmpc.envs.actuator_noise import HiddenVelocity
from torch_qpmpc.envs.closed_loop import plant_loop
from torch_qpmpc.errors import QPError
from torch_qpmpc.mpc.regulator import lqr_gain
from torch_qpmpc.mpc.riccati import noisy_stage_weight, riccati_weight


def test_a_step_and_its_cost_by_hand():
    p = ActuatorNoise()
    x = torch.tensor([[1.0, 2.0], [0.0, 1.0]]).double()
    u = torch.tensor([[3.0], [-1.0]]).double()
    w = torch.tensor([[0.5, 0.1, 0.0], [-2.0, 0.0, 0.1]]).double()
    by_hand = [[1 + 0.4 + 0.02 * 4.5 + 0.1, 2 + 0.2 * 4.5], [0.2 + 0.02, 1 + 0.2 + 0.1]]
    torch.testing.assert_close(p.step(x, u, w), torch.tensor(by_hand).double())
    costs = torch.tensor([(1 + 0.4 + 0.09) / 2, (0.1 + 0.01) / 2]).double()
    torch.testing.assert_close(p.cost(x, u, w), costs)
    assert torch.equal(p.output(x, w), x)


def test_the_action_is_clipped_before_the_noise():
    p, x = ActuatorNoise(ub_a=torch.ones(1).double()), torch.zeros(2).double()
    w = torch.tensor([2.0, 0.0, 0.0]).double()
    step = p.step(x, p.applied(torch.tensor([5.0])), w)
    torch.testing.assert_close(step, torch.tensor([0.06, 0.6]).double())


def test_signals_and_starts_have_their_distributions():
    p = ActuatorNoise(actuator_std=0.7, noise_std=0.1)
    for rng in (np.random.default_rng(0), torch.Generator().manual_seed(0)):
        w, x = p.signals(rng, 200, 50), p.starts(rng, 1000)
        assert w.mean((0, 1)).abs().max() < 0.03
        assert w.std((0, 1)).tolist() == pytest.approx([0.7, 0.1, 0.1], rel=0.03)
        assert x.shape == (1000, 2)
        assert x.abs().max() <= 1
        assert x.min(0).values.max() < -0.98
        assert x.max(0).values.min() > 0.98


def test_the_model_is_that_of_the_mean():
    p, (A, B, offset) = ActuatorNoise(), ActuatorNoise().true_model()
    x, u = torch.tensor([0.3, -0.2]).double(), torch.tensor([0.4]).double()
    w = p.signals(np.random.default_rng(0), 1, 20_000)[0]
    mean = p.step(x.expand(20_000, 2), u.expand(20_000, 1), w).mean(0)
    torch.testing.assert_close(mean, A @ x + B @ u + offset, atol=3e-3, rtol=0)


@pytest.mark.parametrize("name", ["actuator_std", "noise_std"])
def test_a_negative_deviation_is_refused(name):
    with pytest.raises(QPError, match=f"{name}: got -1, expected a finite number >= 0"):
        ActuatorNoise(**dict[str, Any]({name: -1}))


# The same with a hidden velocity


def test_the_window_predicts_the_position_but_for_the_noise():
    p = HiddenVelocity()
    x, u = torch.tensor([0.3, -0.2]).double(), torch.tensor([0.4]).double()
    w = p.signals(np.random.default_rng(0), 20_000, 1)[:, 0]
    moved = p.step(x.expand(20_000, 2), u.expand(20_000, 1), w)
    ahead = p.step(moved, u.expand(20_000, 1), w)
    A, B, offset = p.true_model()
    y = torch.stack((moved[:, 0], x[:1].expand(20_000)), -1)
    predicted = y @ A.mT + torch.cat((u, u)) @ B.mT + offset
    assert torch.equal(moved[:, :1], (x[:1] + 0.2 * x[1:]).expand(20_000, 1))
    torch.testing.assert_close(ahead[:, :1].mean(0), predicted.mean(0), atol=1e-3, rtol=0)
    error = ahead[:, 0] - predicted[:, 0]
    torch.testing.assert_close(error, 0.2 * (0.2 * 0.4 * w[:, 0] + w[:, 2]))


def test_the_optimal_gain_of_the_window_has_the_cost_of_its_riccati_equation():
    """In 200,000 steps; other gains cost more with the same noise."""
    p, gamma, step = HiddenVelocity(), 0.95, 0.2
    weight = noisy_stage_weight(p.A, p.B, p.W, gamma, torch.tensor([1.2]).double(), delay=1)
    P, K = riccati_weight(p.A, p.B, weight, gamma), lqr_gain(p.A, p.B, weight, gamma)

    def cost(K: torch.Tensor) -> float:
        def policy(window: torch.Tensor) -> torch.Tensor:
            before, u, y = window.split(1, -1)
            return -torch.cat((y, (y - before) / step + step * u), -1) @ K.mT

        return plant_loop(policy, p, steps=100, starts=2000, gamma=gamma).J_discounted

    seen = p.noise_std * p.A[:, 1]
    expected = P[0, 0] / 6 + gamma**2 / (1 - gamma) * seen @ P @ seen / 2
    assert cost(K) == pytest.approx(float(expected), rel=0.03)
    for i in range(2):
        for factor in (0.7, 1.3):
            other = K.clone()
            other[0, i] *= factor
            assert cost(other) > 1.005 * cost(K)


def test_a_horizon_that_no_action_reaches_is_refused():
    with pytest.raises(QPError, match="horizon: got 1, expected a whole number >= 2"):
        HiddenVelocity(horizon=1)
