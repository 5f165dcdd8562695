"""MPC whose bounds are tightened by the covariance of the noise."""

import pytest
import torch
from torch.testing import assert_close

from tests.runs import make_config
from torch_qpmpc.envs import GrosZanonLTI, PointMass
from torch_qpmpc.envs.closed_loop import closed_loop
from torch_qpmpc.experiment import rivals
from torch_qpmpc.experiment.evaluation import Evaluation
from torch_qpmpc.experiment.tasks import gros_zanon, make_mpc, make_physics, point_mass
from torch_qpmpc.mpc.tightening import tighten


@pytest.fixture
def covariances(monkeypatch) -> list[torch.Tensor]:
    seen = []

    def record(mpc, covariances, *args, **kwargs):
        seen.append(covariances)
        tighten(mpc, covariances, *args, **kwargs)

    monkeypatch.setattr(rivals, "tighten", record)
    return seen


@pytest.mark.parametrize("task", ["point_mass", "gros_zanon"])
def test_each_task_has_the_rival(task):
    cfg = make_config(f"task={task}", "rivals=[tightened]", "task.eval_steps=2")
    plant = make_physics(cfg)
    assert list(Evaluation.before(cfg, plant, make_mpc(cfg, plant)).rivals) == ["tightened"]


def test_tightening_halves_the_cost_next_to_a_bound(monkeypatch):
    plant = GrosZanonLTI()
    J = closed_loop(gros_zanon.tightened_mpc(plant), plant, steps=30, starts=8).J
    monkeypatch.setattr(rivals, "tighten", lambda *args, **kwargs: None)
    assert 2 * J < closed_loop(gros_zanon.tightened_mpc(plant), plant, steps=30, starts=8).J


def test_a_random_walk_adds_up(covariances):
    plant = PointMass(noise_kind="brownian", noise_std=0.1)
    point_mass.tightened_mpc(plant)
    W = 0.01 * torch.eye(4).double()
    # The walk's 25 steps before and one more.
    assert_close(covariances[0][1], 26 * W)
    assert_close(covariances[0][0], 0 * W)


def test_without_noise_nothing_is_tightened(covariances):
    plant = PointMass(noise_std=0.0)
    point_mass.tightened_mpc(plant)
    assert not covariances[0].any()
