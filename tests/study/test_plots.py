from __future__ import annotations

import numpy as np
import pytest
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure

import train
from tests.runs import SMALL, make_config
from tests.study.tables import made_up
from torch_qpmpc.envs.closed_loop import cost_text
from torch_qpmpc.study.plots import (
    ablation_figure,
    colours,
    constraints_figure,
    curves,
    draw_gap,
    draw_J,
    draw_meaning,
    draw_use,
    frontier_figure,
    trajectories_figure,
)
from torch_qpmpc.study.report import figures
from torch_qpmpc.study.runs import collect
from torch_qpmpc.study.statistics import interquartile_mean

pytestmark = pytest.mark.layout


@pytest.fixture
def gaussian(study):
    frame = collect(study / "small")
    return frame[frame["noise"] == "gaussian"]


@pytest.fixture
def axes():
    return Figure().subplots()


def test_curves_are_those_of_metrics_csv(gaussian):
    x, J = curves(gaussian, "eval/J")
    assert x.tolist() == [0, 2, 4]
    np.testing.assert_array_equal(J[:, 0], gaussian["J_start"])
    np.testing.assert_array_equal(J[:, -1], gaussian["J_best"])


def test_J_is_drawn_as_interquartile_mean_between_its_ends(gaussian, axes):
    rivals = [{"omniscient": 40.0, "thermostat": 60.0}] * len(gaussian)
    draw_J(axes, gaussian.assign(rivals=rivals))
    lines = {str(line.get_label()).partition(", ")[0]: line for line in axes.lines}
    _, J = curves(gaussian[gaussian["label"] == "free"], "eval/J")
    np.testing.assert_allclose(lines["free"].get_ydata(), interquartile_mean(J))
    assert set(lines) == {"fixed", "free", "start", "true model", "omniscient", "thermostat"}
    assert set(lines["omniscient"].get_ydata()) == {40.0}
    assert axes.get_xlabel() == "transitions of experience"
    cfg = gaussian["run"].iloc[0].cfg
    each = cfg.num_envs * cfg.steps_per_update
    assert np.diff(lines["free"].get_xdata()).tolist() == [2 * each] * 2
    assert len(axes.collections) == 2, "an interval for each case"


def test_the_gap_is_that_of_seeds_with_a_real_one(gaussian, axes):
    draw_gap(axes, gaussian)
    first = gaussian[gaussian["real"]].set_index("label")
    for line in axes.lines[:2]:
        assert line.get_ydata()[0] == pytest.approx(1)
        gap = first["closed_gap"][str(line.get_label())]
        assert line.get_ydata()[-1] == pytest.approx(1 - gap)


def test_the_papers_cases_have_their_colour_in_every_figure():
    frame = made_up({("gaussian", "si"): [0.9], ("gaussian", "mpc"): [0.8]})
    assert colours(frame)["si"] == colours(made_up({("gaussian", "si"): [0.1]}))["si"]
    assert len({*colours(frame).values()}) == 6


def test_matrices_are_raw_and_canonical_beside_both_models(gaussian):
    figure = constraints_figure(gaussian)
    titles = [axes.get_title() for axes in figure.axes if axes.get_title()]
    assert titles == [
        "$C_0$, the start",
        *("$C_\\theta$, fixed", "$C_\\theta$, free"),
        "$C_0$ of the true model",
        *("canonical, fixed", "canonical, free"),
    ]
    images = [np.asarray(axes.images[0].get_array()) for axes in figure.axes if axes.get_title()]
    learned = gaussian["run"].iloc[0].policy.C.detach().numpy()
    np.testing.assert_array_equal(images[1], learned)
    np.testing.assert_allclose(images[4], learned, atol=1e-9)
    assert np.abs(images[5] - images[2]).max() > 1e-3, "another gauge"


def test_paths_are_shown_for_each_case_with_both_ends(gaussian):
    figure = trajectories_figure(gaussian)
    assert [axes.get_title() for axes in figure.axes] == ["fixed", "free"]
    legend = figure.axes[1].get_legend()
    assert legend is not None
    labels = [text.get_text() for text in legend.get_texts()]
    row = gaussian[(gaussian["label"] == "free") & gaussian["real"]].iloc[0]
    for name, J in (("start", "J_start"), ("learned", "J_best"), ("true model", "J_true_model")):
        assert f"{name}, J = {cost_text(row[J])}" in labels


def test_meaning_shows_each_run_and_use_those_with_a_real_gap(gaussian, axes):
    draw_meaning(axes, gaussian)
    points = np.concatenate([dots.get_offsets() for dots in axes.collections])
    np.testing.assert_allclose(points, gaussian[["prediction_error_start", "prediction_error"]])
    other = Figure().subplots()
    draw_use(other, gaussian)
    real = gaussian[gaussian["real"]]
    points = np.concatenate([dots.get_offsets() for dots in other.collections])
    np.testing.assert_allclose(points[:, 1], 1 - real["closed_gap"])
    without = Figure().subplots()
    draw_use(without, gaussian[~gaussian["real"]])
    assert without.get_legend() is None


def test_a_setting_is_a_point_of_the_frontier():
    frame = made_up({("gaussian", f"combined, c_2={i}"): [0.1 * i, 0.1 * i, 9.0] for i in (1, 2)})
    (axes, key, _) = frontier_figure(frame).axes
    points = np.asarray(axes.collections[0].get_offsets())
    np.testing.assert_allclose(points, [[0.15, 0.9], [0.15, 0.8]])
    assert [text.get_text() for text in axes.texts] == ["1", "2"]
    assert key.texts[0].get_text() == " 1  c_2=1\n 2  c_2=2"


def test_an_ablation_has_its_runs_median_and_interval():
    frame = made_up({("gaussian", "a"): [0.1, 0.2, 0.9, 0.0], ("gaussian", "b"): [0.5, 0.5, 0.0]})
    (axes,) = ablation_figure(frame.assign(ablation=frame["label"])).axes
    assert [label.get_text() for label in axes.get_yticklabels()] == ["a", "b"]
    runs, interval, median = axes.lines[:3]
    drawn = [np.sort(np.asarray(line.get_xdata())).tolist() for line in (runs, interval, median)]
    assert drawn == [pytest.approx(left) for left in ([0.1, 0.8, 0.9], [0.1, 0.9], [0.8])]
    assert to_rgba(median.get_color()) == to_rgba("tab:blue")
    assert axes.get_title() == "gaussian noise: median, range"


def test_J_of_a_network_is_drawn_over_transitions_without_that_of_the_start(tmp_path, axes):
    options = (*SMALL, "algo=td3", "algo.critic=mlp", "constraint=free", "updates=2")
    for actor in ("mlp", "scheduled"):
        cfg = make_config(*options, f"algo.actor={actor}")
        train.train(cfg, str(tmp_path / actor), quiet=True)
    frame = collect(tmp_path)
    assert sorted(frame["actor"]) == ["mlp", "scheduled"]
    draw_J(axes, frame)
    lines = {str(line.get_label()): line.get_xdata() for line in axes.lines}
    assert list(lines["free, actor=mlp"]) == [24]
    assert list(lines["free, actor=scheduled"]) == [16, 24]
    assert [name for name, _ in figures(frame)] == ["learning-gaussian", "meaning"]
