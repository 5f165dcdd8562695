"""The integrator with actuator noise: dynamics, cost, signals and starts, by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from torch_qpmpc.envs import ActuatorNoise
from torch_qpmpc.errors import QPError


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
