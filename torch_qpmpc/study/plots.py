"""Figures of many finished runs: learning curves, learned matrices and model errors."""

import numpy as np
import pandas as pd
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from torch_qpmpc.analysis.plots import draw_matrix
from torch_qpmpc.analysis.structure import canonical
from torch_qpmpc.experiment.plots import draw_lines, experience, scale_costs
from torch_qpmpc.study.runs import CASES, FinishedRun
from torch_qpmpc.study.statistics import interquartile_mean, spread

TICKS = [0, 0.02, 0.05, 0.1, 0.2, 0.5, 1], ["0", ".02", ".05", ".1", ".2", ".5", "1"]


def colours(frame: pd.DataFrame) -> dict[str, tuple]:
    """Assign a colour to each label; the paper's cases always keep theirs."""
    palette = colormaps["tab10"].colors  # pyright: ignore[reportAttributeAccessIssue] -- no stubs
    order = dict.fromkeys([*CASES, *frame["label"]])
    return {label: palette[i % len(palette)] for i, label in enumerate(order)}


def curves(frame: pd.DataFrame, column: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the updates that all runs logged of ``column``, and its values ``(runs, updates)``."""
    logged = [run.metrics[column].dropna() for run in frame["run"]]
    together = pd.concat(logged, axis=1, join="inner")
    return together.index.to_numpy(), together.to_numpy().T


def draw_band(axes: Axes, x: np.ndarray, runs: np.ndarray, label: str, colour: tuple) -> None:
    """Draw the interquartile mean over ``runs`` ``(runs, len(x))`` with their `spread`."""
    axes.plot(x, interquartile_mean(runs), color=colour, label=label)
    low, high, *_ = spread([runs], interquartile_mean)
    axes.fill_between(x, low, high, color=colour, alpha=0.2, linewidth=0)


def draw_J(axes: Axes, frame: pd.DataFrame) -> None:
    """Draw J over experience, with means of the start's and the others' J as lines."""
    for label, runs in frame.groupby("label", sort=False):
        updates, J = curves(runs, "eval/J")
        before, each = experience(runs["run"].iloc[0].cfg)
        draw_band(axes, before + each * updates, J, str(label), colours(frame)[str(label)])
        axes.set(xlabel="transitions", ylabel="J")
    once = frame.drop_duplicates("seed")
    ends = {"start": once["J_start"], "true model": once["J_true_model"]}
    costs = {**ends, **pd.DataFrame(once["rivals"].tolist())}
    known = {str(name): J.dropna().to_numpy() for name, J in costs.items()}
    draw_lines(axes, {name: float(interquartile_mean(J)) for name, J in known.items() if len(J)})
    scale_costs(axes)
    axes.legend(fontsize="small")


def draw_gap(axes: Axes, frame: pd.DataFrame) -> None:
    """Draw the gap left over updates, for the seeds with a real gap."""
    for label, runs in frame.query("real").groupby("label", sort=False):
        start, true = (runs[name].to_numpy()[:, None] for name in ("J_start", "J_true_model"))
        x, J = curves(runs, "eval/J")
        draw_band(axes, x, (J - true) / (start - true), str(label), colours(frame)[str(label)])
    axes.set(xlabel="update", ylabel="gap left, (J - J true) / (J start - J true)")
    axes.set_yscale("symlog", linthresh=0.1)
    axes.set_yticks(*TICKS)
    axes.axhline(0, color="k", linestyle="--", linewidth=1)
    axes.grid(alpha=0.3)


def learning_figure(frame: pd.DataFrame) -> Figure:
    """Draw the paper's figures 1 and 3, J for each case, and beside it the gap left, if any."""
    count = 1 + any(frame["real"])
    figure = Figure(figsize=(5.5 * count, 4), layout="constrained")
    left, *right = figure.subplots(1, count, squeeze=False)[0]
    draw_J(left, frame)
    for axes in right:
        draw_gap(axes, frame)
    seeds = sorted(frame["seed"].unique().tolist())
    title = f"{frame['noise'].iloc[0]} noise: interquartile mean over seeds {seeds}"
    figure.suptitle(f"{title}, 95% interval (range of fewer than six)")
    return figure


def constraints_figure(frame: pd.DataFrame) -> Figure:
    """Draw the paper's figures 2 and 4, C_theta of each case beside C_0; below, canonical.

    The seed is the first one with a real gap, if there is one.
    """
    seed = min(frame.query("real")["seed"] if any(frame["real"]) else frame["seed"])
    runs = frame.loc[frame["seed"] == seed]
    figure = Figure(figsize=(4 * (len(runs) + 1), 6), layout="constrained")
    panels = figure.subplots(2, len(runs) + 1, squeeze=False)
    first: FinishedRun = runs["run"].iloc[0]
    draw_matrix(panels[0, 0], first.start.C_0, first.start, "$C_0$, the start")
    if first.true is None:
        panels[1, 0].set_axis_off()
    else:
        draw_matrix(panels[1, 0], first.true.C_0, first.true, "$C_0$ of the true model")
    for column, label, run in zip(panels.T[1:], runs["label"], runs["run"], strict=True):
        draw_matrix(column[0], run.policy.C, run.policy, rf"$C_\theta$, {label}")
        draw_matrix(column[1], canonical(run.policy), run.policy, f"canonical, {label}")
    figure.suptitle(f"{frame['noise'].iloc[0]} noise, seed {seed}")
    return figure


def meaning_figure(frame: pd.DataFrame) -> Figure:
    """Draw a study in one figure: the gap left under each noise, and the model errors."""
    noises = sorted(frame["noise"].unique(), reverse=True)
    figure = Figure(figsize=(4 * (len(noises) + 1), 3.6), layout="constrained")
    panels = figure.subplots(1, len(noises) + 1)
    for axes, noise in zip(panels, noises, strict=False):
        draw_gap(axes, frame.loc[frame["noise"] == noise])
        axes.set_title(f"{noise} noise")
    start, learned = frame["prediction_error_start"], frame["prediction_error"]
    for label, runs in frame.groupby("label", sort=False):
        style = {"c": [colours(frame)[str(label)]], "s": 14, "label": label}
        panels[-1].scatter(start[runs.index], learned[runs.index], **style)
    ends = [start.min() * 0.9, start.max() * 1.1]
    panels[-1].plot(ends, ends, "k--", linewidth=1)
    labels = ("one-step error of the corrupted model", "... of the model read from C")
    panels[-1].set(xlabel=labels[0], ylabel=labels[1], yscale="log")
    panels[-1].legend(fontsize="small")
    return figure
