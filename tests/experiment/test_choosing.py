"""The choice of a start by closed loops, zero action if nothing is better, and its resumption."""

from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from torch.testing import assert_close

import train
from tests.runs import SMALL, make_config, run_command
from tests.stops import stop
from torch_qpmpc import QPMPC, QPError
from torch_qpmpc.envs.closed_loop import closed_loop
from torch_qpmpc.experiment import choosing
from torch_qpmpc.experiment.algorithms import evaluate
from torch_qpmpc.experiment.choosing import LINEAR, NONLINEAR, REGULATOR, STARTS, candidates, choose
from torch_qpmpc.experiment.rivals import ZERO_ACTION
from torch_qpmpc.experiment.run_folder import CHECKPOINT
from torch_qpmpc.experiment.start import OBSERVER, collect_log
from torch_qpmpc.experiment.tasks import make_mpc, make_physics
from torch_qpmpc.learning.operators import warm_policy
from torch_qpmpc.mpc.riccati import terminal_riccati
from torch_qpmpc.study.runs import FinishedRun


class Lag(gymnasium.Env):
    """A lag with noise, to be kept at zero by inputs that cost ``price`` times their size."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (1,), np.float64)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float64)

    def __init__(self, gain=1.0, price=0.1, noise=0.1):
        self.gain, self.price, self.noise = gain, price, noise

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.y = 3 * self.np_random.choice([-1.0, 1.0] if self.noise else [1.0], 1)
        return self.y, {}

    def step(self, action):
        self.y = 0.9 * self.y + self.gain * action + self.noise * self.np_random.standard_normal(1)
        cost = self.y.item() ** 2 + self.price * np.abs(action).item()
        return self.y, -cost, False, False, {}


DATA = (*SMALL, "start=data", "start.transitions=400", "task=gymnasium", "task.id=Lag-v0")
DATA += ("noise=none", "task.start_episodes=8")
BOUNDED = "task.observation_bounds=true"
#: Zero action is best: the input does next to nothing and is expensive.
HOPELESS = (*DATA, "task.kwargs={gain: 0.001, price: 100}")


@pytest.fixture(autouse=True)
def _plant(register):
    register(Lag, name="Lag-v0")


def chosen(*overrides):
    cfg = make_config(*overrides)
    physics: Any = make_physics(cfg)
    start = choose(cfg, physics, collect_log(cfg, physics))
    return cfg, physics, start, start.choice


def start_of(cfg, physics):
    start = candidates(cfg, physics, collect_log(cfg, physics))[LINEAR]
    return start._replace(action=torch.zeros(1, dtype=torch.float64))


def test_the_candidates_have_the_stage_s_and_the_regulator_s_cost(register):
    register(Swing, name="Lag-v0")
    cfg = make_config(*DATA)
    physics: Any = make_physics(cfg)
    log = collect_log(cfg, physics)
    named = candidates(cfg, physics, log)
    assert [*named] == [LINEAR, REGULATOR], "no network predicts a linear plant"
    mpcs = {
        name: make_mpc(cfg, physics.observed(start.observer), start)
        for name, start in named.items()
    }
    outputs, mpc = named[LINEAR], mpcs[LINEAR]
    assert outputs.order == 0
    assert_close(mpc.H_f.double(), outputs.cost.W[: mpc.n_x, : mpc.n_x], rtol=1e-6, atol=1e-6)
    start, mpc = named[REGULATOR], mpcs[REGULATOR]
    assert start.order > 1
    A, B = (torch.tensor(part) for part in start.model[:2])
    P = terminal_riccati(A, B, start.cost.W, mpc.gamma, mpc.layout)
    assert_close(mpc.H_f.double(), P, rtol=1e-6, atol=1e-6)
    diagonal = make_config(*DATA, "task.hessian=diagonal")
    assert [*candidates(diagonal, physics, log)] == [LINEAR]


def test_a_start_that_costs_less_than_zero_action_is_chosen():
    cfg, _, start, choice = chosen(*DATA)
    rows = choice.table
    assert start.action is None
    assert {*rows.index} == {LINEAR, REGULATOR, ZERO_ACTION}
    assert rows.episodes.tolist()[2:] == [8]
    assert rows.index[0] == choice.name == choice.scheme
    assert rows.episodes[choice.name] == rows.episodes[ZERO_ACTION] == 32, "the test needs 29"
    steps = rows.episodes.sum() * cfg.task.eval_steps
    assert start.summary["start_transitions"] == steps
    assert f"{steps:,} transitions beside the log's" in str(choice)


@pytest.mark.parametrize(("first", "episodes"), [(8, [8, 8, 8]), (1, [2, 2, 1])])
def test_equal_episodes_decide_at_once_but_one_alone_does_not(first, episodes):
    certain = ("task.kwargs={noise: 0.0}", f"task.start_episodes={first}")
    choice = chosen(*DATA, *certain)[-1]
    assert choice.name != ZERO_ACTION
    assert choice.table.episodes.tolist() == episodes


def test_zero_action_is_held_if_nothing_costs_less():
    cfg, physics, start, choice = chosen(*HOPELESS)
    assert choice.name == start.summary["start"] == ZERO_ACTION
    assert choice.scheme in (LINEAR, REGULATOR)
    plant: Any = physics.observed(start.observer)
    s = 3 * torch.randn(16, plant.n_x, dtype=torch.float64)
    assert make_mpc(cfg, plant, start).policy(s).abs().max() < 1e-12
    assert make_mpc(cfg, plant, start._replace(action=None)).policy(s).abs().max() > 1e-3


@pytest.mark.parametrize("gate", [True, False])
def test_the_gate_keeps_the_held_action_and_without_one_learning_starts_from_it(tmp_path, gate):
    settings = (f"gate={gate}", "constraint=mpc", "optimizer=gauss_newton", BOUNDED)
    cfg = make_config(*HOPELESS, *settings, "eval_interval=4")
    summary = train.train(cfg, str(tmp_path), quiet=True)
    assert summary["start"] == ZERO_ACTION
    if gate:
        assert summary["J_best"] == summary["J_start"] < summary["J_final"]
    held = FinishedRun(tmp_path).start.policy(torch.ones(4, 1).double()).abs().max() < 1e-9
    assert held != gate, "what learning starts from"


@pytest.mark.parametrize("hessian", ["block", "diagonal"])
def test_a_held_action_has_a_cost_of_its_own(hessian):
    """V is the log's mean cost ahead, and Q is above it by 1/2 (u - action)'R(u - action)."""
    bounds = ("task.observation_bounds=true", "task.gamma=0.9")
    cfg = make_config(*DATA, *bounds, f"task.hessian={hessian}", "task.learn_cost=[H,H_f,q,c]")
    physics: Any = make_physics(cfg)
    log = collect_log(cfg, physics)
    start = start_of(cfg, physics)
    physics = physics.observed(start.observer)
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
    summary, run = train.train(cfg, str(folder), quiet=True), FinishedRun(folder)
    for name, policy in (("J_start", run.start), ("J_best", run.policy)):
        J = evaluate(cfg, warm_policy(policy), run.physics).J
        assert summary[name] == pytest.approx(J, rel=1e-9)
    return run


def check_predict(run):
    """Run episodes by ``run.predict``, which holds the filter and the plan."""
    for seed in (5, 6):
        options: Any = {"steps": 9, "starts": 1, "seed": seed}
        loop = closed_loop(warm_policy(run.policy), run.physics, **options)
        env = run.physics.make()
        (y, _), costs = env.reset(seed=seed), []
        for k in range(len(loop.costs)):
            y, reward, *_ = env.step(run.predict(y, begins=k == 0))
            costs.append(-float(reward))
        assert costs == pytest.approx(loop.costs[:, 0].tolist(), rel=1e-4, abs=1e-6)


class Periodic(Lag):
    """An angle with a stage cost that no quadratic fits; the nearest minima are 1 and 1 - 2 pi."""

    def step(self, action):
        cost, self.y = 1 - np.cos(self.y.item() - 1), self.y + 0.5 * action
        return self.y, -cost, False, False, {}


@pytest.fixture
def periodic(register):
    register(Periodic, name="Lag-v0")


@pytest.mark.usefixtures("periodic")
def test_a_run_starts_from_networks_learns_the_cost_and_resumes(tmp_path, monkeypatch, capsys):
    """It says that C and b are not learned; nor is C's deviation penalised."""
    settings = ("optimizer=gauss_newton", "batch_size=64", "gate=true", "eval_interval=2")
    settings += ("task.eval_steps=7",)
    cfg, cut = make_config(*DATA, *settings, "constraint=deviation"), tmp_path / "cut"
    run = trained(cfg, tmp_path / "whole")
    assert run.summary["start"] == NONLINEAR
    assert run.start.sequential is not None
    assert run.start.horizon > 2 * cfg.task.horizon
    check_predict(run)
    assert run.policy.learned == ("H", "H_f", "q", "c")
    learner = QPMPC.load(tmp_path / "whole" / CHECKPOINT)
    assert learner.c != run.start.c
    assert torch.equal(learner.C, run.start.C)
    stop(monkeypatch, cfg, cut, 3)
    said = capsys.readouterr().out
    assert "C and b, and stay as fitted. Only theta's cost is learned, from 32 tr" in said
    run_command(*DATA, *settings, "constraint=deviation", f"hydra.run.dir={cut}")
    resumed = FinishedRun(cut)
    for key in ("J_start", "J_best", "start", "accepted", "rejected"):
        assert run.summary[key] == resumed.summary[key]


@pytest.mark.usefixtures("periodic")
@pytest.mark.parametrize(
    ("settings", "there"),
    [
        ((), True),
        (("constraint.si={beta: 1.0, windows: 2}",), False),
        (("task.learn_cost=[]", "constraint=free"), False),
    ],
)
def test_networks_are_no_start_of_a_run_that_needs_C(settings, there):
    cfg = make_config(*DATA, *settings)
    physics: Any = make_physics(cfg)
    assert (NONLINEAR in candidates(cfg, physics, collect_log(cfg, physics))) == there


class Swing(Lag):
    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.rate = 0.0
        return self.y, {}

    def step(self, action):
        self.rate = 0.97 * self.rate - 0.3 * self.y + 0.5 * action
        self.y = self.y + 0.3 * self.rate
        return self.y, -(self.y.item() ** 2), False, False, {}


@pytest.fixture
def swing(register):
    register(Swing, name="Lag-v0")


@pytest.mark.usefixtures("swing")
def test_a_run_estimates_a_hidden_state_and_resumes_with_the_start_that_it_has_chosen(
    tmp_path, monkeypatch
):
    settings = ("task.eval_steps=30", "task.gamma=1.0", "constraint=mpc", "eval_interval=3")
    cfg, whole, cut = make_config(*DATA, *settings), tmp_path / "whole", tmp_path / "cut"
    run = trained(cfg, whole)
    plant: Any = run.physics
    assert plant.n_x == run.policy.n_x == run.summary["order"] == len(run.observer.A) >= 2
    assert run.summary["J_start"] < 25, "16 with both states known, 37 by feedback of the position"
    assert "constraint=mpc" in repr(run)
    check_predict(run)
    assert repr(FinishedRun(tmp_path)) == f"<run {tmp_path}>", "without a run"
    with pytest.raises(QPError, match=r"observation: got shape \(4,\), expected shape"):
        run.predict(np.zeros(4))
    stop(monkeypatch, cfg, cut, 4)
    assert (cut / STARTS).read_bytes() == (whole / STARTS).read_bytes()
    with monkeypatch.context() as patch:
        patch.setattr(choosing, "candidates", None)
        run_command(*DATA, *settings, f"hydra.run.dir={cut}")
    resumed = FinishedRun(cut)
    assert run.policy.c != run.start.c, "it is corrected after the warm-up"
    assert run.policy.c == resumed.policy.c
    for key in ("J_start", "J_best", "start", "start_transitions", "order", "R2_cost"):
        assert run.summary[key] == resumed.summary[key]
    assert torch.equal(run.start.C, resumed.start.C)
    (whole / OBSERVER).write_bytes(b"text")
    with pytest.raises(QPError, match=r"path: got .*observer\.pt, which cannot be read"):
        _ = FinishedRun(whole).physics


class Broken(Lag):
    """Raises in each step, or measures nothing, at a negative ``price``."""

    def reset(self, *, seed=None, options=None):
        y, info = super().reset(seed=seed)
        return (y * np.nan if self.price < 0 else y), info

    def step(self, action):
        raise RuntimeError("no licence")


class Unpriced(Lag):
    def step(self, action):
        y, _, *rest = super().step(action)
        return y, np.nan, *rest


LICENCE = "step, .* ends them by RuntimeError: no licence"


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    ("plant", "price", "cause"),
    [(Broken, 1, LICENCE), (Broken, -1, LICENCE), (Unpriced, 1, "reward")],
)
def test_a_log_without_a_finite_step_is_an_error_with_its_cause(register, plant, price, cause):
    register(plant, name="Lag-v0")
    with pytest.raises(QPError, match=rf"start: got \d+ episodes without a finite {cause}"):
        chosen(*DATA, f"task.kwargs={{price: {price}}}")
