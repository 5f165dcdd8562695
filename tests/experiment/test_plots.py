"""The figures of a run are drawn, finite and labelled."""

import math

import numpy as np
import pytest
from matplotlib.figure import Figure

from tests.figures import legend_of, make_mpc, rendered
from tests.runs import make_config
from torch_qpmpc.envs import PointMass
from torch_qpmpc.envs.closed_loop import closed_loop
from torch_qpmpc.experiment import plots
from torch_qpmpc.experiment.evaluation import Evaluation

pytestmark = pytest.mark.layout


@pytest.fixture(scope="module")
def mpc():
    return make_mpc()


@pytest.fixture(scope="module")
def found(mpc) -> Evaluation:
    policies = {"start": lambda s: -0.2 * s[:, :2], "true model": lambda s: -s[:, :2] - s[:, 2:]}
    policies["learned"] = mpc.policy
    loops = {name: closed_loop(p, PointMass(), steps=6, starts=8) for name, p in policies.items()}
    return Evaluation(make_config(), PointMass(), loops, {"omniscient": 41.0})


def test_the_summary_has_the_curve_the_matrix_and_the_paths(mpc, found):
    updates, J = [0, 10, 20], [300.0, 120.0, 60.0]
    figure = plots.summary_figure(mpc, found, updates, J)
    learning, _, paths = (axes for axes in figure.axes if axes.get_ylabel() or axes.images)
    shown = [label.partition(",")[0] for label in legend_of(learning)]
    assert shown == ["learned", "start", "true model", "omniscient"]
    points = zip(updates, J, strict=True)
    assert np.asarray(learning.lines[0].get_xydata()).tolist() == [list(point) for point in points]
    assert len(legend_of(paths)) == 4
    assert (paths.get_xlabel(), paths.get_ylabel()) == ("x", "y")
    rendered(figure)
    rendered(plots.summary_figure(mpc, found, [0, 10], [300.0, math.nan]))  # one that diverged


def test_the_episode_has_the_loop_and_the_plans_of_every_half_horizon(mpc, found):
    figure = plots.learned_episode_figure(mpc, found)
    labels = ["x", "y", "velocity in x", "velocity in y", "force in x", "force in y"]
    assert [axes.get_ylabel() for axes in figure.axes] == labels
    loop = found.loops["learned"]
    for axes, real in zip(figure.axes, loop.states[:, 0].mT, strict=False):
        assert np.array_equal(axes.lines[0].get_ydata(), real)
        assert [np.asarray(line.get_xdata())[0] for line in axes.lines[1:4]] == [0, 2, 4]
    rendered(figure)


def test_experience_counts_the_log_and_the_warm_up():
    assert plots.experience(make_config()) == (192, 64)
    log = ("start=data", "start.transitions=192")
    assert plots.experience(make_config(*log))[0] == 192 + 192
    assert plots.experience(make_config(*log, "start.file=log.pt"))[0] == 192


@pytest.mark.parametrize(("costs", "scale"), [([20.9, 24.0], "linear"), ([20.0, 60.0], "log")])
def test_costs_that_hardly_differ_have_a_linear_scale(costs, scale):
    axes = Figure().subplots()
    axes.plot(costs)
    plots.scale_costs(axes)
    assert axes.get_yscale() == scale
