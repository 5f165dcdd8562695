"""`Controller.learn`: better models are accepted, others are not, and bad arguments are named."""

import dataclasses
import math

import gymnasium
import numpy as np
import pytest
import scipy.signal

import torch_qpmpc as qm
from tests.refused import refused
from torch_qpmpc import QPError, SolverError
from torch_qpmpc.control import learning

pytestmark = pytest.mark.usefixtures("rough_fits")
WRONG, RIGHT = ([[0.6]], [[0.2]]), ([[0.9]], [[0.5]])
QUICK = {"r": [0.5], "spread": 0.5, "steps": 8, "transitions": 120}


class Lag(gymnasium.Env):
    def __init__(self, load=0.1, noise=0.01, start=0.0):
        self.load, self.noise, self.start = load, noise, start

    def reset(self, *, seed=None, options=None):
        self.rng = np.random.default_rng(seed)
        self.y = self.start * self.rng.uniform(-1, 1, 1)
        return self.y, {}

    def step(self, action):
        self.y = 0.9 * self.y + 0.5 * action + self.load
        self.y += self.noise * self.rng.normal()
        return self.y, 0.0, False, False, {}


def made(model, **options):
    design = {"Q": 1.0, "R": 0.1, "dR": 0.5, "u_bounds": (-1.0, 1.0), **options}
    return qm.Controller(qm.LinearMPC(model, 5, **design))


def logged(steps=600, dt=None):
    env, rng = Lag(), np.random.default_rng(5)
    u, y = rng.uniform(-1, 1, (steps, 1)).repeat(3, 0)[:steps], [env.reset(seed=1)[0]]
    y += [env.step(x)[0] for x in u[:-1]]
    rows = {"y1": np.array(y), "u1": u[:, 0]} | ({} if dt is None else {"t": dt * np.arange(steps)})
    time = None if dt is None else "t"
    return qm.read_log(rows, outputs=["y1"], inputs=["u1"], time=time)


def test_a_log_of_the_loop_at_one_set_point_is_refused():
    controller, r = made(RIGHT), np.random.default_rng(0).uniform(-1, 1, 15).repeat(20)[:, None]
    runs = [controller.simulate(Lag(noise=0.05), 300, r=x, seed=1) for x in (r, [0.3])]
    moved, held = ({"y1": x.y[:, 0], "u1": x.u[:, 0]} for x in runs)
    with pytest.raises(QPError, match=r"log: got inputs .* alone by \d+%, .* Move the set-points"):
        controller.learn(held, steps=8)
    assert controller.learn(moved, steps=8).pairs


def test_the_same_object_costs_less_in_the_environment_with_the_same_design():
    names = {"inputs": ["q"], "outputs": ["T"], "known": ["price", "sun"], "E": [[0.0, 0.01]]}
    mpc = made(WRONG, linear={"q": "price"}, du_bounds=(-0.5, 0.5), **names).mpc
    controller, env = qm.Controller(mpc, noise=0.05), Lag()
    known = {"price": [0.01], "sun": np.sin(np.arange(60))}
    loop = {"r": {"T": 0.8}, "seed": 11, "steps": 50, "known": known}
    before = controller.simulate(env, **loop)
    report = controller.learn(env, known=known, **QUICK)
    after = controller.simulate(env, **loop)
    assert report.accepted
    assert report.after < report.before
    assert report.interval[1] < 0
    assert report.transitions == 120
    assert str(report).startswith(f"accepted: J {report.before:.4g} -> {report.after:.4g} in")
    assert after.costs(before.u_s).sum() < before.cost.sum()
    assert abs(after.y[-20:].mean() - 0.8) < 0.02
    assert np.abs(np.diff(after.u, axis=0)).max() <= 0.5 + 1e-9
    old, new = mpc.design, controller.mpc.design
    assert np.allclose([new.plant.A, new.plant.B], [[[0.9]], [[0.5]]], atol=0.05)
    assert new.plant.known == ("price", "sun")
    assert np.array_equal(new.plant.E[:, 0], [0.0])
    for name in ("Q", "R", "dR", "u_bounds", "du_bounds", "linear", "horizon"):
        np.testing.assert_equal(getattr(new, name), getattr(old, name))


@pytest.mark.parametrize("model", [WRONG, RIGHT])
def test_a_log_says_that_loops_start_off_rest(model):
    """Without one the filter takes such a start for a disturbance, also with the right model."""
    controller, none = made(model), np.zeros(0)
    for y in (0.0, np.nan):
        controller.step([y], [1.0])
    assert controller.learn(Lag(start=3.0), **QUICK).accepted
    observer, e = controller.observer, controller.observer.at_rest(controller.u, none, np.ones(1))
    for y in (1.0, 0.8):  # starts again, from rest, with the steady gain: the gap is forgotten
        controller.step([y], [1.0])
        e = observer.predicted(e + observer.L @ (y - observer.H @ e), controller.u, none)
        assert np.allclose(np.concatenate((controller.x, controller.w)), e)
    assert np.allclose(controller.mpc.design.plant.A, 0.9, atol=0.05)


def test_a_controller_with_the_true_model_stays_as_it_is():
    controller = made(RIGHT)
    controller.step([0.3], [0.2])
    mpc, x, w, u = controller.mpc, controller.x, controller.w, controller.u
    report = controller.learn(Lag(load=0.0, noise=0.0), **QUICK)
    assert (report.accepted, report.pairs) == (False, 16)
    assert controller.mpc is mpc
    assert np.array_equal([controller.x, controller.w, controller.u], [x, w, u])
    assert str(report).startswith("not accepted, the controller is as before: J")
    for interval, after, undecided in (
        ((-1.0, 2.0), 1.9, True),
        ((-1.0, 2.0), 1.99, False),  # it stops where the gain is too small
        ((1.0, 2.0), 1.9, False),
    ):
        text = str(dataclasses.replace(report, before=2.0, after=after, interval=interval))
        assert ("so that more pairs could decide" in text) == undecided


def test_a_log_is_enough_and_its_last_third_decides():
    controller = made(WRONG)
    report = controller.learn(logged(), steps=8)
    assert report.accepted
    assert report.transitions == 399
    assert report.plant == "a model of the log's last third"
    assert np.allclose(controller.mpc.design.plant.A, 0.9, atol=0.05)


def test_loops_of_a_log_start_at_rest_at_its_levels():
    log = logged()
    signals = {"y1": log.trajectories[0].y.numpy() + 50, "u1": log.trajectories[0].u.numpy() + 5}
    log = qm.read_log(signals, outputs=["y1"], inputs=["u1"])
    controller = made(WRONG, u_bounds=(3.0, 7.0), du_bounds=(-0.2, 0.2))
    report = controller.learn(log, steps=8, spread=0.1)
    assert report.before < 1, "a start at another input would cost thousands"


@pytest.mark.parametrize("pole", [0.999, 1.0])
def test_so_do_those_of_a_slow_plant_with_a_known_signal_that_varies(pole):
    rng, T = np.random.default_rng(0), [20.0]
    u, d = rng.uniform(-0.5, 0.5, 600).repeat(3)[:600], rng.normal(size=600)
    for k in range(599):
        u[k] -= 0.1 * (T[k] - 20.0)
        T.append(20.0 + pole * (T[k] - 20.0) + 0.5 * u[k] + 0.1 * d[k] + 0.01 * rng.normal())
    signals = {"T": T, "q": u, "d": d}
    log = qm.read_log(signals, outputs=["T"], inputs=["q"], known=["d"])
    names = {"inputs": ["q"], "outputs": ["T"], "known": ["d"], "E": [[0.1]]}
    model = ([[pole]], [[0.5]])
    mpc = qm.LinearMPC(model, 5, Q=1.0, dR=0.5, u_bounds=(-3.0, 3.0), **names)
    assert qm.Controller(mpc).learn(log, steps=12, spread=0.1).before < 5


def test_a_candidate_that_fails_is_not_accepted(monkeypatch):
    controller, simulate = made(WRONG), learning.simulate

    def failing(used, *args, **options):
        if used.mpc is not controller.mpc:
            raise SolverError("no plan")
        return simulate(used, *args, **options)

    monkeypatch.setattr(learning, "simulate", failing)
    report = controller.learn(Lag(), **QUICK)
    assert (report.accepted, report.after, report.pairs) == (False, math.inf, 1)
    assert "\na loop with the new model failed, or cost far more than its pair: a veto; " in str(
        report
    )


@refused(
    ({"steps": 0}, "steps: got 0, expected a whole number >= 1"),
    ({"transitions": 0}, "transitions: got 0, expected a whole number >= 1"),
    ({"pairs": 4}, "pairs: got 4, expected a whole number >= 16"),
    ({"seed": -1}, "seed: got -1, expected a whole number >= 0"),
    ({"r": None}, "r: got None before any valid set-point, expected set-points of y1"),
    ({"spread": 0.0}, r"spread: got \[0.0\], expected distances >= 0, not all of them 0"),
)
def test_bad_arguments_are_named(options):
    made(WRONG).learn(Lag(), **{**QUICK, **options})


def test_logs_of_other_signals_or_steps_and_constant_signals_are_named():
    controller = made(WRONG, inputs=["q"])
    with pytest.raises(QPError, match=r"^log: got inputs \('u1',\), expected the controller's \("):
        controller.learn(logged())
    with pytest.raises(QPError, match=r"^known: got signals beside a log, expected None: the log"):
        controller.learn(logged(), known=[0.3])
    controller = made(WRONG, E=[[0.1]], known=["sun"])
    with pytest.raises(QPError, match=r"^known: got a constant sun, expected one that varies"):
        controller.learn(Lag(), known=[0.3], **{**QUICK, "transitions": 12})
    controller = made(scipy.signal.dlti(*WRONG, [[1.0]], [[0.0]], dt=30.0))
    with pytest.raises(QPError, match=r"^log: got one step every 60, expected .* 30. Resample"):
        controller.learn(logged(dt=60.0))
    assert controller.learn(logged(dt=30.0), steps=8).accepted
