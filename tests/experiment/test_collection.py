"""Batches of transitions under the newest policy, from one process or several."""

import itertools
from typing import Any

import pytest
import torch

from tests.runs import SMALL, make_config
from torch_qpmpc import QPActorValueOperator, SolveLog
from torch_qpmpc.experiment.algorithms import make_collector
from torch_qpmpc.experiment.config import Config
from torch_qpmpc.experiment.tasks import make_mpc, make_physics
from torch_qpmpc.learning.operators import POLICY_ACTIVE_SET

NOISES = {"point_mass": "gaussian", "gros_zanon": "uniform", "pendulum": "none"}


def collect(cfg: Config, count: int) -> tuple[Any, Any]:
    """Collect ``count`` batches; return them and the policy's QP."""
    physics = make_physics(cfg)
    mpc = make_mpc(cfg, physics)
    collector = make_collector(cfg, physics, QPActorValueOperator(mpc).get_policy_operator())
    torch.manual_seed(0)
    try:
        found: list[Any] = [b.clone() for b in itertools.islice(collector, count)]
    finally:
        collector.shutdown()
    return torch.cat(found, dim=1), mpc


def test_a_collector_follows_the_policy_with_exploration():
    cfg = make_config(*SMALL, "num_envs=50", "steps_per_update=3", "seed=2")
    data, mpc = collect(cfg, 6)
    assert data.shape == (50, 18)
    assert data["step_count"].max() == 11, "episodes of 12 steps"
    best = mpc.policy(data["observation"]).detach()
    noise = (data["action"] - best)[best.abs() < 0.1]
    assert 0.25 < noise.std() < 0.35
    assert torch.equal(data["observation"], collect(cfg, 6)[0]["observation"])
    cfg.exploration_std = 0.0
    quiet, _ = collect(cfg, 6)
    assert torch.allclose(quiet["action"], mpc.policy(quiet["observation"]), atol=1e-6)
    other, _ = collect(make_config(*SMALL, "num_envs=50", "steps_per_update=3", "seed=3"), 1)
    assert not torch.equal(other["observation"][:, 0], quiet["observation"][:, 0])


@pytest.mark.parametrize("task", ["point_mass", "gros_zanon", "pendulum"])
def test_a_collector_carries_active_sets_from_step_to_step(task):
    cfg = make_config(*SMALL, f"task={task}", f"noise={NOISES[task]}", "steps_per_update=5")
    physics = make_physics(cfg)
    mpc = make_mpc(cfg, physics)
    policy = QPActorValueOperator(mpc).get_policy_operator(POLICY_ACTIVE_SET)
    collector: Any = make_collector(cfg, physics, policy)
    torch.manual_seed(0)
    try:
        with SolveLog() as log:
            for batch, _ in zip(collector, range(4), strict=False):
                assert POLICY_ACTIVE_SET not in batch
                assert POLICY_ACTIVE_SET not in batch["next"]
                last = batch["observation"][:, -1]
                carried = collector._carrier[POLICY_ACTIVE_SET]
                assert torch.equal(carried, mpc.solve(last).active)
    finally:
        collector.shutdown()
    assert log.recalled > 0.5 * log.solves
