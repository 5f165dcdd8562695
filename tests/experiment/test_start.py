"""start=data: logs of exploration, the schemes identified from them, and runs that start there."""

from __future__ import annotations

import functools
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.envs.registration import EnvSpec
from omegaconf import DictConfig
from tensordict import TensorDictBase
from torch.testing import assert_close

import train
from tests.runs import SMALL, linear_system, make_config
from torch_qpmpc import QPError
from torch_qpmpc.experiment.config import check_config
from torch_qpmpc.experiment.start import LOG, Exploration, collect_log, make_start, stored_log
from torch_qpmpc.experiment.tasks import make_mpc, make_physics
from torch_qpmpc.experiment.tasks.identified import identified_start, observed_cost
from torch_qpmpc.mpc import stage_cost
from torch_qpmpc.mpc.layout import Layout
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


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fit costs roughly: tests/mpc/test_stage_cost.py compares the fits."""
    monkeypatch.setattr(stage_cost, "ITERATIONS", 50)


def start_of(cfg: DictConfig):
    check_config(cfg)
    physics = make_physics(cfg)
    start = identified_start(cfg, physics, collect_log(cfg, physics))
    return physics, start, make_mpc(cfg, physics, start)


# Exploration


@pytest.mark.parametrize("binary", [False, True])
def test_exploration_holds_random_levels(binary):
    low, high = torch.tensor([-1.0, 0.0]).double(), torch.tensor([1.0, 4.0]).double()
    explore = Exploration(low, high, 5.0, binary, seed=0)
    actions = torch.stack([explore(torch.zeros(100, 3)) for _ in range(200)])
    assert actions.dtype == torch.float32
    assert ((actions >= low) & (actions <= high)).all()
    changes = (actions[1:] != actions[:-1]).double().mean()
    # A new level of a binary signal is the old one half of the time.
    assert changes == pytest.approx(0.1 if binary else 0.2, rel=0.1)
    levels = actions.flatten(0, 1).unique(dim=0)
    assert len(levels) == 4 if binary else len(levels) > 1000
    assert_close(actions.mean((0, 1)), torch.tensor([0.0, 2.0]), atol=0.1, rtol=0)
    again = Exploration(low, high, 5.0, binary, seed=0)
    assert torch.equal(again(torch.zeros(100, 3)), actions[0])


def test_infinite_bounds_cannot_be_explored():
    low = torch.tensor([-torch.inf]).double()
    message = r"start: got actions from \[-inf\] to \[inf\], expected finite bounds to explore"
    with pytest.raises(QPError, match=message):
        Exploration(low, -low, 4.0, False, 0)


def test_a_log_is_of_the_runs_environments():
    cfg = make_config(*DATA, "num_envs=3")
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
    model = start.identified.model
    assert_close(model.A, A, atol=0.02, rtol=0)
    assert_close(model.B, B, atol=0.02, rtol=0)
    assert torch.equal(mpc.C, start.identified.constraints.C)
    assert_close(mpc.b, start.identified.constraints.b)
    other = make_mpc(cfg, physics)
    assert torch.equal(mpc.H, other.H)
    assert torch.equal(mpc.ub, other.ub)
    assert mpc.learned == other.learned


@pytest.mark.usefixtures("store_task")
def test_a_plant_gives_its_window_and_its_signals():
    cfg = make_config(*DATA, "task=store", "constraint=free", "start.transitions=3000")
    _, start, mpc = start_of(cfg)
    assert (mpc.n_x, mpc.past, mpc.n_d, mpc.horizon) == (1, 2, 2, 3)
    assert start.identified.R2.min() > 0.9
    # The level's noise shrinks the coefficients of the level but not those of the inputs.
    assert_close(start.identified.model.E, torch.tensor([[0.0, -1.0]]).double(), atol=0.05, rtol=0)


@pytest.mark.parametrize("hessian", ["block", "diagonal", "full"])
@pytest.mark.parametrize("task", ["pendulum", "store"])
@pytest.mark.usefixtures("store_task")
def test_a_task_without_a_weight_gets_the_cost_of_the_log(task, hessian):
    """The fitted cost of a trajectory is its predicted V, but for the part beyond the horizon."""
    names = PENDULUM if task == "pendulum" else (*DATA, "task=store")
    learn = "[H,q,c]" if hessian == "full" else "[H,H_f,q,c]"
    settings = ("task.gamma=0.9", f"task.hessian={hessian}", f"task.learn_cost={learn}")
    cfg = make_config(*names, *settings)
    log = log_of(*names)
    n_d, n_y, past = (2, 1, 2) if task == "store" else (0, 3, 1)
    sizes = Layout(n_y, 1, 3, past, n_d)
    cost = observed_cost(cfg, log, sizes)
    W, q = cost.stage_weight, cost.q
    y = log["observation"][..., -n_y:]
    known = [log["preview"][..., :n_d]] if n_d else []
    v = torch.cat((*known, y, log["action"]), dim=-1).double()
    W = torch.diag(torch.nn.functional.pad(W, (n_d, 0))) if W.ndim == 1 else W
    d, u = q[:n_d], q[sizes.n_p : sizes.n_p + 1]
    linear = torch.cat((d, q[sizes.n_before : sizes.n_p], u))
    fitted = (v @ W * v).sum(-1) / 2 + v @ linear
    error = fitted + log["next", "reward"][..., 0]
    assert error.std() < 0.5 * log["next", "reward"].std()
    stage, beyond = -error.mean(), 0.9**4 / 0.1 * -log["next", "reward"].double().mean()
    assert cost.c.item() == pytest.approx((stage * (1 + 0.9 + 0.81 + 0.729) + beyond).item())
    assert torch.equal(q[-n_y:], q[sizes.n_before : sizes.n_p])
    n = n_d + n_y
    if hessian == "diagonal":
        assert torch.equal(cost.terminal_weight, cost.stage_weight[:n_y])
    else:
        assert torch.equal(cost.terminal_weight, W[:n, :n])


def test_a_terminal_weight_from_the_riccati_equation_is_that_of_the_fitted_cost():
    cfg = make_config(*PENDULUM, "task.terminal_weight=riccati", "task.gamma=0.9")
    _, start, mpc = start_of(cfg)
    cost = observed_cost(cfg, start.log, start.identified.options.layout, start.cost)
    A, B, _, offset = start.identified.model
    P = riccati_weight(A, B, cost.stage_weight, 0.9)
    assert_close(mpc.H_f.double(), P)
    q = cost.q[:4]  # past=1, and no preview
    p, c = affine_cost_to_go(A, B, offset, cost.stage_weight, q, P, 0.9)
    assert_close(mpc.q[-3:].double(), p)
    assert start.cost is not None
    assert_close(mpc.c.double(), 10 * start.cost.now.c + 0.9**3 * c)


def test_the_fit_of_the_cost_is_shown():
    cfg = make_config(*PENDULUM, "start.transitions=1000")
    _, start, _ = start_of(cfg)
    assert start.cost is not None
    assert start.cost.after is not None
    assert str(start).splitlines()[-1] == str(start.cost)
    R2 = {"R2_cost": start.cost.now.R2, "R2_cost_next": start.cost.after.R2}
    assert start.summary == {"log_episodes_cut": 0, **R2, "cost_of_next": start.cost.shifted}


def test_episodes_that_blow_up_are_cut_and_counted():
    cfg, log = make_config(*PENDULUM), log_of(*PENDULUM)
    physics = make_physics(cfg)
    shorter = identified_start(cfg, physics, log[:, :40])
    for key in ("observation", ("next", "observation"), ("next", "reward")):
        log[key][:, 40:] = torch.nan  # of the fourth episode and of all later ones
    start = identified_start(cfg, physics, log)
    assert start.cut == 4 * 2
    assert str(start).startswith("Episodes of the log that blow up, and are cut there: 8\n")
    assert_close(start.identified.constraints.C, shorter.identified.constraints.C)
    layout = Layout(3, 1, 3)
    costs = [observed_cost(cfg, x.log, layout).c for x in (start, shorter)]
    assert_close(*costs)


def test_a_log_without_rewards_needs_a_weight():
    cfg, log = make_config(*PENDULUM), log_of(*PENDULUM)
    message = "stage_weight: got none, and a log with rewards of NaN or inf, expected a weight"
    log["next", "reward"][0, 3] = torch.nan
    with pytest.raises(QPError, match=message):
        observed_cost(cfg, log, Layout(3, 1, 3))
    message = r"stage_weight: got none, and a log without rewards, expected .* task\.stage_weight"
    with pytest.raises(QPError, match=message):
        observed_cost(cfg, log.exclude(("next", "reward")), Layout(3, 1, 3))


# Runs


def test_a_run_from_data_starts_well(tmp_path):
    """The point mass with its own cost starts near the MPC with the true model."""
    settings = ("updates=2", "start.transitions=2000", "constraint=fixed", "task.eval_steps=50")
    summary = train.train(make_config(*DATA, *settings, "seed=5"), str(tmp_path))
    wrong = train.train(
        make_config(*SMALL, "updates=2", "constraint=fixed", "task.eval_steps=50", "seed=5"),
        str(tmp_path / "wrong"),
    )
    assert summary["J_start"] < 0.5 * (wrong["J_start"] + summary["J_true_model"])


def test_the_log_is_kept_read_and_shown(tmp_path, capsys):
    cfg = make_config(*DATA)
    train.train(cfg, str(tmp_path / "first"))
    assert "free C from 200 transitions in" in capsys.readouterr().out
    log = stored_log(tmp_path / "first" / LOG)
    assert torch.equal(log["action"], collect_log(cfg, make_physics(cfg))["action"])
    run = FinishedRun(tmp_path / "first")
    assert torch.equal(run.start.C, start_of(cfg)[2].C)
    assert not torch.equal(run.policy.C, run.start.C)
    cfg = make_config(*DATA, f"start.file={tmp_path / 'first' / LOG}", "seed=9")
    train.train(cfg, str(tmp_path / "second"), quiet=True)
    assert torch.equal(FinishedRun(tmp_path / "second").start.C, run.start.C)
    assert not capsys.readouterr().out.startswith("free C")


class Walk(gymnasium.Env):
    """A noisy integrator whose reward is of the next observation."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (1,), np.float64)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float64)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.y = self.np_random.standard_normal(1)
        return self.y, {}

    def step(self, action):
        self.y = self.y + action + 0.3 * self.np_random.standard_normal(1)
        return self.y, -float(self.y.item() ** 2 + 0.1 * action.item() ** 2), False, False, {}


def test_a_reward_of_the_next_observation_gets_a_cost_of_it(tmp_path, monkeypatch):
    monkeypatch.setitem(gymnasium.registry, "Walk-v0", EnvSpec("Walk-v0", lambda **_: Walk()))
    settings = ("task.id=Walk-v0", "start.transitions=1000", "constraint=free", "rivals=true")
    summary = train.train(make_config(*PENDULUM, *settings), str(tmp_path), quiet=True)
    assert summary["cost_of_next"]
    assert summary["R2_cost_next"] == pytest.approx(1)
    assert summary["J_start"] < 0.7 * summary["rivals"]["zero action"]
    start = FinishedRun(tmp_path).start
    H = start.quadratic_program().H.diagonal()
    assert_close(H[:3], torch.tensor([0.0, 0.2, 2.0]).double(), atol=1e-6, rtol=1e-6)


def test_damaged_logs_are_named(tmp_path):
    cfg = make_config(*DATA, f"start.file={tmp_path / 'log.pt'}")
    physics = make_physics(cfg)
    for content, message in (
        (None, r"start\.file: got .*log\.pt, which does not exist, expected a log\.pt that"),
        ({"observation": torch.zeros(3)}, r"start\.file: got .*log\.pt, without actions, expected"),
        (b"text", r"start.file: got .*log\.pt, which cannot be read"),
    ):
        if isinstance(content, bytes):
            Path(cfg.start.file).write_bytes(content)
        elif content is not None:
            torch.save(content, cfg.start.file)
        with pytest.raises(QPError, match=message):
            make_start(cfg, physics, tmp_path, written=False)
    assert make_start(make_config(), physics, tmp_path, written=False) is None
