"""MPC with a heavier action: its gain is that of the heavier regulator."""

from __future__ import annotations

import pytest
import torch
from torch.testing import assert_close

from torch_qpmpc.envs import ActuatorNoise
from torch_qpmpc.envs.actuator_noise import HiddenVelocity
from torch_qpmpc.experiment.rivals.heavier import heavier
from torch_qpmpc.mpc.regulator import lqr_gain


def test_its_gain_is_that_of_the_heavier_weight():
    plant = ActuatorNoise(horizon=3)
    (rival,) = heavier(9.0).values()
    W = plant.W.clone()
    W[-1, -1] *= 9
    x = 0.1 * torch.rand(5, 2, generator=torch.Generator().manual_seed(0)).double()
    K = lqr_gain(plant.A, plant.B, W)
    assert_close(rival.of(plant)[0](x), -x @ K.mT, rtol=1e-6, atol=1e-8)


def test_a_heavier_action_is_smaller_with_a_window():
    plant, p = HiddenVelocity(horizon=5), torch.tensor([[0.5, 0.0, 0.5]]).double()
    rivals = heavier(1.0, 10.0)
    assert [*rivals] == ["1 times the action's weight", "10 times the action's weight"]
    light, heavy = (rival.of(plant)[0](p).item() for rival in rivals.values())
    assert light < heavy < 0
    assert heavy == pytest.approx(light / 10**0.5, rel=0.5)
