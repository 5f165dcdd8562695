"""The choice of a start by closed loops, zero action if nothing is better, and its resumption."""

from __future__ import annotations

import copy
import signal
from functools import partial
from typing import Any

import gymnasium
import numpy as np
import pandas as pd
import pytest
import torch
from gymnasium.envs.registration import EnvSpec
from torch.testing import assert_close

import train
from tests.runs import SMALL, make_config, run_command
from tests.stops import stop
from torch_qpmpc import QPError
from torch_qpmpc.envs.closed_loop import gymnasium_loop
from torch_qpmpc.experiment import choosing
from torch_qpmpc.experiment.algorithms import evaluate
from torch_qpmpc.experiment.choosing import (
    BLENDED,
    ESTIMATE,
    FIRST,
    OUTPUTS,
    STARTS,
    Choice,
    below,
    candidates,
    choose,
    chosen_before,
)
from torch_qpmpc.experiment.logs import estimated
from torch_qpmpc.experiment.rivals import ZERO_ACTION
from torch_qpmpc.experiment.start import OBSERVER, collect_log, learning_start, make_start
from torch_qpmpc.experiment.tasks import make_mpc, make_physics
from torch_qpmpc.identification.steps import valid_steps
from torch_qpmpc.learning.operators import warm_policy
from torch_qpmpc.mpc.riccati import terminal_riccati
from torch_qpmpc.study.runs import FinishedRun


class Lag(gymnasium.Env):
    """A lag with noise, to be kept at zero by inputs that cost ``price`` times their size."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (1,), np.float64)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float64)

    def __init__(self, gain=1.0, price=0.1):
        self.gain, self.price = gain, price

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.y = 3 * self.np_random.choice([-1.0, 1.0], 1)
        return self.y, {}

    def step(self, action):
        self.y = 0.9 * self.y + self.gain * action + 0.1 * self.np_random.standard_normal(1)
        cost = self.y.item() ** 2 + self.price * np.abs(action).item()
        return self.y, -cost, False, False, {}


DATA = (*SMALL, "start=data", "start.transitions=400", "task=gymnasium", "task.id=Lag-v0")
DATA += ("noise=none", "task.start_episodes=2")
BOUNDED = "task.observation_bounds=true"
#: Zero action is best: the input does next to nothing and is expensive.
HOPELESS = (*DATA, "task.kwargs={gain: 0.001, price: 100}")


def plant_is(monkeypatch, kind):
    make = lambda **kwargs: kind(**kwargs)  # noqa: E731 (an entry point)
    monkeypatch.setitem(gymnasium.registry, "Lag-v0", EnvSpec("Lag-v0", make))


@pytest.fixture(scope="module")
def known_starts() -> dict[tuple[Any, ...], dict[str, Any]]:
    return {}


@pytest.fixture(autouse=True)
def _plant(monkeypatch, known_starts):
    """Make the plant a lag, and fit the starts of the same settings and log once."""

    def once(cfg, physics, log):
        key = repr(cfg), log["observation"].numpy().tobytes()
        if key not in known_starts:
            known_starts[key] = candidates(cfg, physics, log)
        return copy.deepcopy(known_starts[key])

    plant_is(monkeypatch, Lag)
    monkeypatch.setattr(choosing, "candidates", once)


def chosen(*overrides):
    cfg = make_config(*overrides)
    physics: Any = make_physics(cfg)
    log = collect_log(cfg, physics)
    logs: Any
    start, logs = choose(cfg, physics, log, partial(collect_log, cfg, physics))
    assert start.choice is not None
    assert torch.equal(logs[: len(log)]["action"], log["action"])
    assert len(logs) == 2 * len(log)
    return cfg, physics, start, start.choice


def start_of(cfg, physics):
    """Return the MPC of a log, with zero action held."""
    start = candidates(cfg, physics, collect_log(cfg, physics))[OUTPUTS]
    return start._replace(action=torch.zeros(1, dtype=torch.float64))


def test_the_candidates_have_the_regulators_cost(monkeypatch):
    plant_is(monkeypatch, Swing)
    cfg = make_config(*DATA)
    physics: Any = make_physics(cfg)
    log = collect_log(cfg, physics)
    named = candidates(cfg, physics, log)
    assert [*named] == [ESTIMATE, OUTPUTS]
    assert [start.order > 1 for start in named.values()] == [True, False]
    for start in named.values():
        mpc = make_mpc(cfg, start.plant(physics), start)
        assert start.cost is not None
        A, B = (torch.tensor(part) for part in start.model[:2])
        P = terminal_riccati(A, B, start.cost.W, mpc.gamma, mpc.layout)
        assert_close(mpc.H_f.double(), P, rtol=1e-6, atol=1e-6)
    diagonal = make_config(*DATA, "task.hessian=diagonal")
    assert not any(start.riccati for start in candidates(diagonal, physics, log).values())


def test_a_start_that_costs_less_than_zero_action_is_chosen():
    cfg, _, start, choice = chosen(*DATA, "task.start_episodes=6")
    rows = choice.table
    assert start.action is None
    assert {OUTPUTS, f"{OUTPUTS}{FIRST}", ZERO_ACTION} <= {*rows.index}
    assert rows.episodes[choice.name] == rows.episodes[ZERO_ACTION] == 6
    assert rows.J[choice.name] < rows.J[ZERO_ACTION]
    assert rows.episodes.tolist()[:3] == [6, 6, 6]
    steps = rows.episodes.sum() * cfg.task.eval_steps
    assert start.summary["start_transitions"] == steps
    assert f"{steps:,} transitions beside the logs'" in str(choice)


def test_the_second_log_is_the_policys_with_exploration():
    cfg = make_config(*DATA)
    physics: Any = make_physics(cfg)
    log = collect_log(cfg, physics)
    start = candidates(cfg, physics, log)[OUTPUTS]
    second = collect_log(cfg, physics, start)
    assert second.shape == log.shape
    y, u = second["observation"], second["action"]
    assert u.abs().max() <= 1
    assert torch.equal(
        y[:, 1:][~second["next", "done"][:, :-1, 0]],
        second["next", "observation"][:, :-1][~second["next", "done"][:, :-1, 0]],
    )
    x = estimated(second, start.model)["observation"]
    policy = make_mpc(cfg, start.plant(physics), start).policy
    away = u.double() - policy(x.flatten(0, 1)).reshape(u.shape)
    assert 0.05 < away.std() < 0.3
    assert away.abs().max() < 0.3 + 1e-6
    assert y.square().mean() < 0.7 * log["observation"].square().mean()


def test_a_log_of_ones_own_is_the_first_one(tmp_path):
    """It has other episodes, steps and entries than the second, and the run resumes with both."""
    cfg = make_config(*DATA)
    physics: Any = make_physics(cfg)
    whole: Any = collect_log(cfg, physics).select("observation", "action", "next")
    own = whole[:1, :50].reshape(5, 10)
    torch.save(own.exclude(("next", "truncated")).to_dict(), tmp_path / "own.pt")
    cfg.start.file = str(tmp_path / "own.pt")
    start = make_start(cfg, physics, tmp_path / "run", written=False)
    again = make_start(cfg, physics, tmp_path / "run", written=True)
    assert start is not None
    assert again is not None
    assert again.choice is not None
    assert start.choice is not None
    pd.testing.assert_frame_equal(again.choice.table, start.choice.table, check_names=False)
    np.testing.assert_array_equal(again.model.A, start.model.A)
    logs = below(own, own[..., :-1])
    assert len(logs) == 2 * 5
    assert (~valid_steps(logs)).sum() == 5


def test_zero_action_is_held_if_nothing_costs_less(tmp_path):
    cfg, physics, start, choice = chosen(*HOPELESS)
    choice.write(tmp_path)
    again: Any = chosen_before(cfg, physics, start.log, tmp_path)
    assert start.action is not None
    assert torch.equal(again.action, start.action)
    assert choice.name == start.summary["start"] == ZERO_ACTION
    assert choice.scheme != ZERO_ACTION
    plant: Any = start.plant(physics)
    s = 3 * torch.randn(16, plant.n_x, dtype=torch.float64)
    assert make_mpc(cfg, plant, start).policy(s).abs().max() < 1e-12
    cfg.gate = False
    assert learning_start(cfg, start) is start
    cfg.gate = True
    assert make_mpc(cfg, plant, learning_start(cfg, start)).policy(s).abs().max() > 1e-3


def test_the_gate_keeps_the_held_action(tmp_path):
    settings = ("gate=true", "constraint=mpc", "optimizer=gauss_newton", BOUNDED)
    cfg = make_config(*HOPELESS, *settings, "eval_interval=4")
    summary = train.train(cfg, str(tmp_path), quiet=True)
    assert summary["start"] == ZERO_ACTION
    assert summary["J_best"] == summary["J_start"] < summary["J_final"]


@pytest.mark.parametrize("hessian", ["block", "diagonal"])
def test_a_held_action_has_a_cost_of_its_own(hessian):
    """V is the log's mean cost ahead, and Q is above it by 1/2 (u - action)'R(u - action)."""
    bounds = ("task.observation_bounds=true", "task.gamma=0.9")
    cfg = make_config(*DATA, *bounds, f"task.hessian={hessian}", "task.learn_cost=[H,H_f,q,c]")
    physics: Any = make_physics(cfg)
    log = collect_log(cfg, physics)
    start = start_of(cfg, physics)
    physics = start.plant(physics)
    s = torch.randn(8, physics.n_x, dtype=torch.float64)
    assert make_mpc(cfg, physics, start).policy(s).abs().max() < 1e-12, "rounding alone"
    action = torch.tensor([0.25], dtype=torch.float64)
    mpc = make_mpc(cfg, physics, start._replace(action=action))
    assert_close(mpc.policy(s), action.expand(8, 1), atol=1e-7, rtol=0)
    costs = -log.get(("next", "reward")).double()
    assert_close(mpc.value(s), (10 * costs.mean()).expand(8), atol=1e-5, rtol=0)
    R = costs.abs().mean() / (log["action"] - 0.25).abs().max().double().square()
    blind = start._replace(log=log.exclude(("next", "reward")), cost=None)
    weighted = make_config(*DATA, "task.stage_weight=[[1,0],[0,1]]")
    assert make_mpc(weighted, physics, blind).policy(s).abs().max() < 1e-12
    difference = mpc.action_value(s, action.expand(8, 1) + 0.5) - mpc.value(s)
    assert_close(difference, (R / 8).expand(8), rtol=1e-4, atol=0)


def trained(cfg, folder) -> FinishedRun:
    """Train; the files have the policies that were evaluated."""
    summary, run = train.train(cfg, str(folder), quiet=True), FinishedRun(folder)
    for name, policy in (("J_start", run.start), ("J_best", run.policy)):
        J = evaluate(cfg, warm_policy(policy), run.physics).J
        assert summary[name] == pytest.approx(J, rel=1e-9)
    return run


class Turning(Lag):
    """A lag whose gain changes its sign between the starts and zero."""

    def step(self, action):
        self.y = 0.95 * self.y + 0.5 * np.cos(self.y) * action
        return self.y, -(self.y.item() ** 2), False, False, {}


@pytest.fixture
def turning(monkeypatch):
    plant_is(monkeypatch, Turning)


@pytest.mark.usefixtures("turning")
def test_a_run_starts_from_blended_models_and_its_file_has_them(tmp_path):
    settings = ("optimizer=gauss_newton", "constraint=mpc")
    run = trained(make_config(*DATA, *settings), tmp_path)
    assert run.summary["start"].startswith(BLENDED)
    assert run.policy.schedule is not None
    assert run.start.schedule is not None


@pytest.mark.usefixtures("turning")
@pytest.mark.parametrize(("si", "there"), [("null", True), ("{beta: 1.0, windows: 2}", False)])
def test_blended_models_are_no_start_of_a_run_that_needs_one_C(si, there):
    cfg = make_config(*DATA, f"constraint.si={si}")
    physics: Any = make_physics(cfg)
    named = candidates(cfg, physics, collect_log(cfg, physics))
    assert any("blended" in name for name in named) == there


class Swing(Lag):
    """A swing, of which only the position is measured."""

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.rate = 0.0
        return self.y, {}

    def step(self, action):
        self.rate = 0.97 * self.rate - 0.3 * self.y + 0.5 * action
        self.y = self.y + 0.3 * self.rate
        return self.y, -(self.y.item() ** 2), False, False, {}


@pytest.fixture
def swing(monkeypatch):
    plant_is(monkeypatch, Swing)


@pytest.mark.usefixtures("swing")
def test_a_run_estimates_a_hidden_state_and_resumes_with_the_start_that_it_has_chosen(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(choosing, "candidates", candidates)
    settings = ("task.eval_steps=30", "task.gamma=1.0", "constraint=mpc", "eval_interval=4")
    cfg, whole, cut = make_config(*DATA, *settings), tmp_path / "whole", tmp_path / "cut"
    run = trained(cfg, whole)
    plant: Any = run.physics
    assert run.observer is not None
    assert plant.n_x == run.policy.n_x == run.summary["order"] == len(run.observer.A) >= 2
    assert run.summary["J_start"] < 25, "16 with both states known, 37 by feedback of the position"
    assert "constraint=mpc" in repr(run)
    for seed in (5, 6):  # run.predict holds the filter
        loop, env = gymnasium_loop(run.policy.policy, plant, starts=1, seed=seed), plant.make()
        (y, _), costs = env.reset(seed=seed), []
        for k in range(len(loop.costs)):
            y, reward, *_ = env.step(run.predict(y, begins=k == 0))
            costs.append(-float(reward))
        assert costs == pytest.approx(loop.costs[:, 0].tolist(), rel=1e-6, abs=1e-9)
    assert repr(FinishedRun(tmp_path)) == f"<run {tmp_path}>", "without a run"
    with pytest.raises(QPError, match=r"observation: got shape \(4,\), expected shape"):
        run.predict(np.zeros(4))
    assert stop(monkeypatch, cfg, cut, 3) == 128 + signal.SIGTERM
    assert (cut / STARTS).read_bytes() == (whole / STARTS).read_bytes()
    (cut / STARTS).rename(tmp_path / STARTS)
    with pytest.raises(SystemExit, match=r"starts\.csv: got .*No such file.* Start a new run"):
        run_command(*DATA, *settings, f"hydra.run.dir={cut}")
    (tmp_path / STARTS).rename(cut / STARTS)
    with monkeypatch.context() as patch:
        patch.setattr("torch_qpmpc.experiment.start.choose", None)
        run_command(*DATA, *settings, f"hydra.run.dir={cut}")
    resumed = FinishedRun(cut)
    constants = [x.policy.c.item() for x in (run, resumed)]
    assert constants[0] != run.start.c.item(), "it is corrected after the warm-up"
    assert constants[0] == constants[1]
    for key in ("J_start", "J_best", "start", "start_transitions"):
        assert run.summary[key] == resumed.summary[key]
    assert torch.equal(run.start.C, resumed.start.C)
    (whole / OBSERVER).write_bytes(b"text")
    with pytest.raises(QPError, match=r"path: got .*observer\.pt, which cannot be read"):
        _ = FinishedRun(whole).physics


def table(*rows: tuple[Any, ...], names: list[str]) -> pd.DataFrame:
    return pd.DataFrame(rows, names, ["episodes", "J", "error", "transitions", "chosen"])


def test_the_table_is_kept_and_damage_is_named(tmp_path):
    rows = (4, 2.0, 0.0, 40, False), (4, 0.1 + 0.2, 1 / 3, 40, True)
    choice = Choice(table(*rows, names=[ZERO_ACTION, "a, b"]))
    choice.write(tmp_path)
    again = Choice.read(tmp_path)
    assert again.summary == {"start": "a, b", "start_transitions": 80}
    assert again.scheme == "a, b"
    pd.testing.assert_frame_equal(again.table, choice.table, check_names=False, check_exact=True)
    again.table["chosen"] = False
    again.write(tmp_path)
    with pytest.raises(QPError, match=r"starts\.csv: got .*expected the table of starts"):
        Choice.read(tmp_path)


def test_a_table_of_other_logs_is_named(tmp_path):
    cfg = make_config(*DATA)
    physics: Any = make_physics(cfg)
    Choice(table((4, 1.0, 0.1, 40, True), names=["MPC"])).write(tmp_path)
    with pytest.raises(QPError, match=r"starts\.csv: got 'MPC', expected one of MPC of the"):
        chosen_before(cfg, physics, collect_log(cfg, physics), tmp_path)
