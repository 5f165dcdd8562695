"""Mixed and terminal constraints of a `LinearMPC`, beside QPs of the tests' own and in C."""

from typing import Any

import numpy as np
import pytest
import qpsolvers
from scipy.linalg import block_diag

import torch_qpmpc as qm
from tests.campaign.soak import soak
from tests.control.controllers import exported
from tests.refused import refused
from torch_qpmpc.control.simulation import Run

A, B = np.diag([0.9, 0.7]), np.array([[0.3, 0.1], [-0.1, 0.4]])
MODEL = A, B, np.eye(2)
Q, DR, N = np.diag([1.0, 0.5]), 0.2, 60
NAMES: Any = {"outputs": ["T", "p"], "inputs": ["heater", "fan"]}
HARD = {"power": ({"heater": 1.0, "fan": 2.0}, (None, 1.5))}
SOFT = {"mixed": ({"T": 1.0, "fan": -0.5}, (-1.0, 0.6), 3.0)}
ENDS = {"end": ({"T": 1.0, "p": 1.0}, (0.4, 0.5), 20.0)}


def made(horizon: int = N, **options: Any) -> qm.Controller:
    options = {"Q": Q, "dR": DR, "u_bounds": (-1.0, 1.0), **NAMES, **options}
    return qm.Controller(qm.LinearMPC(MODEL, horizon, **options))


def rows_of(constraint: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    weights, (lower, upper), *price = constraint
    W = np.array([weights.get(x, 0.0) for x in (*NAMES["outputs"], *NAMES["inputs"])])
    bounds = [-np.inf if lower is None else lower, np.inf if upper is None else upper]
    return W[:2], W[2:], np.array(bounds), [*price, np.inf][0]


def planned(x: np.ndarray, r: np.ndarray, constraints: Any, ends: Any) -> np.ndarray:
    """Return the first input of the optimum over N stages from x, after inputs of zero."""
    powers, zero = [np.linalg.matrix_power(A, k) for k in range(N + 1)], np.zeros((2, 2))
    rows = [[powers[i - 1 - j] @ B if i > j else zero for j in range(N)] for i in range(N + 1)]
    Y, y = np.block(rows), np.concatenate([power @ x for power in powers])
    moves = np.kron(np.eye(N) - np.eye(N, k=-1), np.eye(2))
    weight, off = np.kron(np.eye(N + 1), Q), y - np.tile(r, N + 1)
    H, q = Y.T @ weight @ Y + moves.T @ moves * DR, Y.T @ weight @ off
    cases = [(rows_of(own), range(N)) for own in constraints.values()]
    cases += [(rows_of(own), [N]) for own in ends.values()]
    limits = []
    for (of_y, of_u, bounds, price), stages in cases:
        for k in stages:
            row = of_y @ Y[2 * k : 2 * k + 2] + of_u @ np.eye(2, 2 * N, 2 * k)
            at = of_y @ y[2 * k : 2 * k + 2]
            limits += [(s * row, s * (b - at), price) for s, b in zip((-1, 1), bounds, strict=True)]
    G, h, prices = map(np.array, zip(*((g, b, w) for g, b, w in limits if b < np.inf), strict=True))
    soft, n = np.isfinite(prices), 2 * N
    G = np.block([[G, -np.eye(len(G))[:, soft]], [np.zeros((soft.sum(), n)), -np.eye(soft.sum())]])
    H: Any = block_diag(2 * H, 1e-9 * np.eye(soft.sum()))
    h, q = np.append(h, np.zeros(soft.sum())), np.append(2 * q, prices[soft])
    side = np.append(np.ones(n), np.full(soft.sum(), 1e3))
    z = qpsolvers.solve_qp(H, q, G, h, lb=-side, ub=side, solver="quadprog")
    return z[:2]


@pytest.mark.parametrize(
    ("constraints", "ends"), [(HARD, {}), (SOFT, {}), ({**HARD, **SOFT}, {}), ({}, ENDS)]
)
def test_a_plan_is_the_optimum_of_the_cost_under_them(constraints, ends):
    options = {"constraints": constraints, "terminal_constraints": ends}
    mpc, x, binding = made(N, **options).mpc, np.array([0.3, -0.2]), 0
    for r in ([0.2, 0.1], [1.0, 0.6], [2.0, -1.0], [-2.0, 1.0]):
        target = mpc.target(r)
        plan = mpc.plan.solve(mpc.arrange(x, target, u_last=[0.0, 0.0]))
        u = target.u.numpy() + plan.z[mpc.plan.n_p :][:2].detach().numpy()
        assert np.abs(u - planned(x, np.array(r), constraints, ends)).max() < 1e-6
        binding += bool(plan.active.any())
    assert binding >= 2


def test_outputs_settle_at_the_steady_state_that_they_leave_nearest_to_the_set_point():
    controller, x, r = made(12, constraints={**HARD, **SOFT}), np.zeros(2), np.array([1.0, 2.0])
    load = np.array([0.1, -0.05])
    for _ in range(300):
        u = controller.step(x, r)
        x = A @ x + B @ (u + load)
    gain = np.linalg.solve(np.eye(2) - A, B)
    (_, of_u, (_, top), _), (y_m, u_m, (_, high), price) = map(
        rows_of, (*HARD.values(), *SOFT.values())
    )
    P: Any = block_diag(2 * gain.T @ Q @ gain, 1e-10)
    q = np.append(2 * gain.T @ Q @ (gain @ load - r), price)
    G = np.vstack((np.append(of_u, 0), np.append(y_m @ gain + u_m, -1)))
    h, side = np.array([top, high - y_m @ gain @ load]), np.array([1.0, 1.0, 1e3])
    z = qpsolvers.solve_qp(P, q, G, h, lb=-side * [1, 1, 0], ub=side, solver="quadprog")
    assert np.abs(u - z[:2]).max() < 1e-5
    assert "constraints of " in controller.review(r).faults[0].remedy


def test_c_keeps_them_alike():
    difference, counts = soak(*exported(bounded, missing=True), 300, 0, 0, size=2.0)
    assert difference < 1e-8
    assert {*counts} >= {"SOLVED", "MISSING"}


def bounded(**options: Any) -> qm.Controller:
    own = {"constraints": {**HARD, **SOFT}, "terminal_constraints": ENDS, **options}
    return made(8, y_bounds={"p": (-1.5, 1.5)}, du_bounds=(-0.8, 0.8), **own)


def test_they_are_saved_explained_and_paid_for(tmp_path):
    controller = bounded(constraints={"mixed": (*SOFT["mixed"][:2], 0.3)})
    controller.step([0.9, 0.0], [3.0, 0.0])
    controller.save(tmp_path / "c.qpmpc")
    loaded, text = qm.Controller.load(tmp_path / "c.qpmpc"), str(controller.explain())
    assert np.abs(loaded.step([0.9, 0.0]) - controller.step([0.9, 0.0])).max() < 1e-12
    assert "mixed is at its upper bound 0.6 in steps" in text
    assert "end is at its upper bound 0.5 in step 8" in text
    hard = made(8, terminal_constraints={"end": (*ENDS["end"][:2], np.inf)})
    assert hard.review(r=[0.3, 0.0])["hard bounds"].remedy == "Give end a finite price."
    run = controller.simulate(steps=20, r=[3.0, 0.0], load=[0.3, 0.0])
    plain = made(8, y_bounds={"p": (-1.5, 1.5)}, du_bounds=(-0.8, 0.8)).mpc.design
    over = np.maximum(run.y[:-1, 0] - 0.5 * run.u[:, 1] - 0.6, 0)
    own = Run(plain, run.y, run.r, run.u, run.known, run.u_s, run.u_last)
    assert over.max() > 0.1
    assert np.allclose(run.cost, own.cost + 0.3 * over)
    controller.redesign(constraints={"mixed": None}, terminal_constraints={"end": None})
    assert not controller.mpc.design.constraints
    assert not {*controller.mpc.design.bands.names} & {"mixed", "end"}


@refused(
    ([1.0], r"constraints: got \[1.0\], expected a mapping from names to \(weights of signals"),
    ({"a": 1.0}, r"constraints: got 'a': 1.0, expected \(weights of signals by name, \(lower"),
    ({"a": ({}, (0, 1))}, r"constraints: got 'a': \({}, \(0, 1\)\), expected \(weights of signals"),
    ({"a": ({"heat": 1.0}, (0, 1))}, "constraints: got 'heat', expected names among T, p, heat"),
    ({"a": ({"T": np.inf}, (0, 1))}, r"constraints: got 'a': \({'T': inf}, \(0, 1\)\), expected"),
    ({"a": ({"T": 1.0}, (1, 0))}, r"constraints: got \(1, 0\) for a, expected lower <="),
    ({"a": ({"T": 1.0}, (0, 1), -1.0)}, r"constraints: got 'a': .* \(0, 1\), -1.0\), exp"),
)
def test_a_wrong_constraint_is_named(constraints):
    made(constraints=constraints)


@refused(({"T": 1.0, "fan": 1.0}, "terminal_constraints: got 'fan', expected names among T, p"))
def test_a_terminal_constraint_has_outputs_alone(weights):
    made(terminal_constraints={"a": (weights, (0, 1))})
