"""MPC whose bounds are tightened by the covariance of the noise."""

from __future__ import annotations

import pytest
import torch
from torch.testing import assert_close

from tests.runs import make_config
from torch_qpmpc.envs import GrosZanonLTI, House, PointMass, TankReferences
from torch_qpmpc.envs.closed_loop import closed_loop
from torch_qpmpc.experiment.evaluation import rival_costs
from torch_qpmpc.experiment.heating import known_model
from torch_qpmpc.experiment.rivals import tightened
from torch_qpmpc.experiment.rivals.heating import house_mpc
from torch_qpmpc.experiment.rivals.tanks import reference_mpc
from torch_qpmpc.experiment.tasks import make_physics
from torch_qpmpc.mpc.tightening import tighten


@pytest.fixture
def covariances(monkeypatch) -> list[torch.Tensor]:
    """Record the covariances that a rival tightens by."""
    seen = []

    def record(mpc, covariances, *args, **kwargs):
        seen.append(covariances)
        tighten(mpc, covariances, *args, **kwargs)

    monkeypatch.setattr(tightened, "tighten", record)
    return seen


@pytest.mark.parametrize("task", ["point_mass", "gros_zanon", "house", "tank_references"])
def test_each_task_has_the_rival(task):
    cfg = make_config(f"task={task}", "rivals=[tightened]", "task.eval_steps=2")
    assert list(rival_costs(cfg, make_physics(cfg))) == ["tightened"]


def test_tightening_halves_the_cost_next_to_a_bound(monkeypatch):
    plant = GrosZanonLTI()
    J = closed_loop(tightened.gros_zanon(plant), plant, steps=30, starts=8).J
    monkeypatch.setattr(tightened, "tighten", lambda *args, **kwargs: None)
    assert 2 * J < closed_loop(tightened.gros_zanon(plant), plant, steps=30, starts=8).J


def test_a_random_walk_adds_up(covariances):
    plant = PointMass(noise_kind="brownian", noise_std=0.1)
    tightened.point_mass(plant)
    W = 0.01 * torch.eye(4).double()
    # The walk's 25 steps before and one more.
    assert_close(covariances[0][1], 26 * W)
    assert_close(covariances[0][0], 0 * W)


def test_the_gain_of_the_house_is_stationary(covariances):
    house = House(horizon=3)
    tightened.house(house)
    a, e = house.model()[0].item(), house.model()[2][0, -1].item()
    variance = house.gain_std**2
    assert_close(covariances[0][1].item(), e**2 * variance)
    expected = e**2 * variance * (a**2 + 2 * 0.9 * a + 1)
    assert_close(covariances[0][2].item(), expected)


def test_without_noise_nothing_is_tightened():
    plant = TankReferences()
    p = 5 + torch.arange(3 * plant.n_p).double().reshape(3, -1) % 7
    exact = reference_mpc(plant, plant.A, plant.B)
    assert_close(tightened.tank_references(plant)(p), exact(p))
    house = House(gain_std=0.0)
    p = torch.cat(
        (
            house.signals(torch.Generator().manual_seed(0), 2, 33)[..., :4].flatten(1),
            torch.full((2, 1), 17.5).double(),
        ),
        -1,
    )
    assert_close(tightened.house(house)(p), house_mpc(house, known_model(house)).policy(p))
