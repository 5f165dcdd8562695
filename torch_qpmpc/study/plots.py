"""Figures of many finished runs: learning curves, learned matrices, paths and model errors."""

from __future__ import annotations

import numpy as np
import pandas as pd
import torch
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from torch_qpmpc.analysis.plots import draw_slice, slice_between
from torch_qpmpc.analysis.report import canonical
from torch_qpmpc.experiment.algorithms import evaluate
from torch_qpmpc.experiment.plots import (
    draw_lines,
    draw_matrix,
    draw_positions,
    episode_names,
    experience,
    scale_costs,
)
from torch_qpmpc.learning.operators import warm_policy
from torch_qpmpc.study.runs import CASES, FinishedRun, chosen, has_real
from torch_qpmpc.study.statistics import interquartile_mean, spread, spread_name

GAP_LEFT = "gap left, (J - J true) / (J start - J true)"
TICKS = [0, 0.02, 0.05, 0.1, 0.2, 0.5, 1], ["0", ".02", ".05", ".1", ".2", ".5", "1"]


def colours(frame: pd.DataFrame) -> dict[str, tuple]:
    """Assign a colour to each label; the paper's cases always keep theirs."""
    labels = frame["label"].unique().tolist()
    palette = colormaps["tab10"].colors  # pyright: ignore[reportAttributeAccessIssue] -- no stubs
    order = [*CASES, *(label for label in labels if label not in CASES)]
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
    unit = ""
    for label, runs in frame.groupby("label", sort=False):
        updates, J = curves(runs, "eval/J")
        run: FinishedRun = runs["run"].iloc[0]
        before, each, unit = experience(run.cfg)
        shown = slice(int(run.cfg.algo.get("actor") == "mlp"), None)  # not the QP before learning
        x = (before + each * updates)[shown]
        draw_band(axes, x, J[:, shown], str(label), colours(frame)[str(label)])
    draw_lines(axes, fixed_costs(frame))
    lengths = [run.cfg.updates for run in frame["run"]]
    scale = "log" if max(lengths) >= 10 * min(lengths) else "linear"
    axes.set(xlabel=unit, ylabel="J", xscale=scale)
    scale_costs(axes)
    axes.legend(fontsize="small")


def fixed_costs(frame: pd.DataFrame) -> dict[str, float]:
    """Return the means over seeds of J of the start, the true model and the rivals."""
    runs = frame.drop_duplicates("seed")
    costs = runs[["J_start", "J_true_model"]].set_axis(["start", "true model"], axis=1)
    if "rivals" in runs:
        rivals = pd.DataFrame(runs["rivals"].dropna().tolist())
        costs = pd.concat([costs.reset_index(drop=True), rivals], axis=1)
    known = {str(name): J.dropna().to_numpy() for name, J in costs.items()}
    return {name: float(interquartile_mean(J)) for name, J in known.items() if len(J)}


def draw_gap(axes: Axes, frame: pd.DataFrame) -> None:
    """Draw the gap left over updates, for the seeds with a real gap."""
    real = frame.query("real")
    for label, runs in real.groupby("label", sort=False):
        start, true = (runs[name].to_numpy()[:, None] for name in ("J_start", "J_true_model"))
        x, J = curves(runs, "eval/J")
        left = (J - true) / (start - true)
        draw_band(axes, x, left, str(label), colours(frame)[str(label)])
    axes.set(xlabel="update", ylabel=GAP_LEFT)
    axes.set_yscale("symlog", linthresh=0.1)
    axes.set_yticks(*TICKS)
    axes.axhline(0, color="k", linestyle="--", linewidth=1)
    axes.grid(alpha=0.3)


def learning_figure(frame: pd.DataFrame) -> Figure:
    """Draw the paper's figures 1 and 3, J for each case, and beside it the gap left, if any."""
    count = 1 + has_real(frame)
    figure = Figure(figsize=(5.5 * count, 4), layout="constrained")
    left, *right = figure.subplots(1, count, squeeze=False)[0]
    draw_J(left, frame)
    for axes in right:
        draw_gap(axes, frame)
    seeds = sorted(frame["seed"].unique().tolist())
    counts = [n for part in (frame, frame.query("real")) for n in part["label"].value_counts()]
    title = f"{frame['noise'].iloc[0]} noise: interquartile mean over seeds {seeds}"
    figure.suptitle(f"{title}, {spread_name(counts)}")
    return figure


def shown_seed(frame: pd.DataFrame) -> int:
    """Return the first seed with a real gap, or the first seed if none has one."""
    seeds: list[int] = (frame.query("real") if has_real(frame) else frame)["seed"].tolist()
    return min(seeds)


def constraints_figure(frame: pd.DataFrame) -> Figure:
    """Draw the paper's figures 2 and 4, C_theta of each case beside C_0; below, canonical."""
    runs = chosen(frame, seed=shown_seed(frame))
    figure = Figure(figsize=(4 * (len(runs) + 1), 6), layout="constrained")
    panels = figure.subplots(2, len(runs) + 1, squeeze=False)
    start: FinishedRun = runs["run"].iloc[0]
    draw_matrix(panels[0, 0], start.start.C_0, start.start, "$C_0$, the start")
    if start.true is None:
        panels[1, 0].set_axis_off()
    else:
        draw_matrix(panels[1, 0], start.true.C_0, start.true, "$C_0$ of the true model")
    for column, label, run in zip(panels.T[1:], runs["label"], runs["run"], strict=True):
        mpc = run.qp
        draw_matrix(column[0], mpc.C, mpc, rf"$C_\theta$, {label}")
        draw_matrix(column[1], canonical(mpc), mpc, f"canonical, {label}")
    figure.suptitle(f"{runs['noise'].iloc[0]} noise, seed {runs['seed'].iloc[0]}")
    return figure


def trajectories_figure(frame: pd.DataFrame) -> Figure:
    """Draw closed-loop paths of the start, each case and the true model, with predictions."""
    runs = chosen(frame, seed=shown_seed(frame))
    figure = Figure(figsize=(4 * len(runs), 4.5), layout="constrained")
    for axes, label, run in zip(
        figure.subplots(1, len(runs), squeeze=False)[0], runs["label"], runs["run"], strict=True
    ):
        ends = {"start": run.start, "learned": run.qp, "true model": run.true}
        loops = {
            name: evaluate(run.cfg, warm_policy(mpc), run.physics)
            for name, mpc in ends.items()
            if mpc is not None
        }
        d = next(iter(loops.values())).known[:, 0, : run.qp.n_d]
        draw_positions(axes, loops, run.qp, episode_names(run.cfg, run.physics, run.qp, d))
        axes.set_title(label)
    figure.suptitle(f"{runs['noise'].iloc[0]} noise, seed {runs['seed'].iloc[0]}")
    return figure


def policies_figure(frame: pd.DataFrame) -> Figure:
    """Draw slices of value and first action of the start, each case and the true model."""
    runs = chosen(frame, seed=shown_seed(frame))
    first: FinishedRun = runs["run"].iloc[0]
    shown = {"start": first.start}
    shown |= {label: run.qp for label, run in zip(runs["label"], runs["run"], strict=True)}
    if first.true is not None:
        shown["true model"] = first.true
    starts = evaluate(first.cfg, warm_policy(first.start), first.physics).known[0]
    slices = {label: slice_between(mpc, starts) for label, mpc in shown.items()}
    figure = Figure(figsize=(3.2 * len(slices), 6), layout="constrained")
    values, actions = figure.subplots(2, len(slices), squeeze=False)
    for name, row, fields, cmap in (
        ("V", values, [part.values for part in slices.values()], "viridis"),
        (r"\pi_1", actions, [part.actions[..., 0] for part in slices.values()], "RdBu_r"),
    ):
        every = torch.stack(fields).numpy()
        style = {"cmap": cmap, "vmin": np.nanmin(every), "vmax": np.nanmax(every)}
        for axes, (label, part), field in zip(row, slices.items(), fields, strict=True):
            image = draw_slice(axes, part, field, f"${name}$, {label}", **style)
        figure.colorbar(image, ax=row.tolist())
    figure.suptitle(f"{runs['noise'].iloc[0]} noise, seed {runs['seed'].iloc[0]}")
    return figure


def draw_meaning(axes: Axes, frame: pd.DataFrame) -> None:
    """Draw the error of the model read from C over the error of the corrupted model."""
    for label, runs in frame.groupby("label", sort=False):
        colour = [colours(frame)[str(label)]]
        axes.scatter(
            runs["prediction_error_start"], runs["prediction_error"], c=colour, s=14, label=label
        )
    ends = [
        frame["prediction_error_start"].min() * 0.9,
        frame["prediction_error_start"].max() * 1.1,
    ]
    axes.plot(ends, ends, "k--", linewidth=1)
    axes.set(xlabel="one-step error of the corrupted model", ylabel="... of the model read from C")
    axes.set(yscale="log")


def draw_use(axes: Axes, frame: pd.DataFrame) -> None:
    """Draw the gap left over the ratio of the learned to the corrupted model's error."""
    real = frame.query("real")
    for label, runs in real.groupby("label", sort=False):
        ratio = runs["prediction_error"] / runs["prediction_error_start"]
        colour = [colours(frame)[str(label)]]
        axes.scatter(ratio, 1 - runs["closed_gap"], c=colour, s=14, label=label)
    axes.axvline(1, color="k", linestyle="--", linewidth=1)
    axes.set(xlabel="prediction error, learned / corrupted", ylabel="gap left", xscale="log")
    axes.set_yscale("symlog", linthresh=0.01)
    if not real.empty:
        axes.legend(fontsize="small")


def meaning_figure(frame: pd.DataFrame) -> Figure:
    """Draw the model errors of the learned C, and the gap left over their ratio."""
    figure = Figure(figsize=(11, 4.5), layout="constrained")
    left, right = figure.subplots(1, 2)
    draw_meaning(left, frame)
    draw_use(right, frame)
    return figure


def frontier_figure(frame: pd.DataFrame) -> Figure:
    """Draw each setting's medians of gap left, distance and model error over runs with a real gap.

    Better is to the left (distance), below (gap) and brighter (model error). The settings are
    numbered in the order of the table.
    """
    real = frame.query("real").assign(
        left=lambda f: 1 - f["closed_gap"],
        ratio=lambda f: f["prediction_error"] / f["prediction_error_start"],
    )
    names = ["canonical_distance", "left", "ratio"]
    medians = real.groupby("label", sort=False)[names].median()
    figure = Figure(figsize=(11, 6), layout="constrained")
    axes, key = figure.subplots(1, 2, width_ratios=[3, 1])
    points = axes.scatter(
        medians["canonical_distance"],
        medians["left"],
        c=medians["ratio"],
        cmap="viridis_r",
        s=60,
    )
    figure.colorbar(points, ax=axes, label="prediction error, learned / corrupted")
    settings = [str(label).partition(", ")[2] or str(label) for label in medians.index]
    for number, (_, row) in enumerate(medians.iterrows(), 1):
        axes.annotate(
            str(number), (row["canonical_distance"], row["left"]), (4, 3),
            textcoords="offset points", fontsize=7,
        )  # fmt: skip
    listed = [f"{number:2}  {setting}" for number, setting in enumerate(settings, 1)]
    key.text(0, 1, "\n".join(listed), fontsize=7, va="top", family="monospace")
    key.set_axis_off()
    axes.set(xlabel="distance of the predictions to an MPC scheme's", ylabel=GAP_LEFT)
    axes.set_yscale("symlog", linthresh=0.1)
    axes.set_yticks(*TICKS)
    axes.grid(alpha=0.3)
    return figure


def ablation_figure(frame: pd.DataFrame) -> Figure:
    """Draw the gap left by each ablation: every run, the median and its spread, by noise."""
    real = frame.query("real")
    noises = sorted(real["noise"].unique())
    figure = Figure(figsize=(5 * len(noises), 0.4 * len({*real["ablation"]}) + 1.5))
    figure.set_layout_engine("constrained")
    for axes, noise in zip(
        figure.subplots(1, len(noises), squeeze=False, sharey=True)[0], noises, strict=True
    ):
        groups = chosen(real, noise=noise).groupby("ablation")["closed_gap"]
        for height, (_, gaps) in enumerate(groups):
            left = 1 - gaps
            low, high, *_ = spread([left.to_numpy()])
            axes.plot(left, [height] * len(left), ".", color="0.7")
            axes.plot([low, high], [height, height], color="tab:blue")
            axes.plot(left.median(), height, "o", color="tab:blue")
        axes.set_yticks(range(len(groups)), [str(name) for name in groups.groups])
        axes.set_xscale("symlog", linthresh=0.1)
        axes.set_xticks(*TICKS)
        axes.set(xlabel=GAP_LEFT, title=f"{noise} noise: median, {spread_name(groups.size())}")
        axes.grid(alpha=0.3)
    return figure


def readme_figure(frame: pd.DataFrame) -> Figure:
    """Draw the study in one figure: the gap left under each noise, and the model errors."""
    noises = sorted(frame["noise"].unique(), reverse=True)
    figure = Figure(figsize=(4 * (len(noises) + 1), 3.6), layout="constrained")
    panels = figure.subplots(1, len(noises) + 1)
    for axes, noise in zip(panels, noises, strict=False):
        draw_gap(axes, chosen(frame, noise=noise))
        axes.set_title(f"{noise} noise")
    draw_meaning(panels[-1], frame)
    panels[-1].legend(fontsize="small")
    return figure
