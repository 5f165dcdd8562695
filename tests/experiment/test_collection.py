"""Batches of transitions under the newest policy, from one process or several."""

from __future__ import annotations

import importlib.util
import itertools
import json
import signal
from typing import Any

import pytest
import torch
from omegaconf import DictConfig

import train
from tests.runs import SMALL, make_config
from tests.stops import go_on, stop
from torch_qpmpc import QPActorValueOperator, QPError, SolveLog
from torch_qpmpc.experiment.collection import batches, make_collector, num_columns
from torch_qpmpc.experiment.tasks import make_mpc, make_physics
from torch_qpmpc.learning.operators import POLICY_ACTIVE_SET

NOISES = {"point_mass": "gaussian", "gros_zanon": "uniform", "pendulum": "none"}


def collect(cfg: DictConfig, count: int) -> tuple[Any, Any]:
    """Collect ``count`` batches; return them and the policy's QP."""
    physics = make_physics(cfg)
    mpc = make_mpc(cfg, physics)
    collector = make_collector(cfg, physics, QPActorValueOperator(mpc).get_policy_operator())
    torch.manual_seed(0)
    try:
        found: list[Any] = [b.clone() for b in itertools.islice(batches(collector), count)]
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
            for batch, _ in zip(batches(collector), range(4), strict=False):
                assert POLICY_ACTIVE_SET not in batch
                assert POLICY_ACTIVE_SET not in batch["next"]
                last = batch["observation"][:, -1]
                carried = collector._carrier[POLICY_ACTIVE_SET]
                assert torch.equal(carried, mpc.solve(last).active)
    finally:
        collector.shutdown()
    assert log.recalled > 0.5 * log.solves


#: Collectors with environments in other processes.
ELSEWHERE = [
    pytest.param("multi", marks=pytest.mark.slow),
    pytest.param("ray", marks=pytest.mark.cluster),
]
WORKERS = ("collector.workers=2", "num_envs=4", "steps_per_update=5", "exploration_std=0")


@pytest.mark.parametrize("name", ELSEWHERE)
def test_workers_share_the_environments_and_follow_theta(name):
    if name == "ray":
        pytest.importorskip("ray", reason="the extra ray is not installed")
    cfg = make_config(*SMALL, f"collector={name}", *WORKERS)
    physics = make_physics(cfg)
    mpc = make_mpc(cfg, physics)
    policy = QPActorValueOperator(mpc).get_policy_operator(POLICY_ACTIVE_SET)
    collector = make_collector(cfg, physics, policy)
    stream = batches(collector)
    try:
        first = next(stream).clone()
        before = mpc.policy(first["observation"])
        with torch.no_grad():
            mpc.q.zero_() if "q" in mpc.learned else mpc.C.add_(0.3 * torch.randn_like(mpc.C))
        second = next(stream).clone()
    finally:
        collector.shutdown()
    assert first.shape == second.shape == (num_columns(cfg), 5) == (4, 5)
    torch.testing.assert_close(first["action"], before.detach())
    torch.testing.assert_close(second["action"], mpc.policy(second["observation"]).detach())
    assert not torch.allclose(mpc.policy(first["observation"]), before, atol=1e-3)
    # Each environment continues its episode, and no two are equal.
    torch.testing.assert_close(first["next", "observation"][:, -1], second["observation"][:, 0])
    assert len(first["observation"][:, 0].unique(dim=0)) == 4


@pytest.mark.parametrize("name", ELSEWHERE)
@pytest.mark.usefixtures("store_task")
def test_asynchronous_workers_return_batches_of_their_environments(
    tmp_path, monkeypatch, capsys, name
):
    """Each batch has the environments, here plants, of one of two workers, also on resume."""
    if name == "ray":
        pytest.importorskip("ray", reason="the extra ray is not installed")
    overrides = ("task=store", *SMALL, f"collector={name}", "collector.sync=false", "num_envs=4")
    more = ("constraint=si", "steps_per_update=5", "warmup_steps=10", "updates=6")
    cfg = make_config(*overrides, *more)
    assert num_columns(cfg) == 2
    seen = []
    monkeypatch.setattr(
        train, "batches", lambda collector: (seen.append(b.shape) or b for b in batches(collector))
    )
    assert stop(monkeypatch, cfg, tmp_path, 4) == 128 + signal.SIGTERM
    go_on(tmp_path)
    assert set(seen) == {(2, 5)}
    assert "Starting new episodes: the state of the env" in capsys.readouterr().out
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert (summary["updates"], summary["unsolved"]) == (6, 0)
    assert summary["J_final"] != summary["J_start"]


def test_ray_must_be_there(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    cfg = make_config(*SMALL, "collector=ray")
    with pytest.raises(
        QPError, match=r"collector: got ray, which is not installed, .* '\.\[ray\]'"
    ):
        collect(cfg, 1)
