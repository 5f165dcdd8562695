"""Figures of a learned QP: its canonical form, its predictions and its policy's regions."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import torch
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.colors import SymLogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from torch import Tensor

from torch_qpmpc.analysis.policy import PolicyMap, policy_map
from torch_qpmpc.analysis.prediction_form import PredictionForm, canonical_matrix, prediction_form
from torch_qpmpc.analysis.report import canonical, predictions
from torch_qpmpc.analysis.structure import (
    causality_defect,
    gamma_energies,
    memory_energies,
    nearest_model,
    stage_models,
)
from torch_qpmpc.checks import check_tensor
from torch_qpmpc.errors import QPError
from torch_qpmpc.mpc.layout import Layout
from torch_qpmpc.mpc.module import QPMPC

COLOURS = {"start": "tab:red", "learned": "tab:blue", "true model": "tab:green"}


def draw_matrix(axes: Axes, C: Tensor, mpc: QPMPC, title: str) -> None:
    """Draw a constraint matrix as a heatmap, logarithmic beyond 0.01, with lines between stages.

    Dashed lines end the preview and the window before x_0, where they exist.
    """
    image = axes.imshow(
        C.detach().cpu().numpy(),
        cmap="RdBu_r",
        norm=SymLogNorm(linthresh=1e-2, vmin=-1, vmax=1),
        interpolation="nearest",
        aspect="equal" if mpc.n_p == mpc.n_x else "auto",
    )
    layout = mpc.layout
    for k in range(1, mpc.horizon):
        axes.axhline(k * mpc.n_x - 0.5, color="0.85", linewidth=0.4)
    previews = range(mpc.n_d, layout.n_preview, mpc.n_d) if mpc.n_d else ()
    stages = range(layout.n_preview or layout.n, layout.n_z, layout.n)
    for column in (*previews, *stages):
        axes.axvline(column - 0.5, color="0.85", linewidth=0.4)
    _draw_ends(axes, layout)
    axes.set_title(title)
    plan = (layout.n_before, layout.n, range(mpc.horizon + 1), "x")
    columns = _columns(layout, layout.n_z, plan)
    axes.set_xticks(list(columns), list(columns.values()))
    rows = range(0, mpc.horizon, max(1, mpc.horizon // 5))
    axes.set_yticks([k * mpc.n_x for k in rows], [f"$k={k}$" for k in rows])
    axes.figure.colorbar(image, ax=axes, shrink=0.7, ticks=[-1, -0.1, -0.01, 0, 0.01, 0.1, 1])


def _draw_ends(axes: Axes, layout: Layout) -> None:
    """Draw the ends of the preview and of the window before x_0, where they exist."""
    for end in {layout.n_preview, layout.n_before} - {0}:
        axes.axvline(end - 0.5, color="black", linewidth=0.8, linestyle="--")


def _columns(layout: Layout, width: int, *plan: tuple[int, int, range, str]) -> dict[int, str]:
    """Return the columns that get a tick, with its label, in a figure of ``width`` columns.

    Each section, such as the preview, has its first column, the width of a stage, the stages and
    their letter. Beside a preview or a window, ticks that would overlap are left out.
    """
    preview = (0, layout.n_d, range(layout.horizon + 1 if layout.n_d else 0), "d")
    window = (layout.n_preview, layout.n, range(1 - layout.past, 0), "x")
    gap = width / 16 if layout.n_before else 0
    ticks = {}
    for first, size, stages, letter in (preview, window, *plan):
        step = max(1, layout.horizon // 5, math.ceil(gap / max(size, 1)))
        for stage in stages[::step]:
            ticks[first + (stage - stages[0]) * size] = f"${letter}_{{{stage}}}$"
    following = [*list(ticks)[1:], math.inf]
    return {i: x for (i, x), end in zip(ticks.items(), following, strict=True) if end - i >= gap}


def constraint_figure(mpc: QPMPC) -> Figure:
    """Plot C_0, C as in the paper's figures, and C's canonical form, which has no gauge.

    The panels are stacked because TensorBoard's cards are narrow.
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


def forms(mpc: QPMPC) -> dict[str, PredictionForm]:
    """Return the prediction forms of C at the start and of the learned C.

    Raises:
        QPError: if C has no prediction form.
    """
    start = prediction_form(mpc.C_0, mpc.n_x, mpc.n_u, past=mpc.past, n_d=mpc.n_d)
    return {"start": start, "learned": predictions(mpc)}


def draw_prediction_form(axes: Axes, form: PredictionForm, title: str) -> None:
    """Draw ``[Phi, Gamma]``, the effect of p and each u_j on each x_k, as a heatmap.

    Dashed lines end the preview and the window before x_0, where they exist.
    """
    N, n_x, n_u, n_p, layout = form.horizon, form.n_x, form.n_u, form.n_p, form.layout
    entries = torch.cat((form.Phi, form.Gamma), dim=-1)
    image = axes.imshow(
        entries.numpy(),
        cmap="RdBu_r",
        norm=SymLogNorm(linthresh=1e-2, vmin=-1, vmax=1),
        interpolation="nearest",
        aspect="auto",
    )
    axes.axvline(n_p - 0.5, color="black", linewidth=0.8)
    _draw_ends(axes, layout)
    for k in range(1, N):
        axes.axhline(k * n_x - 0.5, color="0.85", linewidth=0.4)
        axes.axvline(n_p + k * n_u - 0.5, color="0.85", linewidth=0.4)
        # Above these staircases an action or a preview would affect earlier states.
        for first, width in ((n_p, n_u), (0, form.layout.n_d)):
            if width:
                edge, row = first + k * width - 0.5, k * n_x - 0.5
                axes.plot([edge, edge], [row - n_x, row], color="black", linewidth=0.8)
                axes.plot([edge, edge + width], [row, row], color="black", linewidth=0.8)
    axes.set(xlim=(-0.5, entries.shape[1] - 0.5), ylim=(len(entries) - 0.5, -0.5), title=title)
    shown = range(0, N, max(1, N // 5))
    x_0, actions = (layout.n_before, n_x, range(1), "x"), (n_p, n_u, range(N), "u")
    columns = _columns(layout, entries.shape[1], x_0, actions)
    axes.set_xticks(list(columns), list(columns.values()))
    axes.set_yticks([k * n_x for k in shown], [f"$x_{{{k + 1}}}$" for k in shown])
    axes.figure.colorbar(image, ax=axes, shrink=0.7, ticks=[-1, -0.1, 0, 0.1, 1])


def canonical_figure(mpc: QPMPC) -> Figure:
    """Plot C beside its canonical form, and the predictions at the start beside the learned ones.

    Raises:
        QPError: if C has no prediction form.
    """
    start, learned = forms(mpc).values()
    figure = Figure(figsize=(14, 9), layout="constrained")
    (raw, canonical), (before, after) = figure.subplots(2, 2)
    draw_matrix(raw, mpc.C, mpc, r"$C_\theta$ as learned")
    C, _ = canonical_matrix(learned, stage_models(learned).A)
    draw_matrix(canonical, C, mpc, r"the same constraints in canonical form, $T C_\theta$")
    draw_prediction_form(before, start, r"$[\Phi, \Gamma]$ at the start")
    defect, distance = causality_defect(learned).item(), nearest_model(learned).residual.item()
    numbers = f"causality defect {defect:.2g}, distance to MPC {distance:.2g}"
    draw_prediction_form(after, learned, rf"$[\Phi, \Gamma]$, learned: {numbers}")
    return figure


def energies_figure(mpc: QPMPC) -> Figure:
    """Plot the predictions' energy by block diagonal, and by the pair that explains it.

    Raises:
        QPError: if C has no prediction form.
    """
    figure = Figure(figsize=(12, 4), layout="constrained")
    left, right = figure.subplots(1, 2)
    N, floor = mpc.horizon, 1e-12
    for i, (name, form) in enumerate(forms(mpc).items()):
        style = {"width": 0.4, "color": COLOURS[name], "label": name}
        share = gamma_energies(form)
        lags = torch.arange(1 - N, N) + 0.4 * i - 0.2
        left.bar(lags.numpy(), (share / share.sum()).clamp(min=floor).numpy(), **style)
        back = torch.arange(N + 1) + 0.4 * i - 0.2
        right.bar(back.numpy(), memory_energies(form).clamp(min=floor).numpy(), **style)
    for axes in (left, right):
        axes.set(yscale="log", ylim=(floor, 2), ylabel="share of the energy")
        axes.legend(fontsize="small")
    left.axvspan(-N + 0.4, -0.5, color="0.93", zorder=0)
    left.set(
        xlabel="$k - j$ of block $(k, j)$, grey: not causal",
        title=r"$\Gamma$ by block diagonals: $u_j$ in $x_{k+1}$",
        xlim=(-N + 0.4, N - 0.4),
    )
    left.xaxis.set_major_locator(MaxNLocator(integer=True))
    latest = "pair $(x_k, u_k)$" if mpc.n_p == mpc.n_x else "window"
    right.set(xlabel=f"stages before the latest {latest}", title="What explains $x_{k+1}$")
    step = max(1, N // 5)
    ticks = [back for back in range(0, N, step) if N - back >= step or back == 0]
    later = "later\nactions" + (",\npreviews" if mpc.n_d else "")
    right.set_xticks([*ticks, N], [*map(str, ticks), later])
    return figure


def slice_between(mpc: QPMPC, starts: Tensor, points: int = 21) -> PolicyMap:
    """Evaluate the policy on a grid that spans ``starts`` ``(n, n_p)`` in two states of x_0.

    The two are the first state and the one half-way: a position and its speed, if all positions
    come first. A state in which all starts agree is gridded from one below to one above. Others are
    0, and the preview is the starts' mean.

    Raises:
        QPError: if there is only one state, or the shape of ``starts`` does not fit.
    """
    check_tensor("starts", starts, "n", mpc.n_p, batched=False)
    first = mpc.n_p - mpc.n_x
    axes = (first, first + mpc.n_x // 2)
    low, high = (ends.double() for ends in starts.aminmax(dim=0))
    wide = (high == low).double()
    low, high = low - wide, high + wide
    x, y = (torch.linspace(low[i].item(), high[i].item(), points) for i in axes)
    at = starts.double().mean(0)
    at[(mpc.horizon + 1) * mpc.n_d :] = 0
    return policy_map(mpc, x, y, axes=axes, at=at)


def draw_slice(axes: Axes, mapped: PolicyMap, field: Tensor, title: str, **style: Any) -> QuadMesh:
    """Draw a field on the grid, ``(n, m)``, blank where it is nan."""
    grid = (part.numpy() for part in (mapped.x, mapped.y, field.mT))
    image = axes.pcolormesh(*grid, shading="nearest", rasterized=True, **style)
    first, second = mapped.names
    axes.set(xlabel=f"${first}$", ylabel=f"${second}$", title=title)
    return image


def draw_regions(axes: Axes, mapped: PolicyMap) -> None:
    """Draw the regions of one active set each, with their borders; colours repeat."""
    title = f"Active sets: {len(mapped.active_sets)} regions on this grid"
    colours = (mapped.regions % 20).double().masked_fill(mapped.regions < 0, torch.nan)
    draw_slice(axes, mapped, colours, title, cmap="tab20", vmin=-0.5, vmax=19.5)
    for line in _borders(mapped):
        axes.plot(*line, color="black", linewidth=0.5, alpha=0.6)


def policy_figure(mapped: PolicyMap, action: int = 0) -> Figure:
    """Plot the value, an action, its local gain and the active sets on a slice of the states.

    Args:
        mapped: a `PolicyMap`.
        action: index of the action.
    """
    figure = Figure(figsize=(12, 9), layout="constrained")
    (value, policy), (gain, sets) = figure.subplots(2, 2)
    u, name = mapped.actions[..., action], f"{{{action + 1}}}"
    images = [draw_slice(value, mapped, mapped.values, "Value $V(s)$", cmap="viridis")]
    size = max(1e-12, u.nan_to_num().abs().max().item())
    title = rf"Policy $\pi_{name}(s)$"
    images.append(draw_slice(policy, mapped, u, title, cmap="RdBu_r", vmin=-size, vmax=size))
    slope = mapped.gains[..., action, :].norm(dim=-1)
    title = rf"Local gain $\|d\pi_{name} / ds\|$"
    images.append(draw_slice(gain, mapped, slope, title, cmap="magma"))
    for axes, image in zip((value, policy, gain), images, strict=True):
        figure.colorbar(image, ax=axes, shrink=0.85)
    draw_regions(sets, mapped)
    return figure


def _borders(mapped: PolicyMap) -> list[tuple[list[float], list[float]]]:
    """Return the segments between grid points of different active sets, as one line per axis.

    A line is a pair of coordinate lists, with nan between the segments.
    """
    edges = [_edges(axis) for axis in (mapped.x, mapped.y)]
    lines = []
    for axis in (0, 1):
        across, along = edges[axis], edges[1 - axis]
        regions = mapped.regions if axis == 0 else mapped.regions.mT
        at: list[float] = []
        along_at: list[float] = []
        for i, j in (regions[1:] != regions[:-1]).nonzero().tolist():
            at += [across[i + 1], across[i + 1], float("nan")]
            along_at += [along[j], along[j + 1], float("nan")]
        lines.append((at, along_at) if axis == 0 else (along_at, at))
    return lines


def _edges(points: Tensor) -> list[float]:
    """Return the midpoints of neighbours, and points as far beyond the first and the last."""
    values = points.tolist()
    if len(values) == 1:
        return [values[0] - 0.5, values[0] + 0.5]
    middle = [(a + b) / 2 for a, b in pairwise(values)]
    return [2 * values[0] - middle[0], *middle, 2 * values[-1] - middle[-1]]
