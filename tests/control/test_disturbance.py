"""Disturbances that an observer can estimate, and messages about those that it cannot."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

import torch_qpmpc as qm
from tests.refused import refused
from torch_qpmpc import QPError
from torch_qpmpc.control.disturbance import Steady, choose
from torch_qpmpc.control.scaling import Scaling
from torch_qpmpc.control.state_space import read_model

INTEGRATOR = ([[1.0, 0.1], [0.0, 0.5]], [[0.0], [1.0]], [[1.0, 0.0]])
STABLE = ([[0.9, 0.1], [0.0, 0.5]], [[0.0], [1.0]], [[1.0, 0.0]])


def full_rank(plant, w):
    n = len(plant.A)
    matrix = np.block([[plant.A - np.eye(n), w.B], [plant.C, w.C]])
    return np.linalg.matrix_rank(matrix) == matrix.shape[1]


def test_an_integrating_mode_gets_a_disturbance_of_its_input_and_another_one_of_the_output():
    assert choose(read_model(STABLE)).names == ("disturbance of y1",)
    assert choose(read_model(INTEGRATOR)).names == ("disturbance of u1",)
    A = np.diag([1.0, 0.5])
    both = choose(read_model((A, np.eye(2))))
    assert both.names == ("disturbance of u1", "disturbance of y2")
    assert choose(read_model(STABLE), None).names == ()


def test_random_plants_with_integrators_get_detectable_disturbances_one_for_each_output():
    rng = np.random.default_rng(0)
    for _ in range(50):
        n, m, n_y = rng.integers(2, 6), rng.integers(1, 4), rng.integers(1, 4)
        k = rng.integers(0, min(m, n_y, n) + 1)
        T = rng.normal(size=(n, n))
        A = T @ np.diag([1.0] * k + [*rng.uniform(-0.8, 0.8, n - k)]) @ np.linalg.inv(T)
        plant = read_model((A, rng.normal(size=(n, m)), rng.normal(size=(n_y, n))))
        w = choose(plant)
        assert len(w.names) == n_y
        assert full_rank(plant, w)


def of_a_lag(
    load: np.ndarray, act: Callable[[float], float], noise: float
) -> dict[str, np.ndarray]:
    """Return the log of a lag of gain one with a load at its input."""
    rng, x, y, u = np.random.default_rng(0), 0.0, [], []
    for w in load:
        y.append(x + noise * rng.normal())
        u.append(act(y[-1]))
        x = 0.8 * x + 0.2 * (u[-1] + w)
    return {"y": np.array(y), "u": np.array(u)}


@pytest.mark.usefixtures("few_orders")
@pytest.mark.parametrize("pole", [0.98, 1.0])
def test_after_a_log_that_drifts_a_load_leaves_no_tail(pole, tmp_path):
    """The target did not know of the drift: a fifth of a load stayed for hundreds of steps."""
    rng, load = np.random.default_rng(1), np.zeros(1000)
    for k in range(999):
        load[k + 1] = pole * load[k] + 0.01 * rng.normal()
    model = qm.identify(of_a_lag(load, lambda _: rng.uniform(-1, 1), 0.01))
    mpc = qm.LinearMPC(model, 20, Q={"y": 1.0}, R={"u": 0.3}, u_bounds=(-2, 2))
    controller = qm.Controller(mpc)
    assert controller._law.drift == pytest.approx(0.01, rel=0.25)
    controller.save(tmp_path / "c.qpmpc")
    for own in (controller, qm.Controller.load(tmp_path / "c.qpmpc")):
        own.redesign(Q={"y": 2.0})
        run = of_a_lag(np.full(50, 0.5), lambda y, own=own: own.step([y], [0.0])[0], 0.0)
        assert np.abs(run["y"][-10:]).max() < 1e-4
        assert run["u"][-1] == pytest.approx(-0.5, abs=1e-4)


def test_drifts_of_a_log_come_first_in_the_units_of_their_outputs():
    plant, shown = read_model((np.diag([0.8, 0.5, 0.2]), np.eye(3))), np.zeros((6, 2))
    shown[1, 0], shown[0, 1] = -0.05, 0.02  # half of state 2's distance from rest, and state 1's
    w = choose(replace(plant, drifts=shown))
    assert w.names == tuple(f"disturbance of y{i}" for i in (1, 2, 3))
    np.testing.assert_allclose(w.changes, [0.02 / 0.21, 0.05 / 0.51, 0])
    np.testing.assert_allclose(w.B, np.diag([0.21, 0.51, 0.0]), atol=1e-15)
    np.testing.assert_allclose(w.C, np.diag([0.0, 0.0, 1.0]))
    assert choose(replace(plant, drifts=shown), {"y1": "output"}).changes == 0


@pytest.mark.parametrize("wanted", ["auto", None, {"y1": "u1"}, {"y1": "u2", "y2": "output"}])
def test_what_a_user_chose_is_chosen_again_for_another_model(wanted, tmp_path):
    """A model that learned from a log had the automatic ones."""
    plant = read_model((np.diag([0.8, 0.5]), np.eye(2), np.ones((2, 2)) + np.eye(2)))
    mpc = qm.LinearMPC(plant, 5, Q=1.0, R=1.0, disturbances=wanted)
    mpc.save(tmp_path / "a.qpmpc")
    for own in (mpc, qm.LinearMPC.load(tmp_path / "a.qpmpc")):
        assert own.design.disturbances.wanted == wanted


def test_a_drift_that_is_an_integrating_input_s_takes_its_place():
    plant = read_model(INTEGRATOR)
    w = choose(replace(plant, drifts=np.array([[0.0], [0.01], [0.0]])))
    assert w.names == ("disturbance of y1",)
    assert full_rank(plant, w)
    hidden = choose(replace(plant, drifts=np.array([[0.0], [0.0], [0.01]])))
    assert hidden.names == ("disturbance of u1",), "an output's cannot be told from the mode"
    faint = choose(replace(read_model(STABLE), drifts=np.array([[-0.1], [0.0], [1.0005]])))
    assert faint.changes == 0, "it moves no output in the end, or hardly"


@refused(
    (INTEGRATOR, {"y1": "output"}, "disturbances: .* cannot be told from a mode at 1"),
    (INTEGRATOR, {"y2": "output"}, "disturbances: got 'y2': 'output', expected an output amo"),
    (INTEGRATOR, "all", "disturbances: got 'all', expected 'auto', None or a mapping"),
    (
        ([[0.5, 0.0], [0.0, 1.0]], [[1.0], [1.0]], [[1.0, 0.0]]),
        "auto",
        "model: got a mode at 1, mostly in state 1, that no output shows",
    ),
)
def test_disturbances_that_cannot_be_estimated_are_named(model, wanted):
    choose(read_model(model), wanted)


def test_a_mode_at_one_without_an_input_has_no_steady_state():
    plant = read_model(([[1.0, 0.0], [0.0, 0.5]], [[0.0], [1.0]]))
    weights = choose(plant, None), np.eye(2), np.eye(1), np.zeros(1)
    said = "a mode at 1 that no input moves, as y1 shows, expected .* Read y1 of a log as known"
    with pytest.raises(QPError, match=said):
        Steady.of(plant, *weights, Scaling.of(plant))
