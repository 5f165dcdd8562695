"""Figures of a learned QP: its canonical form, and an episode with plans."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from matplotlib.axes import Axes
from matplotlib.colors import SymLogNorm
from matplotlib.figure import Figure
from torch import Tensor

from torch_qpmpc.analysis.structure import (
    PredictionForm,
    canonical,
    causality_defect,
    nearest_model,
    prediction_form,
    predictions,
)
from torch_qpmpc.checks import check_kind, check_tensor, check_whole
from torch_qpmpc.mpc.layout import Layout
from torch_qpmpc.mpc.module import QPMPC
from torch_qpmpc.mpc.validation import without_gradients

#: By step, the planned states ``(N + 1, n_y)`` and actions ``(N, n_u)``, as of `QPMPC.predicted`.
Plans = Mapping[int, tuple[Tensor, Tensor]]
#: Lower and upper bounds of the outputs, ``(n_y,)`` or ``(T + 1, n_y)``; infinite for none.
Band = tuple[Tensor, Tensor]

#: Smallest range of a panel that is not widened.
FLAT = 1e-6
COLOURS = {"start": "tab:red", "learned": "tab:blue", "true model": "tab:green"}


def draw_matrix(axes: Axes, C: Tensor, mpc: QPMPC, title: str) -> None:
    """Draw a constraint matrix as a heatmap, logarithmic beyond 0.01, with lines between stages."""
    layout = mpc.layout
    _draw_entries(axes, C, layout, title, aspect="auto" if layout.n_d else "equal")
    for k in range(1, mpc.horizon):
        axes.axhline(k * mpc.n_x - 0.5, color="0.85", linewidth=0.4)
    previews = range(mpc.n_d, layout.n_preview, mpc.n_d) if mpc.n_d else ()
    stages = range(layout.n_preview or layout.n, layout.n_z, layout.n)
    for column in (*previews, *stages):
        axes.axvline(column - 0.5, color="0.85", linewidth=0.4)
    plan = (layout.n_preview, layout.n, range(mpc.horizon + 1), "x")
    columns = _columns(layout, layout.n_z, plan)
    axes.set_xticks(list(columns), list(columns.values()))
    rows = range(0, mpc.horizon, max(1, mpc.horizon // 5))
    axes.set_yticks([k * mpc.n_x for k in rows], [f"$k={k}$" for k in rows])


def _draw_entries(axes: Axes, matrix: Tensor, layout: Layout, title: str, aspect: Any) -> None:
    """Draw the entries as a heatmap, and the end of the preview as a dashed line."""
    scale = SymLogNorm(linthresh=1e-2, vmin=-1, vmax=1)
    entries, style = matrix.detach().cpu().numpy(), {"cmap": "RdBu_r", "norm": scale}
    image = axes.imshow(entries, interpolation="nearest", aspect=aspect, **style)
    axes.figure.colorbar(image, ax=axes, shrink=0.7, ticks=[-1, -0.1, -0.01, 0, 0.01, 0.1, 1])
    axes.set_title(title)
    if layout.n_d:
        axes.axvline(layout.n_preview - 0.5, color="black", linewidth=0.8, linestyle="--")


def _columns(layout: Layout, width: int, *plan: tuple[int, int, range, str]) -> dict[int, str]:
    """Return the columns that get a tick, with its label, in a figure of ``width`` columns.

    Each section, such as the preview, has its first column, the width of a stage, the stages and
    their letter. Beside a preview, ticks that would overlap are left out.
    """
    preview = (0, layout.n_d, range(layout.horizon + 1 if layout.n_d else 0), "d")
    gap = width / 16 if layout.n_d else 0
    ticks = {}
    for first, size, stages, letter in (preview, *plan):
        step = max(1, layout.horizon // 5, math.ceil(gap / max(size, 1)))
        for stage in stages[::step]:
            ticks[first + (stage - stages[0]) * size] = f"${letter}_{{{stage}}}$"
    following = [*list(ticks)[1:], math.inf]
    return {i: x for (i, x), end in zip(ticks.items(), following, strict=True) if end - i >= gap}


def _draw_prediction_form(axes: Axes, form: PredictionForm, title: str) -> None:
    """Draw ``[Phi, Gamma]``, the effect of p and each u_j on each x_k, as a heatmap."""
    layout = form.layout
    N, n_x, n_u, n_p = layout.horizon, layout.n_x, layout.n_u, layout.n_p
    entries = torch.cat((form.Phi, form.Gamma), dim=-1)
    _draw_entries(axes, entries, layout, title, aspect="auto")
    axes.axvline(n_p - 0.5, color="black", linewidth=0.8)
    for k in range(1, N):
        axes.axhline(k * n_x - 0.5, color="0.85", linewidth=0.4)
        axes.axvline(n_p + k * n_u - 0.5, color="0.85", linewidth=0.4)
        # Above these staircases an action or a preview would affect earlier states.
        for first, width in ((n_p, n_u), (0, layout.n_d)):
            if width:
                edge, row = first + k * width - 0.5, k * n_x - 0.5
                axes.plot([edge, edge], [row - n_x, row], color="black", linewidth=0.8)
                axes.plot([edge, edge + width], [row, row], color="black", linewidth=0.8)
    axes.set(xlim=(-0.5, entries.shape[1] - 0.5), ylim=(len(entries) - 0.5, -0.5))
    shown = range(0, N, max(1, N // 5))
    x_0, actions = (layout.n_preview, n_x, range(1), "x"), (n_p, n_u, range(N), "u")
    columns = _columns(layout, entries.shape[1], x_0, actions)
    axes.set_xticks(list(columns), list(columns.values()))
    axes.set_yticks([k * n_x for k in shown], [f"$x_{{{k + 1}}}$" for k in shown])


def canonical_figure(mpc: QPMPC) -> Figure:
    """Plot C beside its canonical form, and the first predictions beside the learned ones."""
    start = prediction_form(mpc.C_0, mpc.n_x, mpc.n_u, n_d=mpc.n_d)
    learned = predictions(mpc)
    figure = Figure(figsize=(14, 9), layout="constrained")
    (raw, below), (before, after) = figure.subplots(2, 2)
    draw_matrix(raw, mpc.C, mpc, r"$C_\theta$ as learned")
    draw_matrix(below, canonical(mpc), mpc, r"the same constraints in canonical form, $T C_\theta$")
    _draw_prediction_form(before, start, r"$[\Phi, \Gamma]$ at the start")
    defect, distance = causality_defect(learned).item(), nearest_model(learned).residual.item()
    numbers = f"causality defect {defect:.2g}, distance to MPC {distance:.2g}"
    _draw_prediction_form(after, learned, rf"$[\Phi, \Gamma]$, learned: {numbers}")
    return figure


@without_gradients
def plans_along(mpc: QPMPC, p: Tensor, every: int = 8) -> Plans:
    """Return the QP's plans at every ``every``-th step of an episode.

    Args:
        mpc: the QP.
        p: its argument at each step, ``(T, n_p)``.
        every: number of steps between two plans.

    Raises:
        QPError: if an argument does not fit.
        SolverError: if a QP has no solution, and ``mpc.on_failure`` is ``"raise"``.
    """
    check_kind("mpc", mpc, QPMPC)
    check_tensor("p", p, "T", mpc.n_p, batched=False)
    check_whole("every", every, 1)
    steps = range(0, len(p), every)
    x, u = mpc.predicted(mpc.solve(p[::every]).z)
    return dict(zip(steps, zip(x, u, strict=True), strict=True))


@without_gradients
def episode_figure(
    times: Tensor,
    y: Tensor,
    u: Tensor,
    *,
    signals: Mapping[str, Tensor] | None = None,
    band: Band | None = None,
    references: Tensor | None = None,
    plans: Plans | None = None,
    outputs: Sequence[str] | None = None,
    actions: Sequence[str] | None = None,
    xlabel: str = "step",
) -> Figure:
    """Plot an episode, with a panel for each output, action and known signal.

    Args:
        times: evenly spaced, ``(T + 1,)``.
        y: the outputs, ``(T + 1, n_y)``.
        u: the applied actions, ``(T, n_u)``, constant over a step.
        signals: the known signals d by name, ``(T,)`` or longer, constant over a step.
        band: the bounds of the outputs.
        references: those of the outputs, ``(T + 1, n_y)``; nan for an output without one.
        plans: see `plans_along`; drawn beside what was realised.
        outputs, actions: names of the entries of y and u, in their panels.
        xlabel: the label of the time axis.

    Example:
        >>> import torch
        >>> times = torch.arange(25.0)
        >>> y, u = 19 + torch.sin(times / 4).unsqueeze(-1), torch.ones(24, 1)
        >>> bounds = torch.tensor([18.0]), torch.tensor([21.0])
        >>> figure = episode_figure(
        ...     times, y, u, band=bounds, signals={"price": times}, outputs=["room, degrees"]
        ... )
        >>> [axes.get_ylabel() for axes in figure.axes]
        ['room, degrees', '$u_{1}$', 'price']
    """
    check_tensor("times", times, "T + 1", batched=False)
    length = len(times)
    check_tensor("y", y, length, "n_y", batched=False)
    check_tensor("u", u, length - 1, "n_u", batched=False)
    n_y, n_u = y.shape[-1], u.shape[-1]
    names = [
        *(outputs or [f"$y_{{{i + 1}}}$" for i in range(n_y)]),
        *(actions or [f"$u_{{{i + 1}}}$" for i in range(n_u)]),
    ]
    bounds = [side.masked_fill(side.isinf(), torch.nan).expand(length, n_y) for side in band or ()]
    signals = signals or {}
    figure = Figure(figsize=(6.5, 1.7 * (len(names) + len(signals))), layout="constrained")
    panels = figure.subplots(len(names) + len(signals), 1, sharex=True, squeeze=False)[:, 0]
    for axes, name in zip(panels, [*names, *signals], strict=True):
        axes.set_ylabel(name)
        axes.grid(alpha=0.3)
    for i, axes in enumerate(panels[:n_y]):
        if bounds:
            _draw_band(axes, times, *(side[:, i] for side in bounds))
        if references is not None:
            style = {"color": "tab:red", "linestyle": "--", "linewidth": 1}
            axes.plot(times, references[:, i], **style, label="reference")
        axes.plot(times, y[:, i], color=COLOURS["learned"], label="realised")
    for i, axes in enumerate(panels[n_y : n_y + n_u]):
        axes.step(times, _held(u[:, i]), where="post", color=COLOURS["learned"])
    for axes, signal in zip(panels[n_y + n_u :], signals.values(), strict=True):
        values = signal[:length] if len(signal) >= length else _held(signal)
        axes.step(times, values, where="post", color="0.3")
    for k, (x, planned) in (plans or {}).items():
        _draw_plan(list(panels), times, k, x, planned)
    if plans:
        panels[0].plot([], [], "k:", linewidth=1, label="planned")
    panels[0].legend(fontsize="small", loc="lower right", bbox_to_anchor=(1, 1), ncols=4)
    for axes in panels:  # otherwise rounding errors fill a panel
        low, high = axes.get_ylim()
        if high - low < FLAT:
            axes.set_ylim(low - 0.5, high + 0.5)
    panels[-1].set(xlabel=xlabel, xlim=(times[0].item(), times[-1].item()))
    return figure


def _held(values: Tensor) -> Tensor:
    """Return values with the last one repeated, the end of its step."""
    return torch.cat((values, values[-1:]))


def _draw_band(axes: Axes, times: Tensor, lower: Tensor, upper: Tensor) -> None:
    """Draw both bounds, which hold at the steps, and shade the band where there are both."""
    band = axes.fill_between(times, lower, upper, step="post", color="tab:green", alpha=0.12)
    band.set_label("" if torch.cat((lower, upper)).isnan().all() else "band")
    for side in (lower, upper):
        axes.step(times, side, where="post", color="tab:green", linewidth=0.8)


def _draw_plan(axes: Sequence[Axes], times: Tensor, k: int, x: Tensor, u: Tensor) -> None:
    """Draw the states ``(N + 1, n_y)`` and actions ``(N, n_u)`` that are planned at step k."""
    at = times[k] + (times[1] - times[0]) * torch.arange(len(x))
    style = {"color": "black", "linestyle": ":", "linewidth": 1, "marker": ".", "markevery": [0]}
    for panel, path in zip(axes, x.mT, strict=False):
        panel.plot(at, path, **style)
    for panel, path in zip(axes[x.shape[-1] :], u.mT, strict=False):
        panel.step(at, _held(path), where="post", **style)
