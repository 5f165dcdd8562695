"""Rounding in a model decides nothing: a plant in other coordinates has the same controller."""

from typing import Any

import numpy as np
import pytest

import torch_qpmpc as qm
from torch_qpmpc.control.lowering import riccati

TWO, ONE, BOUNDS = np.eye(2), np.ones((1, 1)), {"u_bounds": (-1.0, 1.0)}
#: Plants (A, B, C, E): an output that the known signal alone moves, and an input that moves none.
KNOWN = np.diag([0.8, 0.7]), TWO[:, :1], TWO, TWO[:, 1:]
INTEGRATES = np.diag([1.0, 0.7]), TWO[:, :1], TWO, np.array([[0.1], [1.0]])
USELESS = ONE, TWO[:1], ONE, 0 * ONE
SINGLE = np.diag([0.9, 0.8]), TWO, TWO, 0 * TWO[:, :1]
UNWEIGHTED = np.diag([1.0, 0.8]), TWO, TWO, 0 * TWO[:, :1]
SLOW = np.diag([1.0, 1 - 1e-10]), TWO, TWO, 0 * TWO[:, :1]


def rounded(plant):
    """Return a plant in random bases of its state, and with rounding of entries."""
    A, B, C, E = plant
    for rng in map(np.random.default_rng, (0, 1)):
        T = np.linalg.qr(rng.normal(size=A.shape))[0]
        yield T @ A @ T.T, T @ B, C @ T.T, T @ E
        yield *(part + 1e-16 * rng.normal(size=part.shape) for part in (A, B, C)), E


def moves(plant, **options):
    """Return the inputs of a loop with a known signal, the findings, and their faults."""
    (A, B, C, E), u = plant, []
    mpc = qm.LinearMPC((A, B, C), 5, E=E, known=["d"], **options)
    controller, x = qm.Controller(mpc), np.zeros(len(A))
    for _ in range(15):
        u.append(controller.step(C @ x, r=0.5 * np.ones(len(C)), known=[0.2]))
        assert str(controller.status) == "SOLVED"
        x = A @ x + B @ u[-1] + E[:, 0] * 0.2
    assert mpc.plan.quadratic_program().H.abs().max() < 1e6
    findings = controller.review().findings
    return np.array(u), [x.name for x in findings], [x.name for x in findings if not x.ok]


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("plant", "options"),
    [
        (KNOWN, {"Q": 1.0, "dR": 0.1, **BOUNDS}),
        (KNOWN, {"Q": [1.0, 0.0], "R": 0.1}),
        (INTEGRATES, {"Q": 1.0, "dR": 0.1, **BOUNDS}),
        (INTEGRATES, {"Q": [0.0, 1.0], "dR": 0.1, "u_bounds": (-1e10, 1e10)}),
        (USELESS, {"Q": 1.0, "dR": 0.1}),
        (USELESS, {"Q": 1.0, "R": 0.1, "u_bounds": (-1e10, 1e10)}),
        (USELESS, {"Q": 1.0, "R": 0.1, "dR": 0.1, **BOUNDS}),
        (SINGLE, {"Q": [0.0, 1.0], "dR": 0.1}),
        (UNWEIGHTED, {"Q": [0.0, 1.0], "R": 0.1, "dR": 0.1}),
        (SLOW, {"Q": 1.0, "dR": 0.1, "disturbances": None, **BOUNDS}),
    ],
)
def test_rounding_changes_no_move_and_no_finding(plant, options: dict[str, Any]):
    u, *found = moves(plant, **options)
    for other in rounded(plant):
        v, *others = moves(other, **options)
        assert np.allclose(u, v, atol=1e-7)
        assert found == others


@pytest.mark.parametrize(("plant", "Q"), [(SINGLE, [0.0, 1.0]), (USELESS, 1.0)])
def test_bounds_far_away_of_an_input_without_a_cost_set_no_size(plant, Q):
    options: dict[str, Any] = {"Q": Q, "R": 0.1, "dR": 0.1}
    far = moves(plant, **options, u_bounds=(-1e10, 1e10))
    assert np.allclose(far[0], moves(plant, **options)[0], atol=1e-9)


def test_bounds_set_no_unit_of_the_riccati_equation():
    bounds = {"y_bounds": (-1e5, 1e5), "u_bounds": {"u2": (-0.1, 0.1)}}
    model = [[1.1]], [[1.0, 0.5]], [[1.0]]
    weights: Any = {"Q": 1.0, "R": 0.1, "dR": [0.5, 1.0]}
    own, far = (riccati(qm.LinearMPC(model, 3, **weights, **x).design) for x in ({}, bounds))
    assert own is not None
    assert far is not None
    assert np.allclose(far, own, rtol=1e-9)


def test_the_slope_of_a_direction_without_a_cost_is_zero():
    """Inputs that rest hold the output at zero: the cost to go of a state at rest is none."""
    model = np.diag([0.9, 0.5]), [[0.1], [0.5]], [[1.0, -1.0]]
    mpc = qm.LinearMPC(model, 3, Q=1.0, dR=0.1, gamma=0.95)
    assert riccati(mpc.design) is not None
    assert mpc.plan.quadratic_program().H.abs().max() < 1e4


@pytest.mark.parametrize("A", [np.diag([0.8, 0.7]), np.diag([1.6, 0.7])])
def test_no_horizon_is_too_short_for_an_output_that_no_input_moves(A):
    finding = qm.Controller(qm.LinearMPC((A, TWO[:, :1], TWO), 5, Q=1.0, R=0.1)).review()["horizon"]
    assert finding.ok
    assert finding.numbers == {"y1": 1}
