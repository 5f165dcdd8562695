"""Disturbances that an observer can estimate, and messages about those that it cannot."""

import numpy as np
import pytest

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
