"""A figure of one closed-loop episode: outputs, actions, known signals, and plans on the way."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from torch_qpmpc.analysis.plots import COLOURS
from torch_qpmpc.checks import check_kind, check_tensor, check_whole
from torch_qpmpc.errors import QPError
from torch_qpmpc.mpc.module import QPMPC

#: By step, the planned states ``(N + 1, n_y)`` and actions ``(N, n_u)``, as of `QPMPC.predicted`.
Plans = Mapping[int, tuple[Tensor, Tensor]]
#: Lower and upper bounds of the outputs, ``(n_y,)`` or ``(T + 1, n_y)``; infinite for none.
Band = tuple[Tensor, Tensor]

#: Smallest range of a panel that is not widened.
FLAT = 1e-6


@torch.no_grad()
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

    Raises:
        QPError: if a shape or a number of names does not fit.

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
    names = [*_names("outputs", outputs, "y", n_y), *_names("actions", actions, "u", n_u)]
    if references is not None:
        check_tensor("references", references, length, n_y, batched=False)
    bounds = (
        []
        if band is None
        else [
            _bound(name, side, length, n_y)
            for name, side in zip(("lower", "upper"), band, strict=True)
        ]
    )
    signals = signals or {}
    for name, signal in signals.items():
        check_tensor(f"signals[{name!r}]", signal, "T", batched=False)
        if len(signal) < length - 1:
            got, want = f"shape {tuple(signal.shape)}", f"at least {length - 1} entries"
            raise QPError.expected(f"signals[{name!r}]", got, want)
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


def _names(what: str, names: Sequence[str] | None, letter: str, count: int) -> Sequence[str]:
    if names is None:
        return [f"${letter}_{{{i + 1}}}$" for i in range(count)]
    if isinstance(names, str) or len(names) != count:
        raise QPError.expected(what, repr(names), f"{count} names")
    return names


def _bound(name: str, bound: Tensor, length: int, n_y: int) -> Tensor:
    """Return one side of the band, ``(T + 1, n_y)``, nan for none."""
    check_tensor(f"band, {name}", bound, n_y)
    if bound.shape[:-1] not in ((), (length,)):
        got, want = f"shape {tuple(bound.shape)}", f"shape ({n_y},) or ({length}, {n_y})"
        raise QPError.expected(f"band, {name}", got, want)
    return bound.masked_fill(bound.isinf(), torch.nan).expand(length, n_y)


def _held(values: Tensor) -> Tensor:
    """Return values with the last one repeated, the end of its step."""
    return torch.cat((values, values[-1:]))


def _draw_band(axes: Axes, times: Tensor, lower: Tensor, upper: Tensor) -> None:
    """Draw both bounds, which hold at the steps, and shade the band where there are both."""
    band = axes.fill_between(times, lower, upper, step="post", color="tab:green", alpha=0.12)
    band.set_label("band")
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
