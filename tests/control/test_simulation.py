"""`Controller.simulate`: loops with models and environments, their costs, figures and messages."""

from dataclasses import replace
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
import scipy.signal
from matplotlib.figure import Figure

import torch_qpmpc as qm
from tests.refused import refused
from torch_qpmpc import QPError

pytestmark = pytest.mark.layout

LAG = ([[0.9]], [[0.5]])


def made(**options):
    design = {"Q": 1.0, "R": 0.2, "dR": 0.1, "u_bounds": (-1.0, 1.0), **options}
    return qm.Controller(qm.LinearMPC(LAG, 10, **design))


def test_another_plant_with_a_load_settles_and_the_controller_is_untouched():
    controller = made()
    controller.step([0.3], [0.2])
    before = (controller.u.copy(), controller.x, controller.w)
    run = controller.simulate(([[0.8]], [[0.6]]), 150, r=[1.0], load=0.1)
    assert [x.shape for x in (run.y, run.r, run.u, run.cost)] == [
        (151, 1),
        (151, 1),
        (150, 1),
        (150,),
    ]
    assert np.abs(run.y[-1] - 1.0) < 1e-5
    assert run.y[0] == 0  # at rest before the load
    assert all(map(np.array_equal, before, (controller.u, controller.x, controller.w)))


def test_a_loop_starts_where_the_last_reset_rests():
    """At its input, which moves and their bounds and prices count from."""
    options = {"E": [[0.3]], "known": ["rain"], "u_bounds": (0.0, 4.0), "du_bounds": (-0.1, 0.1)}
    controller = made(**options)
    controller.reset(y=[13.0], u=[2.0], known=[1.0])
    controller.step([13.0], [13.0], known=[1.0])
    run = controller.simulate(steps=20, r=[13.0], known=[1.0])
    assert np.allclose(run.y, 13.0)
    assert np.allclose(run.u, 2.0)
    assert np.abs(run.cost.sum()) < 1e-6
    moved = controller.simulate(steps=20, r=[20.0], known=[1.0], u=[1.0])
    assert np.allclose(moved.y[0], 8.0)
    assert np.allclose(moved.u[:2, 0], [1.1, 1.2])
    assert np.allclose(moved.costs(moved.u)[0], 144 + 0.1 * 0.1**2)
    assert repr(moved).startswith("Run(20 steps, cost ")


@pytest.mark.parametrize("pole", [0.9999, 1 - 1e-10, 1.0, 1.0003])
def test_a_plant_that_nearly_integrates_starts_at_the_outputs_of_the_last_reset(pole):
    mpc = qm.LinearMPC(([[pole]], [[1.0]]), 10, Q=1.0, dR=0.1, E=[[1.0]], known=["d"])
    controller = qm.Controller(mpc)
    controller.reset(y=[5.0], u=[-0.3], known=[0.25])
    run = controller.simulate(steps=60, r=[5.0])
    assert np.allclose(run.y[0], 5.0, atol=1e-3)
    assert np.allclose(run.y[-1], 5.0, atol=1e-3)
    assert np.array_equal(run.known, np.full((60, 1), 0.25))


@refused(
    (np.zeros(1), "plant: got SimpleNamespace, expected Gymnasium's reset and step"),
    ((np.zeros(2), {}), r"plant: got an observation of shape \(2,\), .* alone, y1"),
)
def test_environments_that_do_not_fit_are_named(started):
    made().simulate(SimpleNamespace(reset=lambda seed: started), 3, r=[0.0])


def test_the_cost_is_that_of_its_formula():
    controller = made(linear={"u1": "price"}, E=[[0.0]], known=["price"])
    known = {"price": np.linspace(0, 0.1, 40)}
    run = controller.simulate(steps=30, r=np.sin(np.arange(40) / 5)[:, None], known=known)
    du = np.diff(run.u, axis=0, prepend=0.0)
    u_s = 0.2 * run.r[:-1]
    cost = (run.y - run.r)[:-1] ** 2 + 0.2 * (run.u - u_s) ** 2 + 0.1 * du**2
    assert np.allclose(run.cost, (cost + run.known * run.u)[:, 0], atol=1e-6)
    other = controller.simulate(([[0.8]], [[0.6]]), 3, r=[1.0], known=known)
    assert np.array_equal(other.known, run.known[:3]), "of a plant without known signals"


@pytest.mark.parametrize(
    "hard",
    [
        {"y_bounds": (-0.5, 0.7), "y_slack": np.inf},
        {"constraints": {"sum": ({"u1": 0.7, "u2": 1.3}, (None, 1.0))}},
        {"constraints": {"sum": ({"y1": 0.7, "u2": 1.3}, (None, 1.0), np.inf)}},
    ],
)
def test_hard_bounds_that_rounding_violates_cost_nothing(hard):
    """The cost of a loop at one was infinite, and so was that of each loop `learn` compares."""
    model = [[0.9, 0.1], [0.0, 0.8]], np.diag([0.3, 0.7])
    mpc = qm.LinearMPC(model, 6, Q=1.0, dR=0.1, R=0.01, u_bounds=(-1.0, 1.0), **hard)
    run = qm.Controller(mpc).simulate(steps=30, r=[9.0, 9.0])
    assert np.isfinite(run.cost).all()


def test_violations_cost_their_price():
    run = made(y_bounds=(-0.5, 0.5), y_slack=7.0).simulate(steps=10, r=[0.0], x=[1.0])
    over = np.maximum(run.y[:-1, 0] - 0.5, 0)
    assert over[0] == 0.5
    free = replace(run, design=replace(run.design, y_slack={"y1": 0.0}))
    assert np.allclose(run.cost - free.cost, 7 * over)
    hard = replace(run, design=replace(run.design, y_slack={"y1": np.inf}))
    assert np.array_equal(hard.cost == np.inf, over > 0)


def test_an_identified_model_with_an_offset_starts_at_rest():
    plant = qm.Controller(qm.LinearMPC(LAG, 5, Q=1.0)).mpc.design.plant
    plant.offset[:] = 0.3
    controller = qm.Controller(qm.LinearMPC(plant, 5, Q=1.0, R=0.1))
    run = controller.simulate(steps=5, r=[3.0])
    assert np.allclose(run.y, 3.0)
    assert np.allclose(controller.simulate(steps=5, r=[3.0], x=[1.0]).y[0], 1.0)


def test_noise_is_drawn_from_the_seed():
    runs = [made().simulate(steps=20, r=[1.0], noise=0.1, seed=seed).y for seed in (0, 0, 1)]
    assert np.array_equal(runs[0], runs[1])
    assert not np.array_equal(runs[0], runs[2])


def test_sensor_noise_is_not_the_noise_of_an_environment():
    class Noise(gymnasium.Env):
        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            self.seen = [np.zeros(1)]
            return self.seen[0], {}

        def step(self, u):
            self.seen.append(self.np_random.normal(size=1))
            return self.seen[-1], 0.0, False, False, {}

    env = Noise()
    run = made().simulate(env, 200, r=[0.0], noise=1.0)
    noise = run.y - np.array(env.seen)
    assert not np.isin(noise[:-1].round(9), np.array(env.seen).round(9)).any()


def test_an_environment_forecasts_the_known_signals():
    class Rain(gymnasium.Env):
        """y+ = 0.9 y + 0.5 u + 0.3 rain, with a forecast of 11 rows or of none."""

        def __init__(self, rows=11):
            self.rain, self.rows = np.sin(np.arange(200) / 3), rows

        def ahead(self):
            return {"known": {"rain": self.rain[self.k : self.k + self.rows]}} if self.rows else {}

        def reset(self, *, seed=None, options=None):
            self.k, self.y = 0, np.zeros(1)
            return self.y, self.ahead()

        def step(self, action):
            self.y = 0.9 * self.y + 0.5 * action + 0.3 * self.rain[self.k]
            self.k += 1
            return self.y, 0.0, False, False, self.ahead()

    controller = made(E=[[0.3]], known=["rain"], R=0.0)
    run, held = (controller.simulate(Rain(rows), 100, r=[0.0]) for rows in (11, 1))
    assert np.array_equal(run.known[:, 0], Rain().rain[:100])
    assert run.cost.sum() < 0.9 * held.cost.sum()
    same = controller.simulate(None, 100, r=[0.0], known={"rain": Rain().rain})
    assert np.allclose(run.u, same.u, atol=1e-6)
    with pytest.raises(QPError, match=r"known: got None, .* has it in info\['known'\]"):
        controller.simulate(Rain(0), 5, r=[0.0])


def test_the_figure_has_a_panel_for_each_signal_with_its_unit():
    model = scipy.signal.dlti(*LAG, [[1.0]], [[0.0]], dt=60.0)
    mpc = qm.LinearMPC(model, 5, Q=1.0, E=[[0.1]], known=["rain"], y_bounds=(-1, 1))
    figure = qm.Controller(mpc).simulate(steps=5, r=[0.5], known=[0.1]).plot()
    assert isinstance(figure, Figure)
    assert [axes.get_ylabel() for axes in figure.axes] == ["y1", "u1", "rain"]
    assert figure.axes[-1].get_xlabel() == "time"
    assert figure.axes[0].get_xlim() == (0.0, 300.0)


@refused(
    ({"steps": 0}, "steps: got 0, expected a whole number >= 1"),
    ({"r": None}, "r: got None before any valid set-point, expected set-points of y1"),
    ({"noise": -1.0}, r"noise: got \[-1.0\], expected standard deviations >= 0"),
    ({"load": [1.0, 2.0]}, r"load: got shape \(2,\), expected a number, or one for"),
    ({"u": [1.0, 2.0]}, r"u: got shape \(1, 2\), expected 1 numbers"),
    ({"x": [1.0, 2.0]}, r"x: got shape \(2,\), expected a number, or one for"),
    ({"plant": ([[0.5]], [[1.0, 1.0]])}, "plant: got 2 inputs, 1 outputs, 0 known signals, expect"),
    (
        {"plant": qm.LinearMPC(LAG, 3, Q=1.0, E=[[1.0]]).design.plant},
        "plant: got 1 inputs, 1 outputs, 1 known signals, expected the controller's 1 input",
    ),
)
def test_bad_arguments_are_named(arguments):
    made().simulate(**{"r": [1.0], **arguments})


def test_a_plant_of_other_steps_or_signals_in_another_order_is_named():
    plants = [scipy.signal.dlti([[0.9]], [[0.5]], [[1.0]], [[0.0]], dt=dt) for dt in (1.0, 2.0)]
    with pytest.raises(QPError, match=r"^plant: got dt = 2, expected the controller's 1"):
        qm.Controller(qm.LinearMPC(plants[0], 5, Q=1.0)).simulate(plants[1], 3, r=[1.0])
    plant = qm.LinearMPC(([[0.9, 0.0], [0.0, 0.2]], [[0.5, 0.0], [0.0, 0.1]]), 5, Q=1.0, dR=0.1)
    crossed = replace(plant.design.plant, outputs=("y2", "y1"))
    with pytest.raises(QPError, match=r"^plant: got y2, y1, u1, u2, expected the order of y1, y2"):
        qm.Controller(plant).simulate(crossed, 3, r=[1.0, 0.0])


def test_rows_of_known_signals_are_one_or_all():
    controller = made(E=[[0.3]], known=["rain"])
    with pytest.raises(QPError, match=r"^known: got 9 rows, expected one row, or at least 10"):
        controller.simulate(steps=10, r=[1.0], known=np.ones((9, 1)))
    with pytest.raises(QPError, match=r"^known: got 5 rows, expected one row, or at least 11"):
        controller.step([0.0], [1.0], known=np.ones((5, 1)))
    held, rows = (controller.simulate(steps=10, r=[1.0], known=np.ones((n, 1))) for n in (1, 10))
    assert np.array_equal(held.u, rows.u)
