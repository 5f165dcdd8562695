"""Controllers of nonlinear plants: a function, or what a log teaches."""

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose
from torch import Tensor

import torch_qpmpc as qm
import torch_qpmpc.control.law
from tests.refused import refused
from torch_qpmpc import QPError, SolverError
from torch_qpmpc.control.state_space import read_model
from torch_qpmpc.identification.learned import LearnedModel
from torch_qpmpc.qp.pipeline import diagnosis

NAMES: Any = {"inputs": ["hot", "cold"], "outputs": ["level", "T"]}
OPTIONS: Any = {"Q": {"level": 1.0, "T": 0.01}, "dR": 0.1, "du_bounds": (-0.2, 0.2)}
OPTIONS |= {"u_bounds": (0.0, 2.0), "disturbances": {"level": "cold", "T": "hot"}}
REST = [1.0, 40.0], [30 / 70, 40 / 70]
NOISE = np.array([0.003, 0.1])
LOCAL = ", as far as the linearisation holds"


def mixed(x: Tensor, u: Tensor, *d: Tensor) -> Tensor:
    """Return level and temperature of a tank that mixes two flows, and a known third one."""
    level, T = x.unbind(-1)
    hot, cold = u.unbind(-1)
    cold = cold + (d[0][..., 0] if d else 0.0)
    out = level.clamp(min=1e-3).sqrt()
    heat = (hot * (80 - T) + cold * (10 - T)) / level.clamp(min=0.1)
    return x + 0.2 * torch.stack((hot + cold - out, heat), -1)


def after(x: np.ndarray, u: np.ndarray, *d: np.ndarray) -> np.ndarray:
    return mixed(*map(torch.from_numpy, (x, u, *d))).numpy()


def controller(linear: bool = False, horizon: int = 10, **options: Any) -> qm.Controller:
    model, own = (mixed, *REST), {**OPTIONS, **NAMES, **options}
    if linear:
        names = {name: own.pop(name) for name in NAMES}
        model = replace(read_model(model, **names), dynamics=None)
    return qm.Controller(qm.LinearMPC(model, horizon, **own), noise=NOISE)


def loop(own: qm.Controller, set_points: np.ndarray, load: np.ndarray) -> tuple[np.ndarray, ...]:
    rng, x, states, inputs = np.random.default_rng(0), np.array(REST[0]), [], []
    own.reset(y=x, u=REST[1])
    for r in set_points:
        inputs.append(own.step(x + NOISE * rng.normal(size=2), r=r))
        assert own.status == 0
        x = after(x, inputs[-1] + load)
        states.append(x)
    return np.array(states), np.array(inputs)


def test_loads_leave_no_offset_far_from_the_first_point():
    set_points, costs = np.repeat([[3.0, 25.0], [0.4, 60.0]], 50, 0), []
    for linear in (False, True):
        y, u = loop(controller(linear), set_points, np.array([0.0, 0.15]))
        du, off = np.diff(u, axis=0, prepend=np.array(REST[1])[None]), y - set_points
        assert (np.abs(u - 1) <= 1).all()
        assert (np.abs(du) <= 0.2 + 1e-9).all()
        costs.append((off**2 @ [1.0, 0.01]).sum() + 0.1 * (du**2).sum())
        if not linear:
            settled = np.abs(off.reshape(2, 50, 2)[:, 35:].mean(1))
            assert (settled < NOISE).all()
    assert costs[0] < 0.95 * costs[1]


@pytest.mark.parametrize("references", ["held", "preview"])
def test_a_linear_function_is_the_linear_plant(references, monkeypatch):
    monkeypatch.setattr(torch_qpmpc.control.law, "WARM", 30)
    A, B, E = np.array([[0.9, 0.1], [0.0, 0.7]]), np.array([[0.0], [0.5]]), np.array([[0.1], [0.0]])
    C, parts = [[1.0, 0.0]], [torch.from_numpy(part.T) for part in (A, B, E)]
    options: Any = {"Q": 1.0, "R": 0.1, "dR": 0.1, "u_bounds": (-1.0, 1.0), "known": ["rain"]}
    options |= {"y_bounds": (-0.5, 0.8), "du_bounds": (-0.4, 0.4), "references": references}

    def f(x: Tensor, u: Tensor, d: Tensor) -> Tensor:
        return x @ parts[0] + u @ parts[1] + d @ parts[2]

    pair = [
        qm.Controller(qm.LinearMPC((A, B, C), 6, E=E, **options)),
        qm.Controller(qm.LinearMPC((f, [0.3, 0.1], [0.2], C), 6, **options)),
    ]
    rng, x = np.random.default_rng(0), np.zeros(2)
    for own in pair:
        own.reset(y=[0.0], u=[0.0], known=[0.0])
    for k in range(20):
        known, y, u = rng.normal(size=(7, 1)) / 4, [x[0]], [0.0, 0.0]
        y = None if k in (4, 5) else y
        for i, own in enumerate(pair):
            if k == 8:  # manual mode
                own.observe(y, [0.3], known[0])
                u[i] = 0.3
            else:
                u[i] = own.step(y, r=[2.0 * (k > 10) - 1.0], known=known)[0]
                assert own.status == (4 if y is None else 0)
        assert_allclose(u[1], u[0], atol=1e-6)
        x = A @ x + B @ [u[0]] + E @ known[0] + [0.05, 0.0]
    for name in ("x", "w", "p"):
        assert_allclose(getattr(pair[1], name), getattr(pair[0], name), atol=1e-6)
    for texts in zip(*((str(own.review()), str(own.explain())) for own in pair), strict=True):
        linear, function = (re.sub(r"\S+e-1\d", "0", text) for text in texts)  # but for rounding
        assert linear == function.replace(LOCAL, "")
        assert LOCAL in function


def test_known_flows_are_fed_forward():
    costs = []
    for seen in (True, False):
        own, x, cost = controller(known=["rain"], R=1e-3), np.array(REST[0]), 0.0
        own.reset(y=x, u=REST[1], known=[0.0])
        for k in range(16):
            rain = 0.4 * (np.arange(k, k + 11) >= 6)[:, None]
            x = after(x, own.step(x, r=REST[0], known=rain if seen else [0.0]), rain[0])
            cost += (x - REST[0]) ** 2 @ [1.0, 0.01]
        costs.append(cost)
    assert costs[0] < 0.3 * costs[1]


def test_a_review_is_of_the_operating_point_that_a_user_names():
    options: Any = {"disturbances": dict.fromkeys(NAMES["outputs"], "output")}
    own = controller(**options)
    for level, T in ([1.0, 40.0], [3.0, 25.0]):
        review = own.review({"level": level, "T": T})
        flows = np.linalg.solve([[1, 1], [80 - T, 10 - T]], [level**0.5, 0.0])
        at = read_model((mixed, [level, T], flows), **NAMES)
        mpc = qm.LinearMPC(replace(at, dynamics=None), 10, **OPTIONS | options)
        twin = qm.Controller(mpc, noise=NOISE).review([level, T])
        for name in ("terminal weight", "disturbances", "set-points", "stability", "margin"):
            assert review[name].text.replace(LOCAL, "") == twin[name].text
        assert not review.faults
    assert own.review({"level": 20.0, "T": 40.0}).faults[0].name == "set-points"


def test_a_run_starts_at_rest_and_ends_at_the_set_point():
    own = controller()
    own.reset(y=[2.0, 40.0], u=[0.6, 0.8])
    run = own.simulate((mixed, *REST), 30, r=[2.5, 30.0])
    assert np.abs(run.y[0] - own.simulate(steps=1, r=[2.5, 30.0]).y[0]).max() < 1e-9
    assert_allclose(run.y[-1], [2.5, 30.0], atol=1e-2)


def upright(x: Tensor, u: Tensor) -> Tensor:
    """Return the slopes of a pendulum's angle and speed about its upper rest."""
    return torch.stack((x[..., 1], 9.81 * x[..., 0].sin() + u[..., 0] - 0.1 * x[..., 1]), -1)


@pytest.mark.parametrize(
    ("angle", "status", "proven"), [(0.0, 0, True), (1.5, 2, True), (1.5, 1, False)]
)
def test_hard_bounds_have_a_plan_though_the_first_linearisations_have_none(
    angle, status, proven, monkeypatch
):
    if not proven:
        monkeypatch.setattr(diagnosis, "_contradict", lambda *_: False)
    f, bounds = qm.RungeKutta(upright, 0.1), ([-1.0, -0.5], [0.9, 1.2])
    options: Any = {"u_bounds": (-14, 14), "y_bounds": bounds, "disturbances": {"y1": "u1"}}
    options |= {"Q": [1.0, 0.0], "dR": 0.01, "y_slack": np.inf}
    own = qm.Controller(qm.LinearMPC((f, [0.0, 0.0], [0.0]), 20, **options))
    x = torch.tensor([angle, 0.0]).double()
    own.reset(y=x.numpy(), u=[0.0])
    for k in range((30, 1, 2)[status]):
        with qm.SolveLog() as log:
            x = f(x, torch.from_numpy(own.step(x.numpy(), r=[1.1, 0.0])))
        assert own.status == status
        assert log.solves <= 10 or k == 0  # the search goes on, with a plan or without
        assert status or (x <= torch.tensor(bounds[1]).double() + 1e-3).all()
    assert status or abs(x[0] - 0.9) < 1e-3


def grown(x: Tensor, u: Tensor) -> Tensor:
    """Return the slopes of biomass and substrate in a fed tank, which too large a flow washes out.

    Substrate that is left over inhibits the growth.
    """
    (X, S), (flow, feed) = x.unbind(-1), u.unbind(-1)
    growth = 0.5 * S * X / (0.2 + S + S**2 / 2)
    return torch.stack((growth - flow * X, flow * (feed - S) - growth / 0.4), -1)


def tank() -> qm.Controller:
    model = qm.RungeKutta(grown, 0.2), [1.1, 0.5], [0.2, 3.0]
    options: Any = {"Q": 1.0, "dR": [0.1, 0.02], "u_bounds": ([0.0, 0.5], [0.6, 6.0])}
    return qm.Controller(qm.LinearMPC(model, 15, **options), noise=0.01)


def test_a_reset_and_a_run_start_at_the_models_own_point_wherever_the_loop_was():
    own = tank()
    first, run = own.mpc.design.plant.point, own.simulate(steps=2, r=[1.2, 0.5])
    for _ in range(3):
        own.step([1.0, 0.6], r=[0.6, 0.9])
    assert np.abs(own.mpc.design.plant.point - first).max() > 0.1
    assert_allclose(own.simulate(steps=2, r=[1.2, 0.5]).u, run.u)
    own.redesign(dR=0.1)
    own.reset()
    assert_allclose(own.mpc.design.plant.point, first)


@pytest.mark.parametrize("u", [None, [0.0]])
def test_a_run_starts_with_the_resets_outputs_where_a_plant_rests_anywhere(u):
    model = lambda x, u: x + 0.1 * torch.tanh(u), [0.0], [0.0]
    own = qm.Controller(qm.LinearMPC(model, 10, Q=1.0, dR=0.1, u_bounds=(-2.0, 2.0)))
    own.reset(y=[3.0])
    assert_allclose(own.simulate(steps=1, r=[3.5], u=u).y[0], 3.0, atol=1e-6)


@pytest.mark.parametrize("u", [None, [0.1, 2.0]])
def test_a_run_starts_at_a_rest_of_the_plant_though_the_models_point_is_none(u):
    run = tank().simulate(steps=16, r=[1.2, 0.5], u=u, load=[0.01, 0.1])
    (X, S), (flow, feed) = run.y[0], run.u_last
    assert_allclose([X, 0.5 * S / (0.2 + S + S**2 / 2)], [0.4 * (feed - S), flow], atol=1e-6)
    assert S > 0
    assert_allclose(run.y[-1], [1.2, 0.5], atol=1e-2)


@pytest.mark.parametrize("bound", [None, 1e10])
def test_a_set_point_above_what_a_saturating_valve_holds_is_tracked_as_near_as_it_can(bound):
    f = qm.RungeKutta(lambda x, u: 1.2 * torch.tanh(u) - 0.6 * x.clamp(min=1e-4).sqrt(), 0.5)
    options: Any = {"Q": 1.0, "dR": 0.3, "u_bounds": (bound and -bound, bound)}
    own = qm.Controller(qm.LinearMPC((f, [1.0], [0.55]), 20, **options), noise=0.01)
    x = torch.tensor([1.0]).double()
    own.reset(y=x.numpy(), u=[0.55])
    for r in [0.3] * 3 + [5.0] * 6 + [1.0] * 9:
        x = f(x, torch.from_numpy(own.step(x.numpy(), r=[r])))
        assert own.status == 0
    assert_allclose(x, 1.0, atol=0.02)


def test_a_run_from_a_state_where_the_model_has_no_slope_says_how_to_start():
    model = lambda x, u: x + 0.1 * (u - x.sqrt()), [1.0], [1.0]  # at rest with zero: empty
    own = qm.Controller(qm.LinearMPC(model, 5, Q=1.0, dR=0.1, u_bounds=(0.0, 2.0)))
    with pytest.raises(SolverError, match="start elsewhere, by u or x"):
        own.simulate(steps=2, r=[1.5], u=[0.0])
    assert_allclose(own.simulate(steps=40, r=[1.5]).y[-1], 1.5, atol=1e-2)


def test_estimates_and_plans_survive_what_overflows():
    def burning(x: Tensor, u: Tensor) -> Tensor:
        return 0.8 * x + 0.2 * u + 1e-3 * torch.exp(50 * (x - 1.5))

    own = qm.Controller(qm.LinearMPC((burning, [0.0], [0.0]), 10, Q=1.0, dR=0.1, u_bounds=(-9, 9)))
    for y in (0.0, 60.0, 90.0, 1.0, 1.0):
        assert np.isfinite(own.step([y], r=[1.0])).all()
    assert np.isfinite(own.x).all()
    assert own.status == 0


def reacting(x: Tensor, u: Tensor) -> Tensor:
    """Return the slopes of a cooled reactor, which has a second state at rest for these inputs."""
    c, T = x.unbind(-1)
    burnt = 7.2e10 * torch.exp(-8750.0 / T) * c
    return torch.stack((1 - c - burnt, 350 - T + 209.2 * burnt + 2.092 * (u[..., 0] - T)), -1)


@pytest.mark.parametrize("u", [[280.0], [300.0]])
def test_a_start_is_near_rest_where_newtons_method_diverges(u):
    f, x = qm.RungeKutta(reacting, 0.05), torch.tensor([0.5, 350.0])
    model = f, x.numpy(), [300.0], [[0.0, 1.0]]
    own = qm.Controller(qm.LinearMPC(model, 10, Q=1.0, dR=0.1, u_bounds=(280, 370)), noise=0.1)
    own.reset(y=[350.0], u=u)
    for _ in range(22):
        x = f(x, torch.from_numpy(own.step(x.numpy()[1:], r=[345.0])))
        assert own.status == 0
    assert_allclose(x[1], 345.0, atol=0.05)
    assert_allclose(own.x, x, rtol=0.02)  # not the other state at rest


@pytest.fixture(scope="module")
def log() -> dict[str, np.ndarray]:
    """A log of a tank behind a valve whose flow is a square root: the second state is hidden."""
    rng, x, y, u = np.random.default_rng(0), np.array([1.0, 1.0]), [], []
    for flow in rng.uniform(0.2, 1.8, 121).repeat(10):
        y.append(x[1] + 0.01 * rng.normal())
        u.append(flow)
        x = x + 0.4 * (np.array([flow, x[0] ** 0.5]) - x**0.5)
    return {"y": np.array(y)[:, None], "u": np.array(u[:-1])[:, None]}


@pytest.mark.usefixtures("rough_fits")
def test_what_a_log_teaches_is_controlled_and_saved(log, tmp_path):
    model = qm.identify_nonlinear(qm.identify(log, order=3))
    assert model.depth
    options: Any = {"Q": 1.0, "dR": 0.1, "u_bounds": (0.0, 2.0), "disturbances": {"y": "u"}}
    own = qm.Controller(qm.LinearMPC(model, 10, **options), drift=0.02)
    assert own.mpc.design.plant.noise is not None
    x, rng, off = np.array([1.0, 1.0]), np.random.default_rng(1), []
    own.reset(y=[1.0], u=[1.0])
    for _ in range(40):
        u = own.step(x[1:] + 0.01 * rng.normal(), r=[2.0])
        x = np.maximum(x + 0.4 * (np.array([u[0] - 0.1, x[0] ** 0.5]) - x**0.5), 0.0)
        off.append(x[1] - 2.0)
    assert abs(np.mean(off[25:])) < 0.02
    own.save(tmp_path / "own.qpmpc")
    twin = qm.Controller.load(tmp_path / "own.qpmpc")
    for _ in range(3):
        assert_allclose(twin.step([1.9], r=[1.5]), own.step([1.9], r=[1.5]), rtol=1e-9)
    for each in (own, twin):
        each.reset(y=[1.0])
    assert_allclose(twin.mpc.design.plant.point, own.mpc.design.plant.point, rtol=1e-12)


def test_what_needs_matrices_refuses_functions(tmp_path, log):
    own = controller()
    for call in (
        lambda: own.export_c(tmp_path),
        lambda: qm.export_c(own.mpc.plan, tmp_path),
        lambda: own.learn(log),
        lambda: own.improve(log),
        lambda: controller(learn=("H",)),
        lambda: controller(u_levels={"hot": (0.0, 0.1)}),
    ):
        with pytest.raises(QPError, match="model: got a nonlinear model, expected A and B"):
            call()
    with pytest.raises(QPError, match="model: got a function, expected what"):
        own.save(tmp_path / "own.qpmpc")


@refused(
    ((lambda x, u: x.sqrt() + u, [0.0], [0.0]), {}, ".*x\\+ or its slope with NaN or inf at"),
    ((lambda x, u: x[0], [0.0], [0.0]), {}, "dynamics: got x\\+ and l of shapes"),
    ((lambda x, u: (u, x[..., 0]), [0.0], [0.0]), {}, "model: got a stage cost"),
    ((lambda x, u: x, [0.0], [0.0]), {"E": [[1.0]]}, "E: got .*, expected None"),
    (LearnedModel([0.0] * 2, [1.0] * 2, np.ones((3, 1)), 1), {}, "model: got a file's"),
)
def test_invalid_models_are_errors(model, options):
    qm.Controller(qm.LinearMPC(model, 5, Q=1.0, **options))
