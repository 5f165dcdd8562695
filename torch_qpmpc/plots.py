"""Figures of a run: the constraint matrix, closed-loop and predicted trajectories, learning."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from matplotlib.axes import Axes
from matplotlib.colors import SymLogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator
from torch import Tensor

from torch_qpmpc.errors import QPError
from torch_qpmpc.evaluation import ClosedLoop
from torch_qpmpc.mpc import QPMPC
from torch_qpmpc.reading import canonical

COLOURS = {"start": "tab:red", "learned": "tab:blue", "true model": "tab:green"}


def draw_matrix(axes: Axes, C: Tensor, mpc: QPMPC, title: str) -> None:
    """A heatmap of a constraint matrix, symmetric and logarithmic beyond 0.01, with stage lines."""
    image = axes.imshow(
        C.detach().cpu().numpy(),
        cmap="RdBu_r",
        norm=SymLogNorm(linthresh=1e-2, vmin=-1, vmax=1),
        interpolation="nearest",
    )
    n = mpc.n_x + mpc.n_u
    for k in range(1, mpc.horizon):
        axes.axhline(k * mpc.n_x - 0.5, color="0.85", linewidth=0.4)
    for k in range(1, mpc.horizon + 1):
        axes.axvline(k * n - 0.5, color="0.85", linewidth=0.4)
    axes.set_title(title)
    stages = range(0, mpc.horizon + 1, max(1, mpc.horizon // 5))
    axes.set_xticks([k * n for k in stages], [f"$x_{{{k}}}$" for k in stages])
    rows = [k for k in stages if k < mpc.horizon]
    axes.set_yticks([k * mpc.n_x for k in rows], [f"$k={k}$" for k in rows])
    axes.figure.colorbar(image, ax=axes, shrink=0.7, ticks=[-1, -0.1, -0.01, 0, 0.01, 0.1, 1])


def constraint_figure(mpc: QPMPC) -> Figure:
    """C_0, C raw as in the paper's figures, and C's canonical form, which has no gauge.

    One above the other: TensorBoard's cards are narrow.
    """
    figure = Figure(figsize=(6, 10.5), layout="constrained")
    top, middle, bottom = figure.subplots(3, 1)
    draw_matrix(top, mpc.C_0, mpc, "$C_0$, the start")
    draw_matrix(middle, mpc.C, mpc, r"$C_\theta$, learned")
    try:
        C = canonical(mpc)
    except QPError as error:
        bottom.text(0.5, 0.5, f"No canonical form:\n{error}", ha="center", va="center", wrap=True)
        bottom.set_axis_off()
        return figure
    draw_matrix(bottom, C, mpc, r"$C_\theta$ in canonical form")
    return figure


def draw_positions(axes: Axes, loops: Mapping[str, ClosedLoop], mpc: QPMPC, shown: int = 6) -> None:
    """Closed-loop paths in the plane from a few starts, and the learned QP's first predictions."""
    for name, loop in loops.items():
        paths = loop.states[:, :shown]
        colour = COLOURS.get(name)
        axes.plot(paths[..., 0], paths[..., 1], color=colour, linewidth=1)
        axes.plot([], [], color=colour, label=f"{name}, J = {loop.J:.0f}")
    starts = next(iter(loops.values())).states[0, :shown]
    with torch.no_grad():
        predicted, _ = mpc.predicted(mpc.solve(starts).z)
    axes.plot(predicted[..., 0].mT, predicted[..., 1].mT, "k:", linewidth=1)
    axes.plot([], [], "k:", label="predicted at the start")
    axes.plot(starts[:, 0], starts[:, 1], "ko", markersize=3)
    axes.plot(0, 0, "k+", markersize=9)
    axes.set(xlabel="$s_1$", ylabel="$s_2$", title="Closed loop")
    axes.legend(fontsize="small", loc="upper center", bbox_to_anchor=(0.5, -0.18), ncols=2)


def draw_stage_costs(axes: Axes, loops: Mapping[str, ClosedLoop]) -> None:
    """Mean stage cost over time."""
    for name, loop in loops.items():
        axes.plot(loop.costs.mean(1), color=COLOURS.get(name), label=name)
    axes.set(xlabel="step", ylabel="L(s, a), mean over starts", title="Stage cost", yscale="log")
    axes.legend(fontsize="small")


def closed_loop_figure(loops: Mapping[str, ClosedLoop], mpc: QPMPC) -> Figure:
    """Paths in the plane with predictions, and the stage cost over time."""
    figure = Figure(figsize=(6, 9), layout="constrained")
    top, bottom = figure.subplots(2, 1, height_ratios=(3, 2))
    draw_positions(top, loops, mpc)
    draw_stage_costs(bottom, loops)
    return figure


def draw_learning(axes: Axes, updates: Sequence[float], J: Sequence[float], ends: Mapping) -> None:
    """J against updates, between its two ends."""
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
    """One picture of a run: learning, the learned matrix, and what it does in closed loop."""
    figure = Figure(figsize=(15, 4), layout="constrained")
    left, middle, right = figure.subplots(1, 3, width_ratios=(1, 1.5, 1))
    ends = {name: loops[name].J for name in ("start", "true model") if name in loops}
    draw_learning(left, updates, J, ends)
    draw_matrix(middle, mpc.C, mpc, r"Learned constraint matrix $C_\theta$")
    draw_positions(right, loops, mpc)
    return figure
