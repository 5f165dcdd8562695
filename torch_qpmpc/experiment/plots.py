"""Figures of a run: constraint matrix, closed-loop and predicted trajectories, learning curve."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator
from torch import Tensor

from torch_qpmpc.analysis.plots import COLOURS, draw_matrix
from torch_qpmpc.envs.closed_loop import ClosedLoop
from torch_qpmpc.mpc.module import QPMPC


def draw_positions(axes: Axes, loops: Mapping[str, ClosedLoop], mpc: QPMPC, shown: int = 6) -> None:
    """Draw closed-loop paths from a few starts, and the learned QP's predictions.

    They are in the plane of the first two states or outputs, or over time if there is only one.
    """
    plane = mpc.n_x > 1

    def draw(paths: Tensor, *style: Any, **options: Any) -> None:
        """Draw paths ``(steps, starts, n_x)``."""
        x = paths[..., 0] if plane else torch.arange(len(paths))
        axes.plot(x, paths[..., int(plane)], *style, **options)

    for name, loop in loops.items():
        colour = COLOURS.get(name)
        draw(loop.states[:, :shown], color=colour, linewidth=1)
        axes.plot([], [], color=colour, label=f"{name}, J = {loop.J:.0f}")
    first = next(iter(loops.values()))
    with torch.no_grad():
        predicted, _ = mpc.predicted(mpc.solve(first.known[0, :shown]).z)
    draw(predicted.transpose(0, 1), "k:", linewidth=1)
    axes.plot([], [], "k:", label="predicted at the start")
    draw(first.states[:1, :shown], "ko", markersize=3)
    if plane:
        axes.plot(0, 0, "k+", markersize=9)
    labels = ("$s_1$", "$s_2$") if plane else ("step", "$s_1$")
    axes.set(xlabel=labels[0], ylabel=labels[1], title="Closed loop")
    axes.legend(fontsize="small", loc="upper center", bbox_to_anchor=(0.5, -0.18), ncols=2)


def predictions_figure(mpc: QPMPC, loop: ClosedLoop, every: int = 8, start: int = 0) -> Figure:
    """Draw one closed-loop trajectory and the QP's predictions along it.

    Args:
        mpc: the QP.
        loop: its closed loop.
        every: number of steps between two predictions.
        start: index of the loop's start.
    """
    names = [f"$s_{{{i + 1}}}$" for i in range(mpc.n_x)]
    names += [f"$a_{{{i + 1}}}$" for i in range(mpc.n_u)]
    figure = Figure(figsize=(9, 1.7 * len(names)), layout="constrained")
    rows = figure.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0]
    times = range(0, len(loop.actions), every)
    with torch.no_grad():
        x, u = mpc.predicted(mpc.solve(loop.known[list(times), start]).z)
    realised = [*loop.states[:, start].unbind(-1), *loop.actions[:, start].unbind(-1)]
    predicted = [*x.unbind(-1), *u.unbind(-1)]
    for axes, name, real, expected in zip(rows, names, realised, predicted, strict=True):
        axes.plot(real, color=COLOURS["learned"], label="realised")
        for i, (k, path) in enumerate(zip(times, expected, strict=True)):
            style = {"color": "black", "linestyle": ":", "linewidth": 1}
            axes.plot(
                range(k, k + len(path)), path, label=None if i else "predicted", marker=".",
                markevery=[0], **style,
            )  # fmt: skip
        axes.set_ylabel(name)
        axes.grid(alpha=0.3)
    rows[0].legend(fontsize="small", loc="upper right")
    rows[0].set_title("Realised trajectory, and the predictions made on the way")
    rows[-1].set_xlabel("step")
    return figure


def draw_stage_costs(axes: Axes, loops: Mapping[str, ClosedLoop]) -> None:
    """Draw the mean stage cost over time."""
    for name, loop in loops.items():
        axes.plot(loop.costs.mean(1), color=COLOURS.get(name), label=name)
    axes.set(xlabel="step", ylabel="L(s, a), mean over starts", title="Stage cost", yscale="log")
    axes.legend(fontsize="small")


def closed_loop_figure(loops: Mapping[str, ClosedLoop], mpc: QPMPC) -> Figure:
    """Draw paths in the plane with predictions, and the stage cost over time."""
    figure = Figure(figsize=(6, 9), layout="constrained")
    top, bottom = figure.subplots(2, 1, height_ratios=(3, 2))
    draw_positions(top, loops, mpc)
    draw_stage_costs(bottom, loops)
    return figure


def draw_learning(axes: Axes, updates: Sequence[float], J: Sequence[float], ends: Mapping) -> None:
    """Draw J over updates, with the start's and the true model's J as lines."""
    axes.plot(updates, J, color=COLOURS["learned"], marker="o", markersize=3, label="learned")
    for name, value in ends.items():
        axes.axhline(value, color=COLOURS.get(name), linestyle="--", label=name)
    axes.set(xlabel="update", ylabel="J, mean over starts", title="Learning", yscale="log")
    low, high = axes.get_ylim()
    steps = (1, 1.5, 2, 3, 5, 7)
    ticks = [s * 10**k for k in range(-2, 5) for s in steps if low <= s * 10**k <= high]
    axes.set_yticks(ticks, [f"{t:g}" for t in ticks])
    axes.yaxis.set_minor_locator(NullLocator())
    axes.legend(fontsize="small")


def summary_figure(
    mpc: QPMPC, loops: Mapping[str, ClosedLoop], updates: Sequence[float], J: Sequence[float]
) -> Figure:
    """Draw a run's learning curve, learned matrix and closed loop side by side."""
    figure = Figure(figsize=(15, 4), layout="constrained")
    left, middle, right = figure.subplots(1, 3, width_ratios=(1, 1.5, 1))
    ends = {name: loops[name].J for name in ("start", "true model") if name in loops}
    draw_learning(left, updates, J, ends)
    draw_matrix(middle, mpc.C, mpc, r"Learned constraint matrix $C_\theta$")
    draw_positions(right, loops, mpc)
    return figure
