"""start=data: logs of exploration, the schemes identified from them, and runs that start there."""

import functools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDictBase
from torch.testing import assert_close

import train
from tests.runs import SMALL, linear_system, make_config
from torch_qpmpc import QPError
from torch_qpmpc.experiment.config import Config
from torch_qpmpc.experiment.start import (
    LOG,
    OBSERVER,
    Exploration,
    collect_log,
    make_start,
    stored_log,
)
from torch_qpmpc.experiment.tasks import make_mpc, make_physics
from torch_qpmpc.experiment.tasks.gymnasium import given_scheme
from torch_qpmpc.experiment.tasks.identified import identified_start
from torch_qpmpc.identification.innovations import Innovations
from torch_qpmpc.mpc.riccati import affine_cost_to_go, riccati_weight
from torch_qpmpc.study.runs import FinishedRun

DATA = (*SMALL, "start=data", "start.transitions=200")
PENDULUM = (*DATA, "task=gymnasium", "task.id=Pendulum-v1", "constraint=free", "noise=none")
PENDULUM += ("task.start_episodes=0",)


@functools.cache
def _log(*settings: str) -> TensorDictBase:
    cfg = make_config(*settings)
    return collect_log(cfg, make_physics(cfg))


def log_of(*settings: str) -> TensorDictBase:
    """Return a copy of a log that is collected once."""
    return _log(*settings).clone()


def start_of(cfg: Config):
    physics: Any = make_physics(cfg)
    start = identified_start(cfg, physics, collect_log(cfg, physics))
    physics = physics.observed(start.observer)
    return physics, start, make_mpc(cfg, physics, start)


# Exploration


def test_exploration_holds_random_levels():
    low, high = torch.tensor([-1.0, 0.0]).double(), torch.tensor([1.0, 4.0]).double()
    explore = Exploration(low, high, 5.0, seed=0)
    actions = torch.stack([explore(torch.zeros(100, 3)) for _ in range(200)])
    assert actions.dtype == torch.float32
    assert ((actions >= low) & (actions <= high)).all()
    changes = (actions[1:] != actions[:-1]).double().mean()
    assert changes == pytest.approx(0.2, rel=0.1)
    assert len(actions.flatten(0, 1).unique(dim=0)) > 1000
    assert_close(actions.mean((0, 1)), torch.tensor([0.0, 2.0]), atol=0.1, rtol=0)
    again = Exploration(low, high, 5.0, seed=0)
    assert torch.equal(again(torch.zeros(100, 3)), actions[0])


def test_infinite_bounds_cannot_be_explored():
    low = torch.tensor([-torch.inf]).double()
    message = r"start: got actions from \[-inf\] to \[inf\], expected finite bounds to explore"
    with pytest.raises(QPError, match=message):
        Exploration(low, -low, 4.0, 0)


def test_a_log_is_of_the_runs_environments():
    cfg = make_config(*DATA, "num_envs=3", "replay_capacity=300")
    log = collect_log(cfg, make_physics(cfg))
    assert log.shape == (3, 67)
    assert log.get(("next", "done")).sum(1).flatten().tolist() == [5, 5, 5], "episodes of 12 steps"
    assert torch.equal(collect_log(cfg, make_physics(cfg))["action"], log["action"])
    cfg.seed = 2
    assert not torch.equal(collect_log(cfg, make_physics(cfg))["action"], log["action"])


# Schemes


@pytest.mark.parametrize("constraint", ["free", "mpc"])
def test_a_task_with_a_weight_gets_the_model_of_the_log(constraint):
    cfg = make_config(*DATA, "start.transitions=2000", f"constraint={constraint}")
    physics, start, mpc = start_of(cfg)
    A, B, _ = linear_system(cfg).true_model()
    for found, true in zip(start.model[:2], (A, B), strict=True):
        assert_close(torch.tensor(found), true, atol=0.02, rtol=0)
    assert torch.equal(mpc.C, mpc.C_0)
    assert_close(mpc.b, -torch.tensor(start.model.offset).repeat(mpc.horizon))
    other = make_mpc(cfg, physics)
    assert torch.equal(mpc.H, other.H)
    assert torch.equal(mpc.ub, other.ub)
    assert mpc.learned == other.learned


def test_a_weight_is_of_the_observations_where_the_log_s_model_has_hidden_states():
    """That model takes the place of the task's A and B, which have three states."""
    cfg = make_config("task=pendulum", "start=data")
    A, B, E, C = np.eye(5), np.zeros((5, 1)), np.zeros((5, 0)), np.eye(3, 5)
    rest = np.zeros(5), C, C.T, np.eye(3), np.zeros(5), np.eye(5)
    plant: Any = make_physics(cfg)
    scheme = given_scheme(cfg, plant.observed(Innovations(A, B, E, *rest)))
    weight = scheme.cost.stage_weight
    own = torch.tensor(cfg.task.stage_weight, dtype=torch.float64)
    assert torch.equal(weight[[0, 1, 2, 5]][:, [0, 1, 2, 5]], own)
    assert not weight[3:5].any()
    assert not weight[:, 3:5].any()
    assert scheme.layout.n_x == 5


@pytest.mark.usefixtures("store_task")
def test_a_plant_gives_its_signals():
    cfg = make_config(*DATA, "task=store", "constraint=free", "start.transitions=3000")
    plant, start, mpc = start_of(cfg)
    assert (mpc.n_x, mpc.n_d, mpc.horizon) == (plant.n_x, 2, 3)
    E = torch.tensor(start.model.E[:2])
    assert_close(E, torch.tensor([[0.0, -1.0], [0.0, 0.0]]).double(), atol=0.05, rtol=0)


@pytest.mark.parametrize("hessian", ["block", "diagonal"])
def test_a_task_without_a_weight_gets_the_cost_of_the_log(hessian):
    """The fitted cost of a trajectory is its predicted V, but for the part beyond the horizon."""
    settings = ("task.gamma=0.9", f"task.hessian={hessian}", "task.learn_cost=[H,H_f,q,c]")
    _, start, mpc = start_of(make_config(*PENDULUM, *settings))
    cost, log, n = mpc.scheme.cost, start.log, mpc.n_x
    assert start.cost is not None
    W, q = cost.stage_weight, cost.q
    v = torch.cat((log["observation"], log["action"]), dim=-1).double()
    dense = torch.diag(W) if W.ndim == 1 else W
    fitted = (v @ dense * v).sum(-1) / 2 + v @ q[: n + 1]
    error = fitted + log["next", "reward"][..., 0]
    assert error.std() < 0.5 * log["next", "reward"].std()
    stage, beyond = -error.mean(), 0.9**4 / 0.1 * -log["next", "reward"].double().mean()
    assert cost.c.item() == pytest.approx((stage * (1 + 0.9 + 0.81 + 0.729) + beyond).item())
    assert torch.equal(q[-n:], q[:n])
    assert torch.equal(cost.terminal_weight, W[:n] if W.ndim == 1 else W[:n, :n])


def test_a_terminal_weight_from_the_riccati_equation_is_that_of_the_fitted_cost():
    cfg = make_config(*PENDULUM, "task.terminal_weight=riccati", "task.gamma=0.9")
    _, start, mpc = start_of(cfg)
    A, B, _, offset = (torch.tensor(part) for part in start.model[:4])
    P = riccati_weight(A, B, start.cost.W, 0.9)
    assert_close(mpc.H_f.double(), P)
    p, c = affine_cost_to_go(A, B, offset, start.cost.W, start.cost.q, P, 0.9)
    assert_close(mpc.q[-mpc.n_x :].double(), p)
    assert_close(mpc.c.double(), 10 * start.cost.c + 0.9**3 * c)


def test_the_order_and_the_fit_of_the_cost_are_shown():
    cfg = make_config(*PENDULUM, "start.transitions=1000")
    _, start, mpc = start_of(cfg)
    R2 = start.cost.R2
    assert f"stage cost fitted to the rewards: R2 {R2:.3f}" in str(start)
    assert start.summary == {"log_episodes_cut": 0, "order": mpc.n_x, "R2_cost": R2}


def test_episodes_that_blow_up_are_cut_and_counted():
    cfg, log = make_config(*PENDULUM), log_of(*PENDULUM)
    physics = make_physics(cfg)
    shorter = identified_start(cfg, physics, log[:, :40])
    for key in ("observation", ("next", "observation"), ("next", "reward")):
        log[key][:, 40:] = torch.nan  # of the fourth episode and of all later ones
    start = identified_start(cfg, physics, log)
    assert start.cut == 4 * 2
    assert str(start).startswith("Episodes of the log that blow up, and are cut there: 8\n")
    assert_close(start.model.A, shorter.model.A)
    assert_close(start.cost.W, shorter.cost.W)


def test_a_log_without_rewards_needs_a_weight():
    cfg, log = make_config(*PENDULUM), log_of(*PENDULUM)
    physics = make_physics(cfg)
    message = r"stage_weight: got none, and a log without rewards, expected .* task\.stage_weight"
    with pytest.raises(QPError, match=message):
        identified_start(cfg, physics, log.exclude(("next", "reward")))


# Runs


def test_the_log_is_kept_read_and_shown(tmp_path, capsys):
    cfg = make_config(*DATA)
    train.train(cfg, str(tmp_path / "first"))
    assert "Model of order 4, with poles" in capsys.readouterr().out
    log = stored_log(tmp_path / "first" / LOG)
    assert torch.equal(log["action"], collect_log(cfg, make_physics(cfg))["action"])
    run = FinishedRun(tmp_path / "first")
    assert torch.equal(run.start.C, start_of(cfg)[2].C)
    assert not torch.equal(run.policy.C, run.start.C)
    cfg = make_config(*DATA, f"start.file={tmp_path / 'first' / LOG}", "seed=9")
    train.train(cfg, str(tmp_path / "second"), quiet=True)
    assert torch.equal(FinishedRun(tmp_path / "second").start.C, run.start.C)
    assert "Model of order" not in capsys.readouterr().out


def test_the_observer_of_a_run_that_ended_before_its_settings_is_removed(tmp_path):
    """A later run in its folder went on with that observer."""
    old = tmp_path / OBSERVER
    old.touch()
    cfg = make_config(*SMALL)
    assert make_start(cfg, make_physics(cfg), tmp_path) is None
    assert not old.exists()


def test_damaged_logs_are_named(tmp_path):
    cfg = make_config(*DATA, f"start.file={tmp_path / 'log.pt'}")
    physics, steps = make_physics(cfg), torch.zeros(3, 1)
    for content, message in (
        (None, r"start\.file: got .*, which cannot be read \(FileNotFoundError\), expected a log"),
        (b"text", r"start\.file: got .*log\.pt, which cannot be read \(BadZipFile\)"),
        ({"observation": steps}, r"start\.file: got .*log\.pt \('action'\), expected a log\.pt"),
        ({"action": steps, "observation": steps}, r"log\.pt \(.*\"next\" not found.*guides"),
        ({"action": steps, "observation": steps[:2]}, r"log\.pt \(batch dimension mismatch"),
    ):
        if isinstance(content, bytes):
            Path(cfg.start.file).write_bytes(content)
        elif content is not None:
            torch.save(content, cfg.start.file)
        with pytest.raises(QPError, match=message):
            make_start(cfg, physics, tmp_path)
    with pytest.raises(QPError, match=r"^log\.pt: got .*log\.pt, which cannot be read .*wrote\.$"):
        stored_log(tmp_path / "gone" / LOG)
    assert make_start(make_config(), physics, tmp_path) is None
