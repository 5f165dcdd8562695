"""Figures of a run: learning curve, constraint matrix, closed loop and one episode."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator
from torch import Tensor

from torch_qpmpc.analysis.plots import COLOURS, draw_matrix, episode_figure, plans_along
from torch_qpmpc.envs.closed_loop import ClosedLoop
from torch_qpmpc.experiment.algorithms import warm_up_batches
from torch_qpmpc.experiment.config import Config, find_task
from torch_qpmpc.experiment.evaluation import Evaluation, cost_text
from torch_qpmpc.mpc.module import QPMPC

#: Starts whose paths are drawn.
SHOWN = 6


def draw_positions(
    axes: Axes,
    loops: Mapping[str, ClosedLoop],
    mpc: QPMPC,
    names: Mapping[str, Any],
) -> None:
    """Draw closed-loop paths from a few starts, and the learned QP's predictions.

    They are in the plane of the first two states or outputs, or over time if there is only one.
    """
    plane = mpc.n_x > 1
    times = names.get("times", torch.arange(2.0))

    def draw(paths: Tensor, *style: Any, **options: Any) -> None:
        """Draw paths ``(steps, starts, n_x)``."""
        x = paths[..., 0] if plane else (times[1] - times[0]) * torch.arange(len(paths))
        axes.plot(x.numpy(), paths[..., int(plane)].numpy(), *style, **options)

    for name, loop in loops.items():
        colour = COLOURS.get(name)
        draw(loop.states[:, :SHOWN], color=colour, linewidth=1)
        axes.plot([], [], color=colour, label=f"{name}, J = {cost_text(loop.J)}")
    first = next(iter(loops.values()))
    with torch.no_grad():
        predicted, _ = mpc.predicted(mpc.solve(first.known[0, :SHOWN]).z)
    draw(predicted.transpose(0, 1), "k:", linewidth=1)
    axes.plot([], [], "k:", label="predicted at the start")
    draw(first.states[:1, :SHOWN], "ko", markersize=3)
    if plane:
        axes.plot(0, 0, "k+", markersize=9)
    outputs = names["outputs"]
    labels = outputs[:2] if plane else (names.get("xlabel", "step"), outputs[0])
    axes.set(xlabel=labels[0], ylabel=labels[1], title="Closed loop")
    axes.legend(fontsize="small", loc="upper center", bbox_to_anchor=(0.5, -0.18), ncols=2)


def learned_episode_figure(mpc: QPMPC, evaluation: Evaluation) -> Figure:
    """Draw the first episode of the learned policy, and its plans after every half horizon."""
    loop = evaluation.loops["learned"]
    steps = int(loop.lengths[0])
    p, y, u = loop.known[: steps + 1, 0], loop.states[: steps + 1, 0], loop.actions[:steps, 0]
    options = {"times": torch.arange(len(p), dtype=torch.float64), **episode_names(mpc, evaluation)}
    plans = plans_along(mpc, p[:-1], every=max(mpc.horizon // 2, 1))
    return episode_figure(y=y, u=u, plans=plans, **options)


def episode_names(mpc: QPMPC, evaluation: Evaluation) -> dict[str, Any]:
    """Return the names of outputs and actions, and what else the task shows of an episode."""
    d = evaluation.loops["learned"].known[:, 0, : mpc.n_d]
    shown = find_task(evaluation.cfg.task).episode(evaluation.physics, d)
    outputs = [f"$s_{{{i + 1}}}$" for i in range(mpc.n_x)]
    return {"outputs": outputs, "actions": [f"$a_{{{i + 1}}}$" for i in range(mpc.n_u)], **shown}


def draw_learning(
    axes: Axes, updates: Sequence[float], J: Sequence[float], evaluation: Evaluation
) -> None:
    """Draw J over updates and experience, with the J of the others as lines."""
    axes.plot(updates, J, color=COLOURS["learned"], marker="o", markersize=3, label="learned")
    others = {x: loop.J for x, loop in evaluation.loops.items() if x in ("start", "true model")}
    draw_lines(axes, others | evaluation.rivals)
    axes.set(xlabel="update", ylabel="J, mean over starts")
    scale_costs(axes)
    first, each = experience(evaluation.cfg)
    ticks: Any = (lambda k: first + each * k, lambda x: (x - first) / each)
    axes.secondary_xaxis("top", functions=ticks).set_xlabel("transitions")
    axes.legend(fontsize="x-small", loc="upper center", bbox_to_anchor=(0.5, -0.18), ncols=2)


def draw_lines(axes: Axes, costs: Mapping[str, float]) -> None:
    """Draw costs that learning does not change as horizontal lines, each with its number."""
    for i, (name, J) in enumerate(costs.items()):
        line = "--" if name in COLOURS else ":"
        label = f"{name}, {cost_text(J)}"
        axes.axhline(J, color=COLOURS.get(name, f"C{4 + i}"), linestyle=line, label=label)


def scale_costs(axes: Axes) -> None:
    """Scale the vertical axis: by the logarithm, with readable ticks, if costs differ by half."""
    low, high = axes.get_ylim()
    if not 0 < low < high / 1.5:
        return
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(subs=(1, 1.5, 2, 3, 5, 7)))
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_locator(NullLocator())


def experience(cfg: Config) -> tuple[int, int]:
    """Return the transitions before the first update, log included, and those of each."""
    each = cfg.num_envs * cfg.steps_per_update
    first = each * warm_up_batches(cfg)
    if cfg.start.name == "data" and cfg.start.file is None:
        first += cfg.start.transitions
    return first, each


def summary_figure(
    mpc: QPMPC, evaluation: Evaluation, updates: Sequence[float], J: Sequence[float]
) -> Figure:
    """Draw a run's learning curve, learned matrix and closed loop, each in a third of the width."""
    figure = Figure(figsize=(15, 4), layout="constrained")
    panels: Any = figure.subfigures(1, 3)
    left, middle, right = (panel.subplots() for panel in panels)
    draw_learning(left, updates, J, evaluation)
    title = "Learned constraint matrix" if mpc.sequential is None else "Unused by networks:"
    draw_matrix(middle, mpc.C, mpc, rf"{title} $C_\theta$")
    draw_positions(right, evaluation.loops, mpc, episode_names(mpc, evaluation))
    return figure
