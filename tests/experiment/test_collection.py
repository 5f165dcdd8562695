"""Batches of transitions under the newest policy."""

from typing import Any

import pytest
import torch

from tests.runs import SMALL, make_config
from torch_qpmpc import SolveLog
from torch_qpmpc.experiment.algorithms import make_collector, make_operator
from torch_qpmpc.experiment.tasks import make_mpc, make_physics
from torch_qpmpc.learning.operators import POLICY_ACTIVE_SET

NOISES = {"point_mass": "gaussian", "gros_zanon": "uniform", "pendulum": "none"}


@pytest.mark.parametrize("std", [0.3, 0.0])
@pytest.mark.parametrize("task", NOISES)
def test_a_collector_explores_about_the_policy_and_carries_active_sets(task, std):
    own = (f"task={task}", f"noise={NOISES[task]}", f"exploration_std={std}")
    cfg = make_config(*SMALL, *own, "num_envs=50", "steps_per_update=3")
    physics = make_physics(cfg)
    mpc = make_mpc(cfg, physics)
    policy = make_operator(mpc).get_policy_operator(POLICY_ACTIVE_SET)
    collector: Any = make_collector(cfg, physics, policy)
    torch.manual_seed(0)
    with SolveLog() as log:
        batches = [batch.clone() for batch, _ in zip(collector, range(6), strict=False)]
    collector.shutdown()
    data: Any = torch.cat(batches, dim=1)
    assert data.shape == (50, 18)
    assert POLICY_ACTIVE_SET not in {*data.keys(), *data["next"].keys()}
    assert log.recalled > 0.5 * log.solves
    best = mpc.policy(data["observation"]).detach()
    noise = (data["action"] - best)[best.abs() < 0.1]
    assert noise.std().item() == pytest.approx(std, rel=0.15, abs=1e-6)
