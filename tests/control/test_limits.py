"""Bounds that are known signals, and so vary over the horizon."""

from typing import Any

import numpy as np
import pytest
import torch

import torch_qpmpc as qm
from tests.campaign.soak import soak
from tests.control.controllers import exported
from tests.refused import refused
from torch_qpmpc.control.law import Outcome

N = 8
A, B = np.array([[0.9, 0.05], [0.1, 0.8]]), np.array([[0.3, 0.0], [0.1, 0.4]])
LIMITS: Any = {"known": ["low", "cap"]}
BY_SIGNAL: Any = {
    "y_bounds": {"y1": ("low", 4.0)},
    "u_bounds": {"u1": (-2.0, "cap"), "u2": (-1.5, 1.5)},
    **LIMITS,
}


def plant(**options: Any) -> qm.Controller:
    """Return the controller of two signals, one with a band whose lower end is a known signal."""
    mpc = qm.LinearMPC((A, B), N, Q=1.0, **{"dR": 0.1, **BY_SIGNAL, **options})
    return qm.Controller(mpc, noise=0.01, drift=0.01)


def rows(low: Any, cap: Any) -> dict[str, Any]:
    return {"low": low, "cap": cap}


@pytest.mark.parametrize("r", [(1.0, 0.5), (9.0, 0.0), (-9.0, 2.0)])
@pytest.mark.parametrize(
    "options", [{}, {"R": 0.1}, {"du_bounds": (-0.7, 0.7)}, {"blocks": [2, 6]}]
)
def test_constant_signals_are_constant_bounds(r, options):
    own = plant(**options).mpc
    fixed = {"y_bounds": {"y1": (-1.0, 4.0)}, "u_bounds": {"u1": (-2.0, 0.6), "u2": (-1.5, 1.5)}}
    slack = own.design.slack  # the default follows from numbers alone
    twin = plant(**options, **fixed, y_slack=slack, known=()).mpc
    level, rng = np.array([-1.0, 0.6]), np.random.default_rng(0)
    rows = np.tile(level, (N + 1 if own.design.staged else 1, 1)).squeeze()
    target, same = own.target(r, known=rows), twin.target(r)
    assert all(torch.allclose(a, b, atol=1e-7) for a, b in zip(target, same, strict=True))
    for x in rng.uniform(-3, 3, (12, 2)):
        signals = {"x": x, "u_last": rng.uniform(-1, 0.6, 2)}
        p = own.arrange(target=target, known=np.tile(level, (N + 1, 1)), **signals)
        u, v = own.plan.policy(p), twin.plan.policy(twin.arrange(target=same, **signals))
        assert torch.allclose(target.u.reshape(-1, 2)[-1] + u, same.u + v, atol=1e-6)


@pytest.mark.parametrize("options", [{}, {"blocks": [1, 3, 4]}])
def test_every_stage_of_a_plan_keeps_its_own_bound(options):
    controller, caps = plant(**options), np.array([0.9, 0.9, 0.4, 1.5, 0.2, 0.2, 0.7, 0.1, 0.1])
    controller.step([0.0, 0.0], [4.0, 0.0], known=rows(-9.0, caps))
    mpc = controller.mpc
    u = controller.target.u[0] + mpc.plan.predicted(mpc.plan.solve(controller.p).z)[1][:, 0]
    assert (u.numpy() <= caps[:N] + 1e-7).all()
    assert np.isclose(u.numpy(), caps[:N], atol=1e-6).sum() >= 3, "bounds decide"


def test_a_move_bound_makes_room_before_a_limit_falls():
    controller, x, inputs = plant(du_bounds=(-0.2, 0.2)), np.zeros(2), []
    caps = np.r_[np.full(15, 1.6), np.full(30, 0.2)]
    for k in range(30):
        inputs.append(controller.step(x, [3.9, 0.0], known=rows(-9.0, caps[k : k + N + 1])))
        assert controller.status == Outcome.SOLVED
        x = A @ x + B @ inputs[-1]
    u = np.array(inputs)[:, 0]
    assert u.max() > 1.2
    assert (u <= caps[:30] + 1e-9).all()
    assert np.diff(u).min() > -0.2 - 1e-9


def test_a_band_that_rises_is_reached_in_time():
    """Heat before the morning: the output has no set-point, energy has a price."""
    model, band = ([[0.9]], [[0.5]]), np.r_[np.zeros(12), np.ones(30)]
    options: Any = {"y_bounds": ("low", 3.0), "u_bounds": (0.0, 0.5), "linear": {"u1": 1.0}}
    controller = qm.Controller(qm.LinearMPC(model, N, **options, y_slack=100.0, known=["low"]))
    run = controller.simulate(steps=30, r=[0.0], known={"low": band}, x=[0.0], u=[0.0])
    assert run.u[:4].max() < 1e-6, "no heat before it is of use"
    assert (run.y[12:30, 0] > 1 - 1e-6).all(), "the band is kept from its first step"
    assert run.cost[13:].max() == pytest.approx(0.2, abs=1e-6), "the input alone costs"
    assert run.plot().axes


def wild(steps: int, seed: int) -> np.ndarray:
    """Return rows of both signals that change at once, now and then to no plan."""
    rng = np.random.default_rng(seed)
    low, cap = rng.uniform(-2, 2, steps), rng.uniform(-1.9, 2.0, steps)
    cap[rng.random(steps) < 0.05] = -2.5  # below the lower bound
    return np.repeat(np.stack((low, cap), -1), 3, axis=0)


@pytest.mark.parametrize("references", ["held", "preview"])
def test_c_keeps_the_same_limits(references):
    pair = exported(plant, missing=True, references=references, du_bounds=(-0.5, 0.5), y_slack=5.0)
    difference, counts = soak(*pair, 400, 2, 0, size=8.0)
    assert difference < 1e-8
    assert {*counts} >= {"SOLVED", "INFEASIBLE", "INVALID", "MISSING"}


def test_units_of_the_limits_change_nothing():
    y, u, moves = np.array([1e5, 1e-3]), np.array([1e-4, 1e3]), []
    for of_y, of_u in ((np.ones(2), np.ones(2)), (y, u)):
        model = A * of_y[:, None] / of_y, B * of_y[:, None] / of_u
        bounds: Any = {
            "y_bounds": {"y1": ("low", 4.0 * of_y[0])},
            "u_bounds": {"u1": (-2.0 * of_u[0], "cap"), "u2": (-1.5 * of_u[1], 1.5 * of_u[1])},
        }
        weights = {"Q": 1 / of_y**2, "dR": 0.1 / of_u**2}
        controller = qm.Controller(qm.LinearMPC(model, N, **weights, **bounds, **LIMITS))
        x = np.zeros(2)
        for low, cap in wild(8, 3):
            move = controller.step(x * of_y, [2.0, 0.0] * of_y, rows(low * of_y[0], cap * of_u[0]))
            moves.append(move / of_u)
            x = A @ x + B @ moves[-1]
    half = len(moves) // 2
    assert np.allclose(moves[:half], moves[half:], atol=1e-6)


def test_limits_are_saved_and_changed(tmp_path):
    controller = plant()
    known = rows(-9.0, 0.3)
    controller.step([0.0, 0.0], [4.0, 0.0], known=known)
    controller.save(tmp_path / "controller.qpmpc")
    again = qm.Controller.load(tmp_path / "controller.qpmpc")
    assert again.mpc.design.limits == {"y1": ("low", ""), "u1": ("", "cap")}
    u = controller.step([0.1, 0.1], known=known)
    assert np.array_equal(again.step([0.1, 0.1], known=known), u)
    controller.redesign(u_bounds={"u1": (-0.1, 0.1), "u2": (-1.0, "cap")})
    assert controller.mpc.design.limits == {"y1": ("low", ""), "u2": ("", "cap")}
    assert abs(controller.step([0.0, 0.0], [4.0, 0.0], known=known)[0]) <= 0.1 + 1e-9
    controller.redesign(u_bounds=None, y_bounds=None)
    assert controller.mpc.design.limits == {}


def test_a_design_with_limits_is_reviewed_and_a_default_has_room():
    controller = plant()
    assert not [fault for fault in controller.review([0.5, 0.5]).faults if fault.name == "error"]
    controller.reset(known=rows(-1.0, 0.5))
    assert controller.review([9.0, 0.0]).faults


def test_a_signal_beyond_a_fixed_bound_takes_no_input_past_it():
    """A cap of -3 took an input whose lower bound is -2 to -3, in C, too."""
    controller, twin = exported(plant)
    for cap in (1.0, -3.0, 1.0):
        u = controller.step([0.0, 0.0], [1.0, 0.0], known=rows(-9.0, cap))
        got, code = twin.step([0.0, 0.0], [1.0, 0.0], np.tile([-9.0, cap], (N + 1, 1)))
        assert code == controller.status
        np.testing.assert_allclose(got, u, atol=1e-9)
        assert u[0] == -2.0 or controller.status == Outcome.SOLVED


@refused(
    ({"u_bounds": {"u1": (0.0, "ceiling")}}, r"u_bounds: got 'ceiling'.*\['low', 'cap', 'ceil"),
    ({"y_bounds": ("low", "top")}, r"y_bounds: got 'top'.*numbers or known signals"),
    ({"u_bounds": {"u1": (0.0, "cap", 1.0)}}, r"u_bounds: got .*expected pairs"),
    ({"E": np.ones((2, 2))}, r"y_bounds: got 'low', which acts on the plant.*signal twice"),
    ({"du_bounds": (0.0, "cap")}, r"du_bounds"),
)
def test_a_wrong_limit_is_named(options):
    plant(**options)
