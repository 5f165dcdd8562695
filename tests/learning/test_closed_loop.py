"""`improve`: the gradient of closed loops, what it gains, and what it refuses."""

import copy
import dataclasses
import functools
import math
from typing import Any

import numpy as np
import pytest
import torch

import torch_qpmpc as qm
from tests.problems import central_difference
from tests.refused import refused
from torch_qpmpc.envs import PointMass
from torch_qpmpc.identification.identification import Identified, identify
from torch_qpmpc.identification.log import Trajectory
from torch_qpmpc.learning import closed_loop


@functools.cache
def logged(loops: int = 8, steps: int = 60) -> Identified:
    """A model of an oscillator whose position alone is measured, with noise."""
    rng = np.random.default_rng(0)
    A, B, C = np.array([[0.9, 0.3], [-0.3, 0.9]]), np.array([0.1, 0.5]), np.eye(2)[:1]
    logs = []
    for _ in range(loops):
        x, u, y = rng.normal(size=2), rng.uniform(-1, 1, (steps, 1)), []
        for k in range(steps + 1):
            y.append(C @ x + 0.1 * rng.normal(size=len(C)))
            if k < steps:
                x = A @ x + B * u[k] + 0.1 * rng.normal(size=2)
        logs.append({"y": np.array(y), "u": u})
    return identify(logs, order=2)


def controller(found: Identified, **options) -> qm.QPMPC:
    """An MPC that pays for the output, with a wrong weight of its own."""
    own = {"stage_weight": torch.diag(torch.tensor([1.0, 0.0, 0.0, 0.01]).double()), "gamma": 1.0}
    own |= {"hessian": "block", "action_bounds": ([-0.5], [0.5]), "solver": "daqp"}
    own |= {"state_bounds": ([-0.2, *[-np.inf] * 2], [np.inf] * 3), "structure": "tied"}
    own |= {"learn": ("H", "H_f", "q", "b", "lb")} | options
    return qm.QPMPC.of(**{**found.arguments, "horizon": 5, **own})


@pytest.fixture(scope="module")
def found() -> Identified:
    return logged()


def test_the_gradient_of_a_closed_loop_is_that_of_finite_differences(found):
    """It goes through the filter and the QP, and through loops with active and violated bounds."""
    mpc = controller(found)
    plant = closed_loop.simulated_plant(found, closed_loop.stage_cost(mpc.scheme), 5, members=3)

    def cost() -> torch.Tensor:
        taken = closed_loop._Loops(plant, 6, 1).run(mpc, 12)
        at_bounds = (taken.actions.abs() > 0.4999).double().mean()
        assert 0.1 < at_bounds < 0.9
        assert (taken.known[..., 0] < -0.2).any()
        return taken.costs.mean()

    mean = closed_loop._Loops(plant, 6, 1).mean_cost(mpc, 12)
    torch.testing.assert_close(mean.detach(), cost(), rtol=1e-10, atol=0.0)
    mean.backward()
    for name, leaf in mpc.coordinates().items():
        if leaf.grad is None:
            continue
        direction = torch.randn(leaf.shape, generator=torch.Generator().manual_seed(2)).double()
        direction = direction.tril() if name in ("H", "H_f") else direction
        expected = central_difference(cost, leaf, direction, 1e-6)
        torch.testing.assert_close((leaf.grad * direction).sum(), expected, rtol=1e-4, atol=1e-6)


class Pendulum:
    def starts(self, rng: torch.Generator, count: int) -> torch.Tensor:
        return torch.randn(count, 2, generator=rng, dtype=torch.float64)

    def draw(self, rng: torch.Generator, count: int) -> torch.Tensor:
        return 0.05 * self.starts(rng, count)

    def noise(self, nu: torch.Tensor, draw: torch.Tensor) -> torch.Tensor:
        return draw

    def step(self, s: torch.Tensor, a: torch.Tensor, nu: torch.Tensor | float) -> torch.Tensor:
        angle, rate = s.unbind(-1)
        force = 0.3 * a[..., 0] - 0.5 * angle.sin()
        return torch.stack((angle + 0.1 * rate, 0.8 * rate + force), -1) + nu

    def cost(self, s: torch.Tensor, a: torch.Tensor) -> torch.Tensor:
        return s[..., 0] ** 2 + 0.1 * s[..., 1] ** 2 + 0.01 * a[..., 0] ** 2


def test_loops_of_a_nonlinear_policy_have_their_gradient_and_improve():
    plant = Pendulum()
    options: Any = {"stage_weight": [1.0, 1.0, 0.5], "action_bounds": ([-2.0], [2.0])}
    options |= {"dynamics": lambda x, u: plant.step(x, u, 0.0), "iterations": 20, "gamma": 1.0}
    options |= {"structure": "tied", "solver": "daqp", "learn": ("H", "H_f", "q")}
    mpc = qm.QPMPC.of(2, 1, 3, **options)

    def cost() -> torch.Tensor:
        return closed_loop._Loops(plant, 4, 1).run(mpc, 6).costs.mean()

    closed_loop._Loops(plant, 4, 1).mean_cost(mpc, 6).backward()
    for name, leaf in mpc.coordinates().items():
        if leaf.grad is not None:
            direction = torch.ones_like(leaf).tril() if leaf.ndim > 1 else torch.ones_like(leaf)
            expected = central_difference(cost, leaf, direction, 1e-4)
            assert expected.abs() > 1e-6
            found = (leaf.grad * direction).sum()
            torch.testing.assert_close(found, expected, rtol=1e-3, atol=1e-7, msg=name)
    report = qm.improve(mpc, plant, updates=3, loops=6, steps=5, held_out=16, rate=0.3)
    assert report.after < 0.9 * report.before


def test_an_identified_plant_has_the_moments_of_its_model(found):
    """The first outputs and the later innovations have the model's covariances."""
    model, n = found.model, len(found.model.A)
    plant = closed_loop.simulated_plant(found, lambda p, u: p.sum(-1), 5, members=1)
    rng, zero = torch.Generator().manual_seed(0), torch.zeros(4000, 1).double()
    s = plant.starts(rng, 4000)
    first = model.C @ model.P0 @ model.C.T + model.S
    L = model.course(np.ones((1, 1), bool)).K[0]
    spread = torch.as_tensor(L @ first @ L.T)
    torch.testing.assert_close(
        plant.known(s).T.cov(), spread, rtol=0.2, atol=0.05 * spread.max().item()
    )
    torch.testing.assert_close(s[:, :n], plant.known(s))  # the filter's model is the plant's
    for _ in range(30):
        before, s = s, plant.step(s, zero, plant.noise(s, plant.draw(rng, 4000)))
    expected = before[:, :n] @ torch.as_tensor(model.A).T + torch.as_tensor(model.offset)
    e = (s[:, :n] - expected) @ torch.linalg.pinv(torch.as_tensor(model.L)).T
    torch.testing.assert_close(e.T.cov(), torch.as_tensor(model.S)[0, 0], rtol=0.1, atol=0.0)


def test_improve_lowers_the_cost_of_identified_loops(found):
    mpc = controller(found)
    before = {name: x.detach().clone() for name, x in mpc.named_parameters()}
    report = qm.improve(mpc, found, updates=8, loops=8, steps=40, held_out=64, members=2)
    assert report.kept
    assert report.after < 0.9 * report.before
    assert "kept: cost of a step" in str(report)
    assert len(report.curve) == 8
    assert not any(torch.equal(before[name], x) for name, x in mpc.named_parameters())
    assert mpc.on_failure == "raise"


def test_some_models_train_and_the_others_decide(found):
    """A theta with which one of the others costs clearly more is not kept."""
    mpc = controller(found)
    plant = closed_loop.simulated_plant(found, closed_loop.stage_cost(mpc.scheme), 5, members=4)
    assert plant.members == plant.unseen.members == 2
    assert not torch.equal(plant._own.A, plant.unseen._own.A)
    options: Any = {"updates": 2, "loops": 4, "steps": 10, "held_out": 64}
    report = qm.improve(mpc, plant, **options)
    assert (report.steps, report.models) == (40, 2)
    assert f"It costs less with {report.gained} of 2 models that did not train it." in str(report)
    before, cost, calls = copy.deepcopy(mpc.state_dict()), plant.unseen._cost, []

    def dearer(p: torch.Tensor, a: torch.Tensor) -> torch.Tensor:
        """Costs so much more in each loop, after theta has moved."""
        calls.append(len(p))
        return cost(p, a) + change * (len(calls) > 40)

    plant.unseen._cost = dearer
    change = torch.tensor([-100.0, 10.0]).double().repeat(32)  # with the first and second model
    report = qm.improve(mpc, plant, **options)
    assert not report.kept
    assert report.gained == 1
    assert report.interval[1] < 0
    assert "a veto" not in str(report)
    calls.clear()
    change = torch.linspace(-200.0, -100.0, 64).double()
    change[-1] = 3000.0
    report = qm.improve(mpc, plant, **options)
    assert not report.kept
    assert "In one loop it costs far more: a veto." in str(report)
    assert all(torch.equal(before[name], x) for name, x in mpc.state_dict().items())


def test_a_twentieth_of_models_costs_more_than_the_prediction():
    """Whatever their number; models with which the old theta fails do not count."""
    draws = torch.randn(4000, 9, generator=torch.Generator().manual_seed(0)).double()
    for k in (2, 8):
        above = [bool(x[8] > closed_loop.one_more(x[:k], 0.05)) for x in draws]
        assert np.mean(above) == pytest.approx(0.05, abs=0.012)
    failed = torch.cat((draws[0], torch.tensor([-math.inf])))
    assert closed_loop.one_more(failed, 0.05) == closed_loop.one_more(draws[0], 0.05)
    assert math.isnan(closed_loop.one_more(failed[8:], 0.05))


class Drifts:
    """x+ = x / 2 + u + w + noise, where w depends on the model."""

    def __init__(self, *w: float) -> None:
        self.w, self.members = torch.tensor(w).double()[:, None], len(w)

    def starts(self, rng: torch.Generator, count: int) -> torch.Tensor:
        return torch.randn(count, 1, generator=rng, dtype=torch.float64)

    def draw(self, rng: torch.Generator, count: int) -> torch.Tensor:
        return 0.1 * self.starts(rng, count)

    def noise(self, nu: torch.Tensor, draw: torch.Tensor) -> torch.Tensor:
        return draw

    def step(self, s: torch.Tensor, a: torch.Tensor, nu: torch.Tensor) -> torch.Tensor:
        return s / 2 + a + self.w.repeat(len(s) // self.members, 1) + nu

    def cost(self, s: torch.Tensor, a: torch.Tensor) -> torch.Tensor:
        return s[..., 0] ** 2


def test_a_gain_that_hangs_on_what_the_log_leaves_open_is_not_kept():
    """All models that decide gain: by about as much, or as much as their drifts say."""
    for spread, kept in ((0.02, True), (0.09, False)):
        plant: Any = Drifts(0.3)
        plant.unseen = Drifts(*np.linspace(0.26 - spread, 0.26 + spread, 4))
        options: Any = {"stage_weight": torch.tensor([1.0, 1.0]), "gamma": 1.0, "learn": ("q",)}
        mpc = qm.QPMPC.from_model([[0.5]], [[1.0]], 3, structure="tied", solver="daqp", **options)
        report = qm.improve(mpc, plant, updates=30, loops=8, steps=10, held_out=64, rate=0.1)
        assert report.kept == kept
        assert report.interval[1] < 0
        assert (report.gained, report.models) == (4, 4)
        assert ("With one more model, as the plant is, it may cost" in str(report)) != kept


def test_loops_that_no_action_holds_fail_and_decide_nothing(found):
    """They end as NaN, soon, in place of numbers without end; both thetas fail alike."""
    mpc, log = controller(found, on_failure="mask"), found.log.trajectories
    model = found.model._replace(A=1.4 * found.model.A)
    plant = closed_loop.SimulatedPlant([model], model, log, closed_loop.stage_cost(mpc.scheme), 5)
    taken = closed_loop._Loops(plant, 16, 0).run(mpc, 80)
    assert taken.costs[-1].isnan().sum() > 8
    assert taken.states.nan_to_num().abs().max() < 1e9
    report = qm.improve(mpc, plant, updates=2, loops=4, steps=20, held_out=16)
    assert not report.kept
    assert (report.gained, report.after) == (0, np.inf)


@pytest.mark.parametrize("seed", range(2))
def test_pieces_of_a_single_trajectory_make_an_ensemble(seed):
    """Its models differ about as much as those of logs of their own do."""
    models = closed_loop.ensemble(logged(1, 600), 8, seed)
    poles = np.array([np.sort(np.abs(np.linalg.eigvals(model.A))) for model in models])
    assert len(models) == 8
    assert (np.abs(poles - np.hypot(0.9, 0.3)) < 0.1).all()
    assert 1e-4 < poles[:, 0].std() < 0.05
    assert len(closed_loop.ensemble(logged(1, 15), 8, seed)) == 8  # of whatever pieces


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("gaps", [False, True])
def test_an_ensemble_leaves_out_draws_of_trajectories_too_short_for_a_fit(found, seed, gaps):
    long = found.log.trajectories[:2]
    y, u, d = (x.clone() for x in long[0])
    y[2:-2] = torch.nan
    short = Trajectory(y, u, d) if gaps else Trajectory(*(x[:2] for x in (long[0].y, u[:1], d[:1])))
    log = dataclasses.replace(found.log, trajectories=[*long, *[short] * 14])
    assert len(closed_loop.ensemble(dataclasses.replace(found, log=log), 12, seed)) == 12


def test_what_is_no_better_or_stopped_leaves_theta_as_it_was():
    plant = PointMass()
    weight = torch.tensor([1.0] * 4 + [0.1] * 2)
    bounds = ([-1.0] * 2, [1.0] * 2)
    mpc = qm.QPMPC.from_model(plant.A, plant.B, 3, stage_weight=weight, action_bounds=bounds)
    before = {name: x.clone() for name, x in mpc.named_parameters()}
    report = qm.improve(mpc, plant, updates=1, loops=2, steps=5, held_out=16, rate=1e-9)
    assert not report.kept
    assert "not kept, theta is as before" in str(report)
    assert all(torch.equal(before[name], x) for name, x in mpc.named_parameters())
    moved = []

    def stopped(mpc: qm.QPMPC) -> torch.Tensor:
        moved.append(any(not torch.equal(before[name], x) for name, x in mpc.named_parameters()))
        if len(moved) == 3:
            raise KeyboardInterrupt
        return torch.zeros(())

    with pytest.raises(KeyboardInterrupt):
        qm.improve(mpc, plant, updates=9, loops=2, steps=5, held_out=16, penalty=stopped)
    assert moved == [False, True, True]
    assert all(torch.equal(before[name], x) for name, x in mpc.named_parameters())
    assert mpc.on_failure == "raise"
    assert len(qm.improve(mpc.float(), plant, updates=1, loops=2, steps=5, held_out=16).curve) == 1


def test_loops_go_on_where_the_last_window_ended(found):
    mpc = controller(found)
    plant = closed_loop.simulated_plant(found, closed_loop.stage_cost(mpc.scheme), 5, members=1)
    whole, parts = closed_loop._Loops(plant, 4, 3), closed_loop._Loops(plant, 4, 3)
    expected = whole.run(mpc, 10).costs
    got = torch.cat([parts.run(mpc, 5).costs for _ in range(2)])
    torch.testing.assert_close(got, expected)


def test_the_stage_cost_is_the_schemes_with_the_price_of_violations():
    scheme = qm.Scheme.of(
        1,
        1,
        3,
        A=[[1.0]],
        B=[[1.0]],
        stage_weight=[2.0, 4.0],
        state_bounds=([-1.0], [1.0]),
        state_slack=10.0,
        q=[1.0, 0.0] * 3 + [0.0],
    )
    cost = closed_loop.stage_cost(scheme)(
        torch.tensor([[3.0]]).double(), torch.tensor([[0.5]]).double()
    )
    assert cost.item() == pytest.approx(9.0 + 0.5 + 3.0 + 20.0)


class ManyModels(PointMass):
    members = 9


NOTHING = qm.QPMPC.from_model(PointMass().A, PointMass().B, 3, stage_weight=[1.0] * 6, learn=())


@refused(
    ({"mpc": NOTHING}, "mpc: got one that learns nothing"),
    ({"mpc": None}, "mpc: got NoneType, expected a QPMPC"),
    ({"plant": object()}, "plant: got object, without starts, draw, noise, step, cost"),
    ({"updates": 0}, "updates: got 0"),
    ({"loops": 0}, "loops: got 0"),
    ({"steps": 0}, "steps: got 0"),
    ({"window": 0}, "window: got 0"),
    ({"members": 0}, "members: got 0"),
    ({"held_out": 8}, "held_out: got 8"),
    ({"plant": ManyModels(), "held_out": 16}, "held_out: got 16, .* whole number >= 18"),
    ({"rate": 0.0}, "rate: got 0.0"),
    ({"seed": -1}, "seed: got -1"),
    ({"cost": lambda p, u: p[:, 0]}, "cost, members: got other ones, expected the plant's own"),
    ({"members": 3}, "cost, members: got other ones"),
    ({"cost": 1.0}, "cost: got float, expected a function, or None"),
    ({"penalty": 1.0}, "penalty: got float, expected a function, or None"),
)
def test_improve_refuses(change):
    plant = PointMass()
    weight = torch.tensor([1.0] * 4 + [0.1] * 2)
    mpc = qm.QPMPC.from_model(plant.A, plant.B, 3, stage_weight=weight)
    qm.improve(**{"mpc": mpc, "plant": plant, **change})  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("learn", [("C", "b"), ("H", "q")])
def test_known_signals_go_on_as_in_the_log(learn):
    """From random steps, to the end of their trajectory; the MPC sees N steps of them."""
    rng, logs = np.random.default_rng(0), []
    for steps in (60, 40):
        u, d, y = rng.uniform(-1, 1, (steps, 1)), rng.normal(size=(steps, 1)), np.zeros((1, 1))
        for k in range(steps):
            y = np.vstack((y, 0.8 * y[-1] + 0.5 * u[k] + d[k] + 0.1 * rng.normal(size=1)))
        logs.append({"y": y[:-1, 0], "u": u[:, 0], "load": d[:, 0]})
    tables = [qm.read_log(x, outputs=["y"], inputs=["u"], known=["load"]) for x in logs]
    log = dataclasses.replace(tables[0], trajectories=[x.trajectories[0] for x in tables])
    found = identify(log, order=0)
    options = {"stage_weight": torch.tensor([3.0, 0.1]), "structure": "tied", "gamma": 1.0}
    mpc = qm.QPMPC.of(**{**found.arguments, "horizon": 3}, **options, learn=learn, solver="daqp")
    plant = closed_loop.simulated_plant(found, closed_loop.stage_cost(mpc.scheme), 3, members=2)
    draw, d = torch.Generator().manual_seed(0), torch.cat([x.d for x in log.trajectories])[:, 0]
    s, u = plant.starts(draw, 50), torch.zeros(50, 1).double()
    for _ in range(70):
        p, row = plant.known(s), plant._row(s, 3)
        assert torch.equal(p[:, :4], d[row])
        before, last = row[:, 0], torch.where(row[:, 0] < 59, 58, 97)
        s = plant.step(s, u, plant.draw(draw, 50))
        assert torch.equal(plant._row(s)[:, 0], torch.minimum(before + 1, last))
        e = (plant.known(s)[:, 4] - 0.8 * p[:, 4] - p[:, 0]).std()
        assert 0.05 < e < 0.2
    report = qm.improve(mpc, found, updates=2, loops=8, steps=20, held_out=16, members=2)
    assert np.isfinite([report.before, report.after, *report.curve]).all()


def heavy(rng, size):
    """Noise of unit variance with heavier tails than the normal distribution's."""
    return rng.standard_t(8, size) / np.sqrt(8 / 6)


@pytest.mark.parametrize("seed", range(5))
def test_noise_that_grows_with_the_action_is_identified(seed):
    """In both outputs, in any unit; noise that does not grow is constant, with heavy tails, too."""
    rng = np.random.default_rng(seed)
    v = rng.uniform(-1, 1, (1500, 3)) * [1.0, 20.0, 0.5]
    std = np.sqrt(0.5 + 8.0 * v[:, 2] ** 2)
    e = np.stack((std * heavy(rng, 1500), 1e3 * rng.normal(size=1500), rng.uniform(-1, 1, 1500)), 1)
    c = closed_loop.growth(e, v)
    mean = (std**2).mean()
    np.testing.assert_allclose(c[0, [0, 3]] * mean, [0.5, 8.0], rtol=0.35)
    assert (c[0, [1, 2]] * (v[:, :2] ** 2).mean(0)).max() < 0.1
    np.testing.assert_array_equal(c[1:], np.eye(1, 4).repeat(2, 0))


@pytest.mark.parametrize("sensor", [0.0, 0.2])
def test_simulated_noise_grows_as_the_logs(sensor):
    """The sensor's part neither grows nor moves the state."""
    rng, logs = np.random.default_rng(0), []
    for _ in range(40):
        x, u = [rng.normal(size=1)], rng.uniform(-1, 1, (60, 1))
        for k in range(60):
            x.append(0.8 * x[-1] + u[k] * (1 + rng.normal(size=1)) + 0.02 * rng.normal(size=1))
        logs.append({"y": np.array(x) + sensor * rng.normal(size=(61, 1)), "u": u})
    found = identify(logs, order=int(sensor > 0))
    plant = closed_loop.simulated_plant(found, lambda p, u: p.sum(-1), 5, members=1)
    draw = torch.Generator().manual_seed(0)
    s = plant.starts(draw, 4000)
    for level, std in ((1.0, 1.0 / 0.6), (0.5, 0.5 / 0.6), (0.0, 0.02 / 0.6)):
        u = torch.full((4000, 1), level).double()
        for _ in range(40):
            before, s = plant.known(s)[:, 0], plant.step(s, u, plant.draw(draw, 4000))
        assert s[:, 0].std().item() == pytest.approx(std, rel=0.4, abs=0.2)
        assert plant.known(s)[:, 0].mean().item() == pytest.approx(s[:, 0].mean().item(), abs=0.1)
        if not sensor:
            e = plant.known(s)[:, 0] - 0.8 * before - level
            assert e.std().item() == pytest.approx(np.hypot(level, 0.02), rel=0.15, abs=0.1)
    if sensor:
        assert plant._growth[0, 0, 2] == 0  # of the slow disturbance, of one size in a log
        own, _, y, *_ = plant._parts(s)
        assert (y - plant._own.at("C", own)).std().item() == pytest.approx(sensor, rel=0.3)
