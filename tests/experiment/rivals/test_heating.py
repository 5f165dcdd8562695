"""The houses' rivals: their order of costs, the filter, and the tuning of leap-c's planner."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.benchmarks.tuned_planner import differentiable_program, rollout, tune
from torch_qpmpc.envs import House, HouseWall
from torch_qpmpc.envs.closed_loop import plant_loop
from torch_qpmpc.envs.heated_house import GAIN
from torch_qpmpc.experiment.heating import known_model
from torch_qpmpc.experiment.rivals.heating import KalmanHouseMPC, Omniscient, Thermostat, house_mpc
from torch_qpmpc.experiment.rivals.tuned_planner import START, Knobs, planner


def J(policy, plant, starts=4, steps=96):
    return plant_loop(policy, plant, steps=steps, starts=starts, seed=3, gamma=1.0).J


def test_more_knowledge_costs_less_in_a_room():
    house = House()
    true = J(house_mpc(house, known_model(house)).policy, house)
    wrong = J(house_mpc(house, known_model(replace(house, R=2.0))).policy, house)
    assert J(Omniscient(house), house) < true < wrong < J(Thermostat(house, 0.5, 6.0), house)


def test_more_knowledge_costs_less_in_a_house_with_a_wall():
    house = HouseWall()
    omniscient, kalman = J(Omniscient(house), house), J(KalmanHouseMPC(house), house)
    assert omniscient < kalman < J(Thermostat(house, 0.5, 4.0), house)


def test_the_filter_finds_state_and_gain_from_the_air():
    """Drives the house by a plan of its own, with another wall than the filter assumes."""
    house = HouseWall()
    kalman = KalmanHouseMPC(house)
    rng = np.random.default_rng(0)
    w, x = house.signals(rng, 2, 96 + 33), house.starts(rng, 2)
    kalman.begin(house, x, w)
    w[..., GAIN] = 0.5
    for k in range(60):
        known = w[:, k : k + 33, : house.n_d].flatten(1)
        u = house.applied(kalman(torch.cat((known, x[:, :1]), -1)))
        x = house.step(x, u, w[:, k])
    # The filter's gain returns to zero between measurements, at the rate of its correlation.
    assert (kalman._x[:, 0] - x[:, 0]).abs().max() < 0.1
    assert (kalman._x[:, 2] - x[:, 2]).abs().max() < 0.3
    assert (kalman._x[:, 3] / 0.9 - 0.5).abs().max() < 0.1


def test_the_differentiable_planner_is_the_planner():
    house, knobs = House(), Knobs(1.5, 0.7, 0.4)
    qp = differentiable_program(house)(torch.tensor(knobs, dtype=torch.float64))
    for part, expected in zip(
        qp.tensors(), planner(house, knobs).quadratic_program().tensors(), strict=True
    ):
        torch.testing.assert_close(part, expected)


def test_the_rollout_s_gradient_is_that_of_finite_differences():
    house, step = House(horizon=12), 1e-5
    w = house.signals(np.random.default_rng(1), 1, 225)[0]
    program = differentiable_program(house)
    theta = torch.tensor([1.5, 0.6, 0.5], dtype=torch.float64, requires_grad=True)
    rollout(house, program(theta), w).backward()
    assert theta.grad is not None
    with torch.no_grad():
        for i, shift in enumerate(step * torch.eye(3).double()):
            ends = [rollout(house, program(theta + s * shift), w) for s in (1, -1)]
            slope = (ends[0] - ends[1]) / (2 * step)
            assert theta.grad[i].item() == pytest.approx(slope.item(), rel=2e-2, abs=1e-3)


def test_tuning_improves_the_planner():
    house = House(horizon=8)
    before, after = (J(planner(house, k).policy, house) for k in (START, tune(house, updates=3)))
    assert after < before
