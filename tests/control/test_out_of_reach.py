"""Set-points that bounds put out of reach, and forecasts that are not constant, beside own QPs.

The reference minimises the cost of `LinearMPC`'s docstring over a long horizon, without targets: by
Wright's turnpike its first input is that of an endless loop, whose slope the terminal cost has.
"""

from typing import Any

import numpy as np
import pytest
import qpsolvers

import torch_qpmpc as qm
from tests.campaign.soak import soak
from tests.control.controllers import exported

#: Stages of the reference, which sees far past the controller's.
LONG = 60
A = np.array([[0.9, 0.05, 0.0], [0.0, 0.8, 0.1], [0.05, 0.0, 0.85]])
B = np.array([[0.3, 0.0], [0.1, 0.4], [0.0, 0.1]])
C = np.array([[1.0, 0.0, 0.2], [0.0, 1.0, 0.5]])
E = np.array([[0.1], [0.0], [0.3]])
DESIGN: dict[str, Any] = {"Q": [2.0, 1.0], "dR": [0.3, 0.1], "u_bounds": (-1.0, 1.0)}


def made(horizon: int = 10, **options: Any) -> qm.Controller:
    mpc = qm.LinearMPC((A, B, C), horizon, E=E, known=["d"], **DESIGN | options)
    return qm.Controller(mpc, noise=0.02)


def best(x: np.ndarray, u_last: np.ndarray, r: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Return the first input of the cost's optimum over as many stages as r has rows."""
    N, powers = len(r), [np.linalg.matrix_power(A, k) for k in range(len(r) + 1)]
    zero, free = np.zeros((2, 2)), [x]
    for load in d[: N - 1]:
        free.append(A @ free[-1] + E @ load)
    response = [[C @ powers[k - j - 1] @ B if j < k else zero for j in range(N)] for k in range(N)]
    G, D = np.block(response), np.eye(2 * N) - np.eye(2 * N, k=-2)
    Q, dR = (np.tile(weight, N) for weight in (DESIGN["Q"], DESIGN["dR"]))
    off = (np.array(free) @ C.T - r).ravel()
    before = np.r_[u_last, np.zeros(2 * N - 2)]
    P = 2 * (G.T * Q @ G + D.T * dR @ D)
    q = 2 * (G.T * Q @ off - D.T * dR @ before)
    ones = np.ones(2 * N)
    u = qpsolvers.solve_qp((P + P.T) / 2, q, lb=-ones, ub=ones, solver="quadprog")
    return u[:2]


def estimated(controller: qm.Controller, d: float) -> np.ndarray:
    """Return the state that the last step's plan began with, from the prediction after it."""
    observer, e = controller.observer, controller._memory.e
    still = observer.predicted(np.zeros_like(e), controller.u, np.array([d]))
    return np.linalg.solve(observer.F, e - still)[: len(A)]


@pytest.mark.parametrize("r", [[9.0, -1.0], [1.0, 6.0], [-8.0, 8.0], [0.5, 0.3]])
def test_a_plan_is_the_optimum_of_an_endless_loop(r):
    """The filter's estimates are off in a noisy loop; both plan from them."""
    rng, x, controller, differences = np.random.default_rng(0), np.zeros(3), made(25), []
    controller.reset(y=[0.0, 0.0], u=[0.0, 0.0], known=[0.0])
    ahead = np.tile(r, (LONG, 1)), np.full((LONG, 1), 0.2)
    for k in range(12):
        u_last = controller.u
        u = controller.step(C @ x + 0.02 * rng.normal(size=2), r, known=[0.2])
        if k % 4 == 3:
            w = controller.w @ np.linalg.pinv(controller.mpc.design.disturbances.C).T
            own = best(estimated(controller, 0.2), u_last, ahead[0] - w, ahead[1])
            differences.append(np.abs(u - own).max())
        x = A @ x + B @ u + E @ [0.2]
    assert max(differences) < 1e-3


def test_a_horizon_decides_little_about_a_set_point_out_of_reach():
    """The terminal slope stands for what comes after the plan."""
    loops = []
    for horizon in (3, 40):
        run = made(horizon).simulate(steps=120, r=[1.5, 6.0], known=[0.1], u=[0.0, 0.0])
        loops.append(run)
    short, long = loops
    assert np.abs(short.y[-1] - long.y[-1]).max() < 1e-6, "they rest at the same outputs"
    assert short.cost.sum() < 1.02 * long.cost.sum()


@pytest.mark.parametrize("horizon", [3, 10, 48])
def test_an_input_that_will_rest_at_its_bound_is_used_until_then(horizon):
    """It turns warm: in the end a room with heavy walls needs no heat, but not for 100 steps."""
    A, B, E = np.array([[0.88, 0.1], [0.01, 0.985]]), np.array([0.1, 0.0]), np.array([0.02, 0.005])
    design: dict[str, Any] = {"Q": 1.0, "dR": 0.025, "u_bounds": (0.0, 5.0)}
    model = A, B[:, None], [[1.0, 0.0]]
    mpc = qm.LinearMPC(model, horizon, E=E[:, None], known=["d"], **design)
    controller = qm.Controller(mpc, noise=0.02, drift=0.002)
    x, u, cost = np.linalg.solve(np.eye(2) - A, 2.0 * B + 8.0 * E), 2.0, 0.0
    controller.reset(y=x[:1], u=[u], known=[8.0])
    for _ in range(100):
        last, (u,) = u, controller.step(x[:1], r=[12.0], known=[12.3])
        cost += (x[0] - 12.0) ** 2 + 0.025 * (u - last) ** 2
        x = A @ x + B * u + 12.3 * E
    assert cost < 0.2


@pytest.mark.parametrize("seed", range(2))
def test_a_forecast_is_paid_for_when_it_comes(seed):
    """A load for later may be out of reach: now the set-point is held, as by an own QP."""
    rng, x = np.random.default_rng(seed), np.zeros(3)
    d = np.r_[np.zeros(8), np.full(6, rng.uniform(3, 9)), np.zeros(LONG)][:, None]
    controller, r, held = made(24), np.tile([0.4, 0.2], (LONG, 1)), np.arange(LONG).clip(max=24)
    controller.reset(y=[0.0, 0.0], u=[0.0, 0.0], known=[0.0])
    for k in range(6):
        u_last, stages = controller.u, d[k : k + 25]
        u = controller.step(C @ x, r[0], known=stages)
        w = controller.w @ np.linalg.pinv(controller.mpc.design.disturbances.C).T
        own = best(estimated(controller, d[k, 0]), u_last, r - w, stages[held])
        assert np.abs(u - own).max() < 1e-3
        x = A @ x + B @ u + E @ d[k]


def test_inputs_with_a_weight_are_held_about_the_target_of_their_stage():
    """R about the target of the forecast's mean moved the outputs off a set-point within reach."""
    controller, x = made(20, R=[0.5, 0.5]), np.zeros(3)
    assert controller.mpc.design.staged
    d = 0.5 * np.sin(np.arange(200) / 15)[:, None]
    for k in range(120):
        u = controller.step(C @ x, [0.3, 0.2], known=d[k : k + 21])
        x = A @ x + B @ u + E @ d[k]
    assert controller.target.u.shape == (21, 2)
    assert np.abs(C @ x - [0.3, 0.2]).max() < 0.02


# Bounds of outputs


def coupled(horizon: int = 8, **options: Any) -> qm.Controller:
    """Return the controller of y1 whose input moves y2 through three lags, in a zone."""
    A = np.diag([0.8, 0.7, 0.7, 0.7]) + np.diag([0.0, 0.3, 0.3], 1)
    B, C = [[0.2], [0.0], [0.0], [0.3]], np.eye(2, 4)
    zone: dict[str, Any] = {"Q": {"y1": 1.0}, "dR": 0.1, "y_bounds": {"y2": (-0.5, 0.5)}}
    return qm.Controller(qm.LinearMPC((A, B, C), horizon, **zone | options))


@pytest.mark.parametrize("horizon", [3, 8])
@pytest.mark.parametrize("bounds", [(-5.0, 50.0), (-1.0, 0.2)])
def test_a_plan_rests_where_a_zone_or_the_input_stops_it(horizon, bounds):
    """Bounds after the horizon do not act: with r itself plans ended outside the zone."""
    run = coupled(horizon, u_bounds=bounds).simulate(steps=150, r=[2.0, 0.0], u=[0.0])
    assert np.allclose(run.y[-1], min(0.5, bounds[1]), atol=1e-6)
    assert run.y[:, 1].max() < 0.5 + 1e-6


def test_a_set_point_is_weighed_but_for_what_bounds_of_outputs_hold_off():
    mpc = coupled(u_bounds=(-1.0, 1.0)).mpc
    held, pushed, free = mpc.target([[2.0, 0.0], [-3.0, 0.0], [0.3, 0.0]]).end[:, 0]
    assert np.allclose([held, pushed, free], [0.5, -0.5, 0.3], atol=1e-7)
    narrow = coupled(u_bounds=(-0.1, 0.1)).mpc
    assert np.allclose(narrow.target([2.0, 0.0]).end[0], 2.0), "the input's bound alone"
    hot = coupled(u_bounds=(-1.0, 1.0), y_bounds={"y2": (2.0, 3.0)}).mpc.target([-3.0, 0.0])
    assert np.allclose([hot.y[0], hot.end[0]], 1.0), "the zone pulls the other way"
    own = coupled(u_bounds=(-1.0, 1.0), y_bounds={"y1": (2.0, 3.0)}).mpc.target([2.5, 0.0])
    assert np.allclose([own.y[0], own.end[0]], [1.0, 2.5]), "both pull the same way"


@pytest.mark.parametrize("options", [{}, {"references": "preview"}, {"u_bounds": (-0.3, 0.3)}])
@pytest.mark.parametrize("horizon", [2, 20])
def test_a_bound_is_left_as_far_as_its_price_pays(horizon, options):
    """(y - 2)^2 + (y - 1) / 2 is least at 1.75, which u = 0.3 does not reach."""
    bounds: Any = {"y_bounds": (None, 1.0), "y_slack": 0.5, "u_bounds": (-9.0, 9.0), **options}
    controller, y = qm.Controller(qm.LinearMPC(([[0.9]], [[0.5]]), horizon, Q=1.0, **bounds)), 0.0
    for _ in range(200):
        y = 0.9 * y + 0.5 * controller.step([y], [2.0])[0]
    rest = 1.5 if "u_bounds" in options else 1.75
    assert y == pytest.approx(rest, abs=1e-6)


def test_zones_alone_rest_where_the_inputs_cost_least():
    names: Any = {"outputs": ["T", "h"], "inputs": ["p", "q"], "y_bounds": {"T": (1.0, 2.0)}}
    model = np.diag([0.9, 0.8]), np.array([[0.1, 0.02], [0.01, 0.2]])
    controller, x = qm.Controller(qm.LinearMPC(model, 10, R=0.01, **names)), np.zeros(2)
    for _ in range(200):
        u = controller.step(x)
        x = model[0] @ x + model[1] @ u + [0.01, 0.0]
    row = model[1][0]  # row @ u = 0.09 holds T at 1
    assert np.abs(u - 0.09 * row / (row @ row)).max() < 1e-6


@pytest.mark.parametrize(
    ("make", "options"),
    [
        (made, {}),
        (made, {"R": (0.5, 0.1)}),
        (made, {"references": "preview"}),
        (coupled, {"u_bounds": (-1.0, 1.0)}),
    ],
)
def test_c_plans_for_the_same_set_points(make, options):
    difference, counts = soak(*exported(make, **options), 150, 0, 1, size=8.0, faults=0.0)
    assert difference < 1e-8
    assert counts["SOLVED"] == 150
