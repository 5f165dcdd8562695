"""Targets with more inputs than outputs with a weight, beside independent solves."""

from typing import Any

import numpy as np
import pytest
import qpsolvers
import scipy.linalg

import torch_qpmpc as qm
from torch_qpmpc.export.tables import make_tables


def drawn(seed: int) -> qm.LinearMPC:
    rng = np.random.default_rng(seed)
    n, n_y = 4, int(rng.integers(1, 3))
    basis = np.linalg.qr(rng.normal(size=(n, n)))[0]
    A = basis * rng.uniform(-0.5, 0.9, n) @ basis.T
    B, C = rng.normal(size=(n, 4)), rng.normal(size=(n_y, n))
    bounds = -rng.uniform(0.2, 1, 4), rng.uniform(0.2, 1, 4)
    R, Q, aim = rng.uniform(0.1, 2, 4), rng.uniform(0.5, 2, n_y), rng.uniform(-0.3, 0.3, 4)
    return qm.LinearMPC((A, B, C), 2, Q=Q, R=R, u_bounds=bounds, u_target=aim)


def nearest(mpc: qm.LinearMPC, r: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the steady outputs nearest to r, and of the inputs with them those near u_target."""
    plant, (lower, upper) = mpc.design.plant, mpc.design.u_bounds
    gain = plant.C @ np.linalg.solve(np.eye(len(plant.A)) - plant.A, plant.B)
    Q = gain.T @ mpc.design.Q @ gain
    limits = {"lb": lower, "ub": upper, "solver": "quadprog"}
    u = qpsolvers.solve_qp(2 * Q + 1e-12 * np.eye(4), -2 * gain.T @ mpc.design.Q @ r, **limits)
    assert u is not None
    y = gain @ u
    # Of all u with these outputs: u = u_0 + F f.
    F, R = scipy.linalg.null_space(gain), mpc.design.R
    rows = {"G": np.vstack((F, -F)), "h": np.append(upper - u, u - lower) + 1e-9}
    off = F.T @ R @ (u - mpc.design.resting)
    f = qpsolvers.solve_qp(F.T @ R @ F, off, **rows, solver="quadprog")
    return y, u + F @ f


@pytest.mark.parametrize("seed", range(6))
def test_inputs_that_the_set_point_leaves_free_are_near_their_target(seed):
    mpc, rng = drawn(seed), np.random.default_rng([seed, 1])
    assert mpc.design.steady.anchors
    for size in (0.3, 1.0, 4.0):
        r = size * rng.normal(size=len(mpc.design.Q))
        target, (y, u) = mpc.target(r), nearest(mpc, r)
        assert np.abs(target.y.numpy() - y).max() < 1e-8
        assert np.abs(target.u.numpy() - u).max() < 1e-5


@pytest.mark.parametrize("r", [1.02, 1.028])
def test_a_set_point_that_a_free_input_hardly_moves_is_reached(r):
    A, B = np.array([[0.9, 0.05], [0.0, 0.8]]), np.array([[0.1, 0.0], [0.02, 0.2]])
    limits = {"u_bounds": (-1.754, 2.697), "y_bounds": {"h": (-0.53, 0.53)}}
    limits |= {"constraints": {"sum": ({"p": 1.0, "q": 0.5}, (None, 0.9636))}}
    names: Any = {"inputs": ["p", "q"], "outputs": ["T", "h"], "Q": {"T": 1.0}}
    mpc = qm.LinearMPC((A, B), 20, R=0.05, **names, **limits)
    assert abs(mpc.target([r, 0.0]).y[0] - r) < 1e-8


@pytest.mark.usefixtures("rough_fits")
def test_free_inputs_rest_near_the_log_s_mean_unless_told():
    rng, T = np.random.default_rng(0), np.full(400, 20.0)
    q = rng.uniform(2, 6, (20, 2)).repeat(20, 0)
    for k in range(399):
        T[k + 1] = 0.8 * T[k] + 0.5 * q[k, 0] + 0.5 * q[k, 1] + 0.01 * rng.normal()
    log = qm.read_log({"T": T, "q1": q[:, 0], "q2": q[:, 1]}, outputs=["T"], inputs=["q1", "q2"])
    mpc = qm.LinearMPC(qm.identify(log, horizon=8), 8, Q=1.0, R=0.1, dR=0.1, u_target={"q2": 1.0})
    controller = qm.Controller(mpc)
    mean = q[:-1, 0].mean()
    assert np.allclose(mpc.design.resting, [mean, 1.0], rtol=1e-6)
    middle = mpc.target([20.0]).u.sum()
    assert np.allclose(middle, 8.0, atol=0.1)
    assert np.allclose(np.diff(mpc.target([20.0]).u), 1.0 - mean, atol=0.1)
    controller.step([20.0], [20.0])
    assert f"free: at rest near {mean:.4g}" in str(controller.explain())
    assert controller.review()["free inputs"].text.endswith(f"near q1 {mean:.4g} and q2 1.")
    controller.redesign(u_target={"q2": None, "q1": 3.0})
    assert np.allclose(controller.mpc.design.resting, [3.0, q[:-1, 1].mean()], rtol=1e-6)
    with pytest.raises(qm.QPError, match=r"^u_target: got \[inf, 1.0\], expected finite numbers"):
        controller.redesign(u_target=[np.inf, 1.0])


@pytest.mark.parametrize("seed", range(6))
def test_zones_hold_the_outputs_that_free_inputs_move(seed):
    """The set-point and the price of a zone's violation decide, and no preference of inputs."""
    rng = np.random.default_rng(seed)
    A, B, C = np.diag(rng.uniform(-0.3, 0.9, 3)), rng.normal(size=(3, 3)), rng.normal(size=(3, 3))
    half, price, Q = rng.uniform(0.1, 2), rng.uniform(5, 50), np.diag([1.0, 0.0, 0.0])
    zones = {"y_bounds": ([-np.inf, -half, -half], [np.inf, half, half]), "y_slack": price}
    mpc = qm.LinearMPC((A, B, C), 2, Q=Q, R=0.1, u_bounds=(-1.0, 1.0), **zones)
    gain, n = C @ np.linalg.solve(np.eye(3) - A, B), mpc.design.steady.anchors
    assert n == 2
    # The entries are u and the zones' violations.
    rows = np.block([[gain[1:], -np.eye(2)], [-gain[1:], -np.eye(2)]])
    P = np.pad(2 * gain.T @ Q @ gain, (0, 2)) + 1e-9 * np.eye(5)
    limits: Any = {
        "lb": np.append(-np.ones(3), [0.0, 0.0]),
        "ub": np.append(np.ones(3), [9e9, 9e9]),
    }
    for size in (0.3, 1.0, 4.0):
        r = size * rng.normal(size=3)
        q = np.append(-2 * gain.T @ Q @ r, [price, price])
        z = qpsolvers.solve_qp(P, q, rows, np.full(4, half), **limits, solver="quadprog")
        y = mpc.target(r).y.numpy()
        assert abs(y[0] - gain[0] @ z[:3]) < 1e-6
        assert abs((np.abs(y[1:]) - half).clip(0).sum() - z[3:].sum()) < 1e-6


def test_a_target_at_a_zone_takes_few_rounds(monkeypatch):
    """The rounds shrink geometrically: two of them tell where they end."""
    A, B = np.diag([0.9, 0.8]), np.array([[0.1, 0.02], [0.01, 0.2]])
    zone = {"y_bounds": ([-np.inf, -0.2], [np.inf, 0.2]), "u_bounds": (-3.0, 3.0)}
    mpc = qm.LinearMPC((A, B), 2, Q=[1.0, 0.0], R=0.01, **zone)
    calls, solve = [], mpc.targets.solve
    monkeypatch.setattr(mpc.targets, "solve", lambda *a, **k: calls.append(1) or solve(*a, **k))
    assert np.allclose(mpc.target([3.0, 0.0]).y, [3.0, 0.2], atol=1e-8)
    assert 1 < len(calls) <= 6


def test_many_inputs_of_one_output_have_bounds_of_its_own():
    """The gains of 24 inputs within 1 add up to the output that they can hold."""
    B = np.random.default_rng(0).uniform(0.1, 1, (1, 24))
    mpc = qm.LinearMPC(([[0.5]], B, [[1.0]]), 2, Q=1.0, R=0.1, u_bounds=(-1.0, 1.0))
    target = mpc.target([1e3])
    assert abs(target.y.item() - B.sum() / 0.5) < 1e-6
    assert np.abs(target.u.numpy() - 1).max() < 1e-6


@pytest.mark.parametrize("gains", [[1.0], [1.0, 0.5]])
def test_a_load_beyond_the_inputs_of_an_integrator_has_a_target(gains):
    """Inputs within 1 cannot hold a disturbance of 5: the target exceeds their bounds."""
    weights: Any = {"Q": 1.0, "R": 0.1, "dR": 1.0, "u_bounds": (-1.0, 1.0)}
    mpc = qm.LinearMPC(([[1.0]], [gains], [[1.0]]), 5, **weights)
    target = mpc.target([0.5], 5.0)
    assert np.isclose(target.y.item(), 0.5)
    u = target.u.numpy().ravel()
    assert u.min() < -1
    assert abs(u @ gains + mpc.design.disturbances.B[0] @ np.full(1, 5.0)) < 1e-6
    p = mpc.arrange([0.5], target, u_last=-np.ones(len(gains)))
    assert np.allclose(u + mpc.plan.policy(p).detach().numpy(), -1.0)


def test_rounding_beside_outputs_of_large_numbers_sets_no_length():
    """An integrator and a lag, each with an output: the basis of the steady states is dense."""
    B, C = np.random.default_rng(0).normal(size=(2, 3)), np.diag([1e2, 1e6])
    weights: Any = {"Q": [1e-4, 1e-12], "dR": 1.0, "u_bounds": (-1.0, 2.0)}
    bounds: Any = {"y_bounds": {"y2": (-1e6, 1e6)}}
    mpc = qm.LinearMPC((np.diag([1.0, 0.6]), B, C), 4, **weights, **bounds)
    assert make_tables(mpc.targets).condition < 1e3
