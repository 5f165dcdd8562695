"""The filter of a model with a log starts from the states of the log, in Python and in C."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scipy.linalg
import scipy.signal

import torch_qpmpc as qm
from tests.control.controllers import exported, load
from tests.refused import refused
from torch_qpmpc.control.observer import SETTLED, moving
from torch_qpmpc.control.state_space import read_model

A, B, C = np.array([[0.9, 0.1], [0.0, 0.7]]), np.array([[0.0], [0.5]]), np.array([[1.0, 0.0]])
NOISE = np.array([[0.4], [0.3]]), np.array([[0.04]])
VISITED = np.array([2.0, 1.0]), np.array([[1.0, 0.3], [0.3, 0.5]])


def filtered(**options) -> qm.Controller:
    """Return the controller of a plant with a hidden state, and the noise and states of a log."""
    plant = replace(read_model((A, B, C)), noise=NOISE, visited=VISITED)
    options = {"u_bounds": (-2.0, 2.0), **options}
    return qm.Controller(qm.LinearMPC(plant, 8, Q=1.0, R=0.1, **options))


def test_estimates_are_the_means_of_the_states_given_all_outputs():
    """Outputs, states and disturbances are one Gaussian vector: its conditional mean is exact."""
    controller, rng = filtered(), np.random.default_rng(0)
    o, design = controller.observer, controller.mpc.design
    steps, n_e = 5, len(o.F)
    loads = moving(design, 0.1 * design.usual)
    V = NOISE[1] + np.diag((1e-3 * design.usual) ** 2)
    # Rows of e_0, v_0, d_0, v_1, .. in these sources: e_0, then the noise v and drift d of a step.
    first = np.diag([*np.zeros(2), *loads**2])
    first[:2, :2] = VISITED[1]
    step = np.diag([V[0, 0], *controller._law.drift**2])
    sources = n_e + steps * len(step)
    cov = np.zeros((sources, sources))
    cov[:n_e, :n_e] = first
    for k in range(steps):
        at = n_e + k * len(step)
        cov[at : at + len(step), at : at + len(step)] = step
    of_e, mean = np.eye(n_e, sources), o.start.copy()
    G, W = np.vstack((NOISE[0], [[0.0]])), np.vstack((np.zeros((2, 1)), [[1.0]]))
    seen, means, ys = [], [], []
    for k in range(steps):
        at = n_e + k * len(step)
        of_v, of_d = np.eye(1, sources, at), np.eye(1, sources, at + 1)
        seen.append(o.H @ of_e + of_v)
        means.append(o.H @ mean)
        ys.append(rng.normal(2.0, 1.0, 1))
        u = controller.step(ys[-1], [0.5])
        of_e = o.F @ (of_e + G @ of_v) + W @ of_d
        mean = o.F @ mean + o.G @ u + o.offset
        R, off = np.concatenate(seen), np.concatenate(ys) - np.concatenate(means)
        exact = mean + of_e @ cov @ R.T @ np.linalg.solve(R @ cov @ R.T, off)
        assert np.allclose(np.concatenate((controller.x, controller.w)), exact, atol=1e-9)


def test_gains_end_where_they_are_steady_and_a_plant_at_rest_has_the_last_one():
    controller = filtered()
    gains = controller.observer.gains
    off = np.abs(gains - gains[-1]).max((1, 2)) / np.abs(gains[-1]).max()
    assert 3 < len(gains) <= 101
    assert off[0] > 10 * SETTLED
    controller.reset(y=[1.0], u=[0.0])
    before = np.concatenate((controller.x, controller.w))
    u = controller.step([1.5], [0.5])
    o = controller.observer
    after = o.predicted(before + o.L @ ([1.5] - o.H @ before), u, np.zeros(0))
    assert np.allclose(np.concatenate((controller.x, controller.w)), after)


def test_estimates_go_on_with_the_steady_gain_after_more_steps_than_there_are_gains():
    """As after learning a model that settles sooner."""
    controller, other = filtered(), filtered()
    for c, steps in ((controller, 1000), (other, len(other.observer.gains) - 1)):
        c.step([2.0], [0.5])
        c._memory = c._memory._replace(steps=steps)
        c.step([1.5])
    assert np.array_equal(controller.x, other.x)


def test_a_disturbance_drifts_within_the_horizon_by_the_noise_of_the_outputs():
    x = responses = np.zeros(2)
    for _ in range(8):
        x = A @ x + B[:, 0]
        responses = np.maximum(responses, x)
    for kind, bound, reach in (("output", 2.0, 1.0), ("u1", 20.0, responses[0])):
        law = filtered(disturbances={"y1": kind}, u_bounds=(-bound, bound))._law
        assert np.allclose(law.noise, 0.2, rtol=1e-4)
        assert np.allclose(law.drift, law.noise / reach)
    law = filtered(disturbances={"y1": "u1"}, u_bounds=(-0.2, 0.2))._law
    assert np.allclose(law.drift, 0.1 * 0.2), "at most a tenth of the input's range"


@pytest.mark.parametrize("missing", [False, True])
def test_c_starts_from_the_same_states_and_settles_alike(missing):
    controller, twin = exported(filtered, missing)
    rng = np.random.default_rng(1)
    for y, u in ((None, None), ([0.3], [0.5])):
        controller.reset(y, u)
        twin.reset(y, u, None)
        for k in range(2 * len(controller.observer.gains)):
            lost = missing and k in (2, 3, 6, 7, 8)
            y = [np.nan if lost else rng.normal(1.0, 0.5)]
            input_, code = twin.step(y, [[0.5]])
            assert np.allclose(controller.step(y, [0.5]), input_, atol=1e-9)
            assert controller.status == code == (4 if lost else 0)


MASS = np.array([[1.0, 0.1], [0.0, 1.0]]), np.array([[0.005], [0.1]])
TWO = np.array([[1.0, 0.0], [0.0, 0.3]])


def two_sensors() -> qm.Controller:
    options = {"Q": {"y1": 1.0}, "dR": 0.1, "u_bounds": (-5.0, 5.0)}
    mpc = qm.LinearMPC((*MASS, TWO), 10, **options)
    return qm.Controller(mpc, noise=[0.01, 0.05])


def test_gains_of_missing_outputs_are_those_of_the_textbook_filter_in_python_and_in_c():
    """Position every seventh step, speed with losses; both also from a reset, and in full."""
    controller, twin = exported(two_sensors, True)
    o, rng = controller.observer, np.random.default_rng(3)
    controller.reset(y=[0.0, 0.0], u=[0.0])
    twin.reset([0.0, 0.0], [0.0], None)
    n_e = len(o.F)
    # The steady state's own covariance, by Riccati's equation with the noise of `kalman`.
    B, drift, noise = o.G, controller._law.drift, controller._law.noise
    W = (0.01 * 5) ** 2 * B @ B.T + np.diag([0.0, 0.0, *drift**2])
    V = np.diag(noise**2)
    P = scipy.linalg.solve_discrete_are(o.F.T, o.H.T, W, V)
    np.testing.assert_allclose(P @ o.H.T @ np.linalg.inv(o.H @ P @ o.H.T + V), o.L, atol=1e-9)
    e = np.concatenate((controller.x, controller.w))
    for k in range(120):
        seen = np.array([k % 7 == 0 or k > 60, rng.random() < 0.4 or k > 60])
        y = np.where(seen, rng.normal(0.0, 0.05, 2), np.nan)
        H = o.H[seen]
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + V[np.ix_(seen, seen)])
        e, P = e + K @ (y[seen] - H @ e), P - K @ H @ P
        input_, code = twin.step(y, [[0.2, 0.0]])
        u = controller.step(y, [0.2, 0.0])
        e, P = o.predicted(e, u, np.zeros(0)), o.F @ P @ o.F.T + W
        np.testing.assert_allclose(np.concatenate((controller.x, controller.w)), e, atol=1e-9)
        np.testing.assert_allclose(input_, u, atol=1e-8)
        assert controller.status == code == (0 if seen.all() else 4)
    assert controller._memory.P is None, "steady again"
    assert len(e) == n_e


def test_a_saved_controller_settles_as_if_it_had_not_been_saved(tmp_path):
    controller = filtered()
    controller.step([2.5], [0.5])
    controller.save(tmp_path / "c.qpmpc")
    again = qm.Controller.load(tmp_path / "c.qpmpc")
    for y in ([1.0], [2.0]):
        assert np.array_equal(controller.step(y), again.step(y))
        assert np.array_equal(controller.x, again.x)


@pytest.mark.parametrize("form", ["matrix", "function"])
def test_a_gain_of_one_s_own_places_the_observer_s_poles(form, tmp_path):
    """Python, C through a gap, and a file; another noise brings the Kalman filter back."""
    mpc = qm.LinearMPC(([[0.9]], [[0.5]]), 8, Q=1.0, dR=0.1, u_bounds=(-1.0, 1.0))

    def placed(F, H):
        found: Any = scipy.signal.place_poles(F.T, H.T, [0.2, 0.3])
        return np.linalg.solve(F, found.gain_matrix.T)

    o = qm.Controller(mpc).observer
    gain = placed if form == "function" else placed(o.F, o.H)
    controller = qm.Controller(mpc, gain=gain)
    o = controller.observer
    assert np.allclose(sorted(np.linalg.eigvals(o.F - o.F @ o.L @ o.H)), [0.2, 0.3])
    twin = load(controller.export_c(tmp_path, missing=True).files, controller)
    controller.save(tmp_path / "own.qpmpc")
    loaded, y = qm.Controller.load(tmp_path / "own.qpmpc"), 0.0
    for k in range(40):
        seen = np.nan if k % 9 == 5 else y
        u = controller.step([seen], [0.7])
        assert np.allclose(u, twin.step([seen], [0.7])[0], atol=1e-9)
        assert np.array_equal(u, loaded.step([seen], [0.7]))
        y = 0.9 * y + 0.4 * u[0] + 0.1
    assert abs(y - 0.7) < 1e-6
    controller.redesign(noise=0.1)
    assert np.array_equal(controller.observer.L, qm.Controller(mpc, noise=0.1).observer.L)


@refused(
    ([[0.5]], r"gain: got shape \(1, 1\), or NaN, expected finite numbers of \(2, 1\)"),
    ([[np.nan], [0.0]], r"gain: got shape \(2, 1\), or NaN"),
    ([["much"], [0.0]], r"gain: got \[\['much'\], \[0.0\]\], expected a tensor, or what"),
    (lambda F, H: None, "gain: got None, expected a tensor, or what"),
    (
        [[-1.0], [0.0]],
        "gain: got errors of 1.8 times the last step's, expected F - F L H with eige",
    ),
)
def test_a_gain_that_no_observer_has_is_refused(gain):
    qm.Controller(qm.LinearMPC(([[0.9]], [[0.5]]), 8, Q=1.0, dR=0.1), gain=gain)
