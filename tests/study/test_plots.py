"""The figures have the numbers of the runs, and labels."""

import numpy as np
import pytest
from matplotlib.figure import Figure

from torch_qpmpc.study import plots
from torch_qpmpc.study.runs import collect
from torch_qpmpc.study.statistics import interquartile_mean

from .tables import made_up


@pytest.fixture(scope="module")
def gaussian(study):
    return collect(study / "small").query("noise == 'gaussian'")


@pytest.fixture
def axes():
    return Figure().subplots()


def test_J_is_drawn_over_experience_with_the_others_as_lines(gaussian, axes):
    rivals = [{"omniscient": 40.0}] * len(gaussian)
    plots.draw_J(axes, gaussian.assign(rivals=rivals))
    lines = {str(line.get_label()).partition(", ")[0]: line for line in axes.lines}
    updates, J = plots.curves(gaussian[gaussian["label"] == "free"], "eval/J")
    assert updates.tolist() == [0, 2, 4]
    np.testing.assert_allclose(lines["free"].get_ydata(), interquartile_mean(J))
    assert set(lines) == {"fixed", "free", "start", "true model", "omniscient"}
    assert axes.get_xlabel() == "transitions"
    cfg = gaussian["run"].iloc[0].cfg
    assert {*np.diff(lines["free"].get_xdata())} == {2 * cfg.num_envs * cfg.steps_per_update}


def test_the_gap_is_that_of_seeds_with_a_real_one(gaussian, axes):
    plots.draw_gap(axes, gaussian)
    first = gaussian[gaussian["real"]].set_index("label")
    for line in axes.lines[:2]:
        gap = first["closed_gap"][str(line.get_label())]
        assert line.get_ydata()[[0, -1]] == pytest.approx([1, 1 - gap])


def test_the_papers_cases_have_their_colour_in_every_figure():
    frame = made_up({("gaussian", "si"): [0.9], ("gaussian", "mpc"): [0.8]})
    assert plots.colours(frame)["si"] == plots.colours(made_up({("brownian", "si"): [0.1]}))["si"]
    assert len({*plots.colours(frame).values()}) == 6
