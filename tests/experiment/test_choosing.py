"""The choice of a start by closed loops, zero action if nothing is better, and its resumption."""

from __future__ import annotations

import copy
import math
import signal
from typing import Any

import gymnasium
import numpy as np
import pandas as pd
import pytest
import torch
from gymnasium.envs.registration import EnvSpec
from omegaconf import OmegaConf
from torch.testing import assert_close

import train
from tests.runs import SMALL, make_config, run_command
from tests.stops import stop
from torch_qpmpc import QPError
from torch_qpmpc.experiment import choosing
from torch_qpmpc.experiment.algorithms import evaluate
from torch_qpmpc.experiment.choosing import (
    choose,
    chosen_before,
    starts,
)
from torch_qpmpc.experiment.rivals import ZERO_ACTION
from torch_qpmpc.experiment.start import collect_log, learning_start
from torch_qpmpc.experiment.tasks import make_mpc, make_physics
from torch_qpmpc.experiment.tasks.choice import HELD, MEAN_ACTION, NO_WINDOW, STARTS, Choice, Row
from torch_qpmpc.learning.operators import warm_policy
from torch_qpmpc.mpc import stage_cost
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
DATA += ("noise=none", "task.start_episodes=4")
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
    """Make the plant a lag, and fit the starts of the same settings and log once, and roughly."""

    def once(cfg, physics, log):
        settings = OmegaConf.masked_copy(cfg, [key for key in cfg if key != "resume"])
        key = OmegaConf.to_yaml(settings), log["observation"].numpy().tobytes()
        if key not in known_starts:
            known_starts[key] = starts(cfg, physics, log)
        return copy.deepcopy(known_starts[key])

    plant_is(monkeypatch, Lag)
    monkeypatch.setattr(choosing, "starts", once)
    monkeypatch.setattr(stage_cost, "ITERATIONS", 50)


def chosen(*overrides):
    cfg = make_config(*overrides)
    physics = make_physics(cfg)
    start = choose(cfg, physics, collect_log(cfg, physics))
    assert start.choice is not None
    return cfg, physics, start, start.choice


class Followed(Lag):
    """The lag beside a set-point, which jumps, and of which the reward knows the next value."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float64)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.r = self.following = self.np_random.uniform(-2, 2)
        return np.append(self.y, self.r), {}

    def step(self, action):
        self.r = self.following
        if self.np_random.random() < 0.05:
            self.following = self.np_random.uniform(-2, 2)
        self.y = 0.9 * self.y + action
        cost = (self.y.item() - self.following) ** 2
        return np.append(self.y, self.r), -cost, False, False, {}


@pytest.mark.parametrize(
    ("given", "held"), [("null", (1,)), ("[]", ()), ("[0]", (0,))], ids=["log", "none", "given"]
)
def test_set_points_are_held_in_all_starts_and_said(monkeypatch, given, held):
    plant_is(monkeypatch, Followed)
    cfg = make_config(*DATA, "start.transitions=800", f"task.held={given}")
    physics = make_physics(cfg)
    named = starts(cfg, physics, collect_log(cfg, physics))
    assert {start.identified.options.held for start in named.values()} == {held}
    start = next(iter(named.values()))
    assert start.summary.get("outputs_held", []) == [*held]
    said = f"Held at their last value over the horizon: y2, as by task.held={[*held]}"
    assert (said in str(start).splitlines()) == (held == (1,))
    assert "tied C, N=6, cost of (y_(k+1), u_k) in most steps" in named


def test_the_starts_are_all_combinations_and_constant_actions():
    cfg = make_config(*DATA)
    physics = make_physics(cfg)
    log = collect_log(cfg, physics)
    named = choosing.starts(cfg, physics, log)
    kinds = [f"{s} C, N={N}" for N in (3, 6) for s in ("free", "tied")]
    costs = ("(y_(k+1), u_k)", "(y_k, u_k)")
    made = [f"{kind}, cost of {cost}" for kind in kinds for cost in costs]
    made += [f"{s} C, N=3, cost of (y_k, u_k), Riccati" for s in ("free", "tied")]
    assert [*named] == [*made, ZERO_ACTION, MEAN_ACTION]
    tied = named["tied C, N=6, cost of (y_k, u_k)"]
    assert tied.identified.options.structure == "tied"
    assert tied.identified.options.layout.horizon == 6
    assert make_mpc(cfg, physics, tied).horizon == 6
    actions: Any = log["action"]
    assert_close(named[MEAN_ACTION].held, actions.double().mean((0, 1)))
    cfg = make_config(*DATA, "constraint=mpc")
    made = [f"tied C, N={N}, cost of (y_k, u_k)" for N in (3, 6)]
    assert [*starts(cfg, physics, log)][:2] == made


def test_a_start_that_costs_less_than_zero_action_is_chosen():
    _, _, start, choice = chosen(*DATA)
    rows = choice.rows
    assert start.held is None
    assert rows[choice.name].episodes == rows[ZERO_ACTION].episodes == 4
    assert rows[choice.name].J < rows[ZERO_ACTION].J
    assert sorted(row.episodes for row in rows.values()) == [2] * 5 + [4] * 7
    assert start.summary["start_transitions"] == sum(r.episodes for r in rows.values()) * 10
    assert NO_WINDOW in str(choice)


def test_zero_action_is_held_if_nothing_costs_less():
    cfg, physics, start, choice = chosen(*HOPELESS)
    assert choice.name == start.summary["start"] == ZERO_ACTION
    s = 3 * torch.randn(16, 1, dtype=torch.float64)
    mpc = make_mpc(cfg, physics, start)
    assert mpc.policy(s).abs().max() < 1e-12


def test_learning_begins_with_the_best_scheme_where_a_gate_keeps_the_held_action():
    cfg, physics, start, choice = chosen(*HOPELESS)
    assert choice.scheme not in HELD
    cfg.gate = False
    assert learning_start(cfg, start) is start
    cfg.gate = True
    s = torch.randn(16, 1, dtype=torch.float64)
    assert make_mpc(cfg, physics, learning_start(cfg, start)).policy(s).abs().max() > 1e-3


def test_the_gate_keeps_the_held_action_and_the_run_resumes(tmp_path, monkeypatch):
    settings = ("gate=true", "constraint=mpc", "optimizer=gauss_newton", "release=2", BOUNDED)
    cfg, whole, cut = make_config(*HOPELESS, *settings), tmp_path / "whole", tmp_path / "cut"
    summary = train.train(cfg, str(whole), quiet=True)
    assert summary["start"] == ZERO_ACTION
    assert summary["J_best"] == summary["J_start"] < summary["J_final"]
    assert stop(monkeypatch, cfg, cut, 3) == 128 + signal.SIGTERM
    run_command(f"resume={cut}")
    assert FinishedRun(cut).summary["J_final"] == summary["J_final"]


@pytest.mark.parametrize("hessian", ["block", "diagonal", "full"])
def test_a_held_action_has_a_cost_of_its_own(hessian):
    """V is the log's mean cost ahead, and Q is above it by 1/2 (u - action)'R(u - action)."""
    learn = "[H,q,c]" if hessian == "full" else "[H,H_f,q,c]"
    bounds = ("task.observation_bounds=true", "task.gamma=0.9")
    cfg = make_config(*DATA, *bounds, f"task.hessian={hessian}", f"task.learn_cost={learn}")
    physics = make_physics(cfg)
    log = collect_log(cfg, physics)
    start = starts(cfg, physics, log)[ZERO_ACTION]
    s = torch.randn(8, 1, dtype=torch.float64)
    assert make_mpc(cfg, physics, start).policy(s).abs().max() < 1e-12, "rounding alone"
    action = torch.tensor([0.25], dtype=torch.float64)
    mpc = make_mpc(cfg, physics, start._replace(held=action))
    assert_close(mpc.policy(s), action.expand(8, 1), atol=1e-7, rtol=0)
    costs = -log.get(("next", "reward")).double()
    assert_close(mpc.value(s), (10 * costs.mean()).expand(8), atol=1e-5, rtol=0)
    R = costs.abs().mean() / (log["action"] - 0.25).abs().max().double().square()
    blind = start._replace(log=log.exclude(("next", "reward")), cost=None)
    weighted = make_config(*DATA, "task.stage_weight=[[1,0],[0,1]]")
    assert make_mpc(weighted, physics, blind).policy(s).abs().max() < 1e-12
    difference = mpc.action_value(s, action.expand(8, 1) + 0.5) - mpc.value(s)
    assert_close(difference, (R / 8).expand(8), rtol=1e-4, atol=0)


def test_the_gate_copies_a_held_action_into_the_scheme_that_learning_begins_with():
    cfg = make_config(*DATA, "task.hessian=diagonal", "task.learn_cost=[q,c]")
    physics = make_physics(cfg)
    start = starts(cfg, physics, collect_log(cfg, physics))[ZERO_ACTION]
    held, scheme = make_mpc(cfg, physics, start), make_mpc(cfg, physics, start._replace(held=None))
    scheme.load_state_dict(held.state_dict())
    assert scheme.policy(torch.ones(1, 1, dtype=torch.float64)).abs() < 1e-12


def trained_and_resumed(cfg, folder, monkeypatch) -> FinishedRun:
    """Train; the files have the policies evaluated, and a run that was cut ends likewise."""
    whole, cut = folder / "whole", folder / "cut"
    summary, run = train.train(cfg, str(whole), quiet=True), FinishedRun(whole)
    for name, policy in (("J_start", run.start), ("J_best", run.policy)):
        J = evaluate(cfg, warm_policy(policy), run.physics).J
        assert summary[name] == pytest.approx(J, rel=1e-9)
    assert stop(monkeypatch, cfg, cut, 3) == 128 + signal.SIGTERM
    run_command(f"resume={cut}")
    assert FinishedRun(cut).summary["J_best"] == summary["J_best"]
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
def test_a_run_starts_from_blended_models_and_its_file_has_them(tmp_path, monkeypatch):
    settings = ("gate=act", "optimizer=gauss_newton", "constraint=mpc", "release=2")
    cfg = make_config(*DATA, "task.start_episodes=2", *settings)
    run = trained_and_resumed(cfg, tmp_path, monkeypatch)
    assert run.summary["start"].startswith("blended models, N=6, cost of")
    assert run.policy.schedule is not None
    assert run.start.schedule is not None


@pytest.mark.usefixtures("turning")
@pytest.mark.parametrize(("needs", "there"), [((), True), (("export=c",), False)])
def test_blended_models_are_no_start_of_a_run_that_needs_one_C(needs, there):
    cfg = make_config(*DATA, *needs)
    physics = make_physics(cfg)
    named = starts(cfg, physics, collect_log(cfg, physics))
    assert any("blended" in name for name in named) == there


class Falling(Lag):
    """A pendulum that falls from the upright, shown by its angle's sine and cosine."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (3,), np.float64)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.angle, self.rate = self.np_random.uniform(-0.1, 0.1), 0.0
        return self.seen(), {}

    def seen(self):
        return np.array([np.sin(self.angle), np.cos(self.angle), self.rate])

    def step(self, action):
        self.rate += 0.5 * np.sin(self.angle) + 0.3 * action.item()
        self.angle += 0.5 * self.rate
        cost = self.angle**2 + 0.1 * action.item() ** 2 - 1
        return self.seen(), -cost, abs(self.angle) > 2, False, {}


LOCAL = "local C, N=3, cost of (y_k, u_k), Riccati"


@pytest.fixture
def falling(monkeypatch):
    """Return a function that makes the configuration, the plant and its log."""
    plant_is(monkeypatch, Falling)

    def make(*overrides):
        cfg = make_config(*DATA, "start.transitions=800", *overrides)
        physics = make_physics(cfg)
        return cfg, physics, collect_log(cfg, physics)

    return make


def test_a_run_starts_from_the_steps_near_where_episodes_begin(tmp_path, monkeypatch, falling):
    cfg, *_ = falling("gate=act")
    run = trained_and_resumed(cfg, tmp_path, monkeypatch)
    assert run.summary["start"] == LOCAL
    assert run.summary["J_start"] < -9
    choice = Choice.read(tmp_path / "whole")
    assert choice is not None
    rows = choice.rows
    assert rows[LOCAL].length == 10
    assert 1 < min(row.length for row in rows.values()) < 10


def test_the_local_start_holds_outputs_that_hardly_move_there(falling):
    start = starts(*falling())[LOCAL]
    assert start.still == [1], "the cosine"
    assert start.outputs_held == []
    assert any(line.endswith("are held: y2") for line in str(start).splitlines())


def test_the_local_start_needs_no_discount(falling):
    cfg, physics, log = falling("task.gamma=1")
    start = starts(cfg, physics, log)[LOCAL]
    s = torch.tensor([[0.05, 1.0, 0.0], [0.0, 1.0, 0.1]]).double()
    assert (make_mpc(cfg, physics, start).policy(s) < 0).all()


@pytest.mark.parametrize("setting", ["task.hessian=diagonal", "task.past=2"])
def test_a_diagonal_hessian_and_a_window_have_no_local_start(falling, setting):
    assert "local" not in "".join(starts(*falling(setting)))


def test_the_regulators_cost_for_all_starts_leaves_no_window_and_no_copy(monkeypatch):
    plant_is(monkeypatch, Swing)
    cfg = make_config(*DATA, "task.terminal_weight=riccati")
    physics = make_physics(cfg)
    named = starts(cfg, physics, collect_log(cfg, physics))
    assert not any("past=" in name or "Riccati" in name for name in named)
    for start in named.values():
        assert make_mpc(cfg, physics, start).H_f.abs().max() < 1e6


def test_a_window_is_a_start_if_it_shows_the_next_step_better_alone(monkeypatch, falling):
    """Of the angle alone the rate is hidden; the plant falls before the horizon shows that."""
    monkeypatch.setattr(Falling, "seen", lambda self: np.array([self.angle]))
    space = gymnasium.spaces.Box(-np.inf, np.inf, (1,), np.float64)
    monkeypatch.setattr(Falling, "observation_space", space)
    named = starts(*falling("task.horizon=8"))
    one, window = (
        named[f"tied C, N=8{past}, cost of (y_k, u_k)"].identified for past in ("", ", past=3")
    )
    unexplained = [1 - model.R2[[0, -1], 0] for model in (one, window)]
    first, last = (unexplained[1] / unexplained[0]).tolist()
    assert first < 0.5 < last


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
def test_a_run_starts_with_a_window_if_the_observation_hides_a_state(tmp_path, monkeypatch):
    settings = ("task.eval_steps=30", "task.gamma=1.0", "gate=act")
    run = trained_and_resumed(make_config(*DATA, *settings), tmp_path, monkeypatch)
    assert ", past=3, cost of (y_" in run.summary["start"]
    plant: Any = run.physics
    assert plant.past == run.policy.past == run.start.past == run.summary["past"] == 3


@pytest.mark.usefixtures("swing")
def test_windows_are_no_start_if_the_run_names_its_own_or_episodes_are_short():
    cfg = make_config(*DATA)
    physics = make_physics(cfg)
    log = collect_log(cfg, physics)
    assert any("past=3" in name for name in starts(cfg, physics, log))
    own = make_config(*DATA, "task.past=2")
    plant = make_physics(own)
    assert all("past=2" in name for name in starts(own, plant, log) if name not in HELD)
    short = make_config(*DATA, "task.episode_steps=2")
    log = collect_log(short, physics)
    assert not [name for name in starts(short, physics, log) if "past" in name]


def test_a_run_resumes_with_the_start_that_it_has_chosen(tmp_path, monkeypatch):
    monkeypatch.setattr(choosing, "starts", starts)
    cfg, whole, cut = make_config(*DATA), tmp_path / "whole", tmp_path / "cut"
    train.train(cfg, str(whole), quiet=True)
    assert stop(monkeypatch, cfg, cut, 3) == 128 + signal.SIGTERM
    assert (cut / STARTS).read_bytes() == (whole / STARTS).read_bytes()
    (cut / STARTS).rename(tmp_path / STARTS)
    with pytest.raises(SystemExit, match=r"starts\.csv: got no file, .* Start a new run"):
        run_command(f"resume={cut}")
    (tmp_path / STARTS).rename(cut / STARTS)
    with monkeypatch.context() as patch:
        patch.setattr("torch_qpmpc.experiment.start.choose", None)
        run_command(f"resume={cut}")
    runs = FinishedRun(whole), FinishedRun(cut)
    constants = [run.policy.c.item() for run in runs]
    assert 0 < constants[0] < 0.5 * runs[0].start.c.item(), "random actions cost more"
    assert constants[0] == constants[1]
    entries = ("J_start", "start", "start_transitions")
    first, second = ({key: run.summary[key] for key in entries} for run in runs)
    assert first == second
    assert torch.equal(runs[0].start.C, runs[1].start.C)


def test_the_table_is_kept_and_damage_is_named(tmp_path):
    zero = Row(math.nan, 4, 2.0, 0.0, 40, False, 10.0)
    rows = {"a, b": Row(0.1 + 0.2, 4, 1 / 3, 0.1, 40, True, 20 / 3), ZERO_ACTION: zero}
    Choice(rows).write(tmp_path)
    again = Choice.read(tmp_path)
    assert again is not None
    assert again.summary == {"start": "a, b", "start_transitions": 80}
    assert again.rows["a, b"] == rows["a, b"]
    assert Choice.read(tmp_path / "other") is None
    table = pd.read_csv(tmp_path / STARTS)
    table["chosen"] = False
    table.to_csv(tmp_path / STARTS, index=False)
    with pytest.raises(QPError, match=r"starts\.csv: got .*expected the table of starts"):
        Choice.read(tmp_path)


def test_a_table_of_another_log_is_named():
    cfg = make_config(*DATA)
    physics = make_physics(cfg)
    choice = Choice({"free C, N=7": Row(0.9, 4, 1.0, 0.1, 40, True)})
    with pytest.raises(
        QPError, match=r"starts\.csv: got 'free C, N=7', expected one of free C, N=3"
    ):
        chosen_before(cfg, physics, collect_log(cfg, physics), choice)
