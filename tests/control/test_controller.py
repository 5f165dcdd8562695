"""`Controller`: offsets, names, bumpless starts, and messages."""

from unittest.mock import Mock

import numpy as np
import pandas as pd
import pytest
import scipy.linalg

import torch_qpmpc as qm
from tests.refused import refused
from torch_qpmpc import QPError
from torch_qpmpc.control.state_space import read_model
from torch_qpmpc.qp.pipeline import solve

A = np.array([[1.0, 0.1], [0.0, 0.8]])
B, C = np.array([[0.0], [1.0]]), np.array([[1.0, 0.0]])
BOUNDS = {"u_bounds": (-1.0, 1.0), "du_bounds": (-0.3, 0.3)}


def integrator(**options):
    return qm.LinearMPC((A, B, C), 20, **{"Q": 1.0, "R": 0.1, "dR": 0.1, **BOUNDS, **options})


def closed_loop(controller, r, steps, load=0.0, bias=0.0, **options):
    """Run the plant with constant disturbances of its input and output; return u and y."""
    x, us, ys = np.zeros(2), [], []
    for _ in range(steps):
        ys.append(C @ x + bias)
        us.append(controller.step(ys[-1], r, **options))
        x = A @ x + B @ (us[-1] + load)
    return np.array(us), np.array(ys)


def test_a_previewed_set_point_is_met_on_time():
    controller = qm.Controller(integrator(references="preview"))
    x, ys = np.zeros(2), []
    plan = np.concatenate((np.zeros(15), np.ones(40)))
    for k in range(40):
        ys.append((C @ x).item())
        r = plan[k : k + 21, None]
        x = A @ x + B @ controller.step([ys[-1]], r)
    assert ys[14] > 0.1, "moves before the step of the set-point"
    assert abs(ys[-1] - 1) < 0.01


def test_forecasts_are_fed_forward():
    mpc = qm.LinearMPC(([[0.9]], [[0.5]]), 10, Q=1.0, dR=1.0, E=[[0.5]], known=["d"])
    controller = qm.Controller(mpc)
    controller.reset(y=[0.0], u=[-0.2], known=[0.2])
    assert np.allclose(controller.step([0.0], [0.0], known=[0.2]), [-0.2])
    ahead = controller.step([0.0], known=pd.DataFrame({"d": [0.2] * 2 + [1.0] * 9}))
    assert ahead[0] < -0.25


def test_a_series_is_by_name_in_any_order():
    model = np.diag([0.9, 0.5]), np.eye(2)
    mpc = qm.LinearMPC(model, 5, Q=1.0, dR=0.1, outputs=["T", "h"], inputs=["p", "q"])
    signals = {"T": 1.0, "h": -2.0}, {"T": 0.5, "h": 3.0}, {"T": 0.1, "h": 2.0}
    us = []
    for y, r, noise in (signals, [pd.Series(x)[["h", "T"]] for x in signals]):
        controller = qm.Controller(mpc, noise=noise)
        us.append((controller.step(y, r), controller.step(r, y)))
    assert us[0] == us[1]
    y, r, _ = signals
    with pytest.raises(QPError, match=r"^y: got signals \['a', 'b'\]"):
        qm.Controller(mpc).step(pd.Series({"a": 1.0, "b": -2.0}), r)


@pytest.mark.parametrize("r", [[None], {"y1": None}, [np.nan]])
def test_a_set_point_that_is_none_is_invalid_as_nan_is(r):
    controller = qm.Controller(integrator())
    u = controller.step([0.0], [0.5])
    assert (controller.step([0.0], r) == u).all()
    assert controller.status.name == "INVALID"


def test_a_reset_starts_where_the_plant_rests():
    controller = qm.Controller(integrator())
    controller.reset(y=[3.0], u=[0.2])
    assert np.allclose(controller.w, [-0.2])  # which the input makes up for
    assert np.allclose(controller.step([3.0], [3.0]), [0.2])
    assert np.allclose(controller.step([3.0]), [0.2])
    controller.reset()
    assert controller.target is None
    assert np.allclose(controller.step([3.0], [3.0]), [0.0])


@refused(
    (lambda c: c.step([0.0]), "r: got None before any valid set-point, expected set-points of y1"),
    (lambda c: c.step([0.0, 1.0], [0.0]), r"y: got shape \(1, 2\), expected 1 numbers \(y1\)"),
    (lambda c: c.reset([np.nan], [0.0]), "y: got NaN or inf, expected finite numbers"),
    (lambda c: c.reset([3.4e38]), r"y: got 3\.4e\+38 of y1, expected at most 1e\+08 in size\. If"),
    (lambda c: c.simulate(None, 3, [-1e12]), r"r: got -1e\+12 of y1, expected at most 1e\+08 in s"),
    (lambda c: c.observe([0.0], {"valve": 1.0}), r"u: got signals \['valve'\], expected the signa"),
    (lambda c: c.redesign(u_bounds=(1.0, -1.0)), r"u_bounds: got \(1, -1\) for u1"),
    (
        lambda _: qm.Controller(integrator(learn=("H", "q"))).redesign(Q=2.0),
        "mpc: got an MPC that learns H, q, expected one whose theta is its design's. Change",
    ),
    (lambda c: c.step({"T": 0.0}, [0.0]), r"y: got signals \['T'\], expected the signals \['y1'\]"),
    (lambda c: c.reset(u=[1.0, 2.0]), r"u: got shape \(1, 2\), expected 1 numbers"),
    (lambda c: qm.Controller(c.mpc, noise=0.0), "noise: got 0 of y1, expected a standard deviatio"),
    (lambda c: qm.Controller(c.mpc, drift=[1.0, 2.0]), r"drift: got shape \(2,\), expected"),
    (lambda _: qm.Controller(Mock()), "mpc: got Mock, expected a LinearMPC"),
)
def test_bad_arguments_are_named(call):
    call(qm.Controller(integrator()))


def test_forecasts_that_are_missing_are_named():
    mpc = qm.LinearMPC(([[0.9]], [[0.5]]), 3, Q=1.0, E=[[0.5, 1.0]], known=["d", "e"])
    with pytest.raises(QPError, match=r"^known: got None, expected the signals d, e. Pass a forec"):
        qm.Controller(mpc).step([0.0], [0.0])
    with pytest.raises(QPError, match=r"^known: got lengths \[2, 3\], expected columns of one le"):
        qm.Controller(mpc).step([0.0], [0.0], known={"d": [1.0, 2.0], "e": [1.0] * 3})


def test_signals_may_be_as_large_as_bounds_noise_and_effects_make_usual():
    model = ([[0.9]], [[0.5]])

    def largest(noise=None, **options):
        mpc = qm.LinearMPC(model, 3, Q=1.0, **options)
        return [*np.concatenate(qm.Controller(mpc, noise=noise).max_plausible)]

    assert largest() == [1e8]
    assert largest(u_bounds=(0.0, 1e6)) == [0.5e14]
    assert largest(y_bounds=(-300.0, np.inf)) == [3e10]
    assert largest(noise=1e3) == [1e12]
    disturbed = {"E": [[5e-4, 50.0, 0.0]], "known": ["d", "e", "f"]}
    assert np.allclose(largest(**disturbed), [1e8, 2e11, 2e6, np.finfo(float).max])
    other = largest(**{**disturbed, "E": [[5e3, 5e-7, 0.0]]})
    assert np.allclose(other, [1e8, 2e4, 2e14, np.finfo(float).max]), "in other units"
    controller = qm.Controller(qm.LinearMPC(model, 3, Q=1.0, **disturbed))
    with pytest.raises(QPError, match=r"^known: got 4e\+11 of d, expected at most 2e\+11 in size"):
        controller.reset([0.0], known=[4e11, 0.0, 0.0])
    assert controller.step([0.0], [0.0], known=[4e11, 0.0, 0.0]) == controller.u
    assert controller.status.name == "INVALID"
    assert controller._memory.known is None
    assert np.isfinite(controller.step([1e8], [1e8], known=[1e11, 1e6, 1e30])).all()


def test_a_mode_that_no_input_moves_has_no_filter():
    turn = np.array([[0.0, 1.0], [-1.0, 0.0]])
    A = scipy.linalg.block_diag(turn, 0.5)
    model = read_model((A, [[0.0], [0.0], [1.0]], [[1.0, 0.0, 1.0]]))
    with pytest.raises(QPError, match=r"^model: got a model whose Kalman filter does not converge"):
        qm.Controller(qm.LinearMPC(model, 3, Q=1.0, R=1.0))


@pytest.mark.parametrize("references", ["held", "preview"])
@pytest.mark.parametrize("seed", range(2))
def test_a_step_is_that_of_the_differentiable_parts(seed, references):
    """Noise, loads and set-points out of reach: target, plan and input of each step."""
    rng, A, known = np.random.default_rng(seed), np.diag([0.9, 0.7, 0.5]), {}
    B, C = rng.normal(size=(3, 2)), rng.normal(size=(2, 3))
    bounds = {"u_bounds": (-0.5, 0.5), "y_bounds": (-1.5, 1.5), "du_bounds": (-0.4, 0.4)}
    if seed % 2:
        known = {"E": rng.normal(size=(3, 1)), "known": ["d"]}
    mpc = qm.LinearMPC((A, B, C), 8, Q=1.0, R=0.1, references=references, **bounds, **known)
    controller, x, active = qm.Controller(mpc), np.zeros(3), 0
    for k in range(60):
        r = (2.0 if k % 20 < 10 else 0.2) * rng.normal(
            size=(9 if references == "preview" else 1, 2)
        )
        d = rng.normal(size=(9, len(known) // 2))
        u_last, ahead = controller.u, {"known": {"d": d[:, 0]}} if known else {}
        u = controller.step(C @ x + 0.01 * rng.normal(size=2), r, **ahead)
        observer, e = controller.observer, controller._memory.e
        e = np.linalg.solve(observer.F, e - observer.predicted(np.zeros_like(e), u, d[0]))
        stages = (r + np.zeros((9, 1)), d) if mpc.design.staged else (r[-1], d[-1])
        target = mpc.target(stages[0], e[3:], stages[1])
        p = mpc.arrange(e[:3], target, u_last=u_last, known=d)
        plan = mpc.plan.solve(p, warm_start=mpc.plan.solve(p))
        expected = target.u.reshape(-1, 2)[-1] + plan.z[mpc.plan.n_p :][:2]
        assert controller.status == 0
        assert np.abs(u - expected.clamp(-0.5, 0.5).numpy()).max() < 1e-7
        active += int(plan.active.any())
        x = A @ x + B @ (u + 0.1) + (known["E"] @ d[0] if known else 0)
    assert active > 20


def test_a_healthy_loop_needs_no_refinement():
    controller = qm.Controller(integrator())
    closed_loop(controller, [1.0], 5)
    with qm.SolveLog() as log:
        closed_loop(controller, [1.0], 40)
    assert log.solves == 80
    assert log.refined == log.fallback == log.unsolved == 0
    assert log.recalled > 70


def test_the_first_step_finds_everything_factored(monkeypatch):
    """So after a reset and a redesign; compiled code follows from the same steps."""
    counted, own = [], solve.AtRest.__init__
    monkeypatch.setattr(solve.AtRest, "__init__", lambda *args: (counted.append(1), own(*args))[1])
    controller = qm.Controller(integrator())
    for change in (controller.reset, lambda: controller.redesign(dR=0.2)):
        counted.clear()
        change()
        assert len(counted) == 2, "the plan's and the target's"
        controller.step([0.0], [3.0])
        assert len(counted) == 2
