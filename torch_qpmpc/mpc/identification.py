"""Identification of C and b from logged trajectories, and a report of its prediction errors.

`torch_qpmpc.mpc.predictor` has the mathematics.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from torch_qpmpc.checks import check_choice, check_flag, check_number, check_whole
from torch_qpmpc.errors import QPError
from torch_qpmpc.mpc.layout import SIZES, Layout
from torch_qpmpc.mpc.log import Log, as_log, folds
from torch_qpmpc.mpc.predictor import (
    ARX,
    Constraints,
    Options,
    Windows,
    fit,
    prediction_errors,
    transitions,
    windows,
)
from torch_qpmpc.mpc.validation import STRUCTURES, as_tensor

#: The largest number of parts of the data in cross-validation.
PARTS = 5
#: An action that the other regressors explain up to this share of its size does not excite.
STILL = 1e-6
EXCITE = "Add a random signal to the action, independent of the outputs."


@dataclass(frozen=True, eq=False)
class Identified:
    """An ARX model, the constraints ``C z = b`` that start from it, and their prediction errors.

    ``print`` shows the cross-validated errors: each belongs to a fit that has not seen its part of
    the data. They are NaN for steps that no part is long enough for, and if
    the other parts determine no model. Their root mean square is the standard deviation that a
    back-off from bounds needs.

    Attributes:
        model: the ARX model.
        constraints: C and b.
        options: how they were fitted.
        log: the trajectories, with the names of their signals.
    """

    model: ARX
    constraints: Constraints
    options: Options
    log: Log

    @property
    def arguments(self) -> dict[str, Any]:
        """The arguments of `QPMPC` that start it here: ``QPMPC.of(**identified.arguments, ..)``."""
        structure, start = self.options.structure, self.constraints._asdict()
        sizes = {name: getattr(self.options.layout, name) for name in SIZES}
        more = {} if structure == "tied" else {"start": start}
        return {**sizes, "structure": structure, **self.model._asdict(), **more}

    @cached_property
    def errors(self) -> Tensor:
        """y_{k+1} minus its prediction, ``(starts, N, n_x)``; NaN after a trajectory's end."""
        layout, causal = self.options.layout, self.options.causal
        data, total = self.log.trajectories, self.log.steps
        count = max(min(PARTS, total // (2 * (layout.past + layout.horizon))), 2)
        parts = [windows(part, layout) for part in folds(data, count)]
        errors = [torch.full((1, layout.horizon, layout.n_x), torch.nan, dtype=torch.float64)]
        for i, part in enumerate(parts):
            others = Windows(*map(torch.cat, zip(*parts[:i], *parts[i + 1 :], strict=True)))
            if len(others.z) > _needed(layout):
                coefficients = fit(others, self.options)[1]
                errors.append(prediction_errors(part, coefficients, layout, causal))
        return torch.cat(errors)

    @property
    def rmse(self) -> Tensor:
        """The root mean square of the errors after 1, .., N steps, ``(N, n_x)``."""
        return self.errors.square().nanmean(0).sqrt()

    @property
    def R2(self) -> Tensor:
        """The share of each output's variance that is predicted 1, .., N steps ahead."""
        outputs = torch.cat([log.y for log in self.log.trajectories])
        return 1 - (self.rmse / outputs.std(0, correction=0)).square()

    @property
    def covariance(self) -> Tensor:
        """The covariance of the one-step errors, ``(n_x, n_x)``."""
        e = self.errors[:, 0]
        e = e[e.isfinite().all(-1)]
        return e.mT @ e / len(e)

    def simulate(self, u: Any, y: Any, d: Any = None) -> Tensor:
        """Return the outputs of the ARX model alone, without corrections by measurements.

        Args:
            u: actions ``(T, n_u)``; the first L - 1 belong to the window.
            y: the outputs of the window, the first L, ``(L, n_x)``.
            d: known signals ``(T, n_d)``, if the model has any.

        Returns:
            y_0, .., y_T, ``(T + 1, n_x)``; the first L are ``y``.

        Raises:
            QPError: a shape does not match the model.
        """
        layout = self.options.layout
        past, n_d = layout.past, layout.n_d
        u, y = (as_tensor(name, x, True) for name, x in (("u", u), ("y", y)))
        steps = len(u) if u.ndim else 0
        d = u.new_zeros(steps, 0) if d is None else as_tensor("d", d, True)
        sizes = {"u": (steps, layout.n_u), "y": (past, layout.n_x), "d": (steps, n_d)}
        for (name, shape), value in zip(sizes.items(), (u, y, d), strict=True):
            if tuple(value.shape) != shape:
                raise QPError.expected(name, f"shape {tuple(value.shape)}", f"{shape}")
        A, B, E, offset = self.model
        outputs = list(y)
        for k in range(past - 1, steps):
            lags = range(k, k - past, -1)
            now = A @ torch.cat([outputs[i] for i in lags]) + B @ torch.cat([u[i] for i in lags])
            outputs.append(now + E @ d[k] + offset)
        return torch.stack(outputs)

    def __str__(self) -> str:
        layout, N, log = self.options.layout, self.options.layout.horizon, self.log
        lines = [
            str(log),
            f"{self.options.structure} C from {log.steps} transitions in {len(log.trajectories)} "
            f"trajectories, {', '.join(f'{name}={getattr(layout, name)}' for name in SIZES)}",
        ]
        rows = [("RMSE of " + ", ".join(map(log.label, log.outputs)), "R2, cross-validated")]
        longest = min(N, max(part.steps for part in log.trajectories))  # single steps have one
        steps = sorted({k for k in (1, 2, 5, 10, 20, 50, 100) if k < longest} | {longest})
        for k in steps:
            errors = " ".join(f"{x:.3g}" for x in self.rmse[k - 1].tolist())
            rows.append((errors, " ".join(f"{x:.3f}" for x in self.R2[k - 1])))
        width = max(38, *(len(errors) + 2 for errors, _ in rows))
        lines += [
            f"{k:>6}  {errors:{width}}{R2}"
            for k, (errors, R2) in zip(("steps", *steps), rows, strict=True)
        ]
        return "\n".join(lines)


def identify(
    trajectories: Any,
    horizon: int,
    *,
    past: int = 1,
    n_d: int | None = None,
    n_x: int | None = None,
    structure: str = "free",
    causal: bool = True,
    ridge: float | None = None,
    held: Sequence[int] = (),
) -> Identified:
    """Fit C and b to logged trajectories; see `torch_qpmpc.mpc.predictor`.

    Args:
        trajectories: a `Log`, or what `read_log` takes; or logged steps, ``(T,)`` or ``(episodes,
            T)``, in a TensorDict with ``observation``, ``action`` (as applied) and ``("next",
            "observation")``. Done flags, the ids of trajectories and
            gaps in ``time`` or ``step_count`` are respected. A list or lazy stack of logs may have
            different lengths.
        horizon: N.
        past: L, the number of lags.
        n_d: entries of d_k: by default the known signals of a `Log`, and 0 in a TensorDict, where
            they are the first of the entry ``preview``.
        n_x: the number of outputs, the last entries of ``observation``, which may be a window; all
            of them by default.
        structure: ``"tied"``: an ARX model. ``"varying"``: one for each stage, fitted to the
            predictions before it. ``"free"``: a multi-step predictor.
        causal: let row block k of a free C read d_0, .., d_k and u_0, .., u_k only.
        ridge: the weight of the squared changes of coefficients from step to step, in units of the
            regressors, relative to the mean squared error; by default the evidence chooses it for
            each regression (`torch_qpmpc.mpc.ridge.ridge`).
        held: indices of outputs that the model holds at their last value, such as set-points. All
            others may depend on them.

    Raises:
        QPError: an argument or an entry is invalid, the data are too short for ``past``, or the
            actions do not move enough to show their effect.

    Example:
        >>> import numpy as np, torch_qpmpc as qm
        >>> u, y = np.random.default_rng(0).uniform(-1, 1, 50), np.zeros(51)
        >>> for t in range(50):
        ...     y[t + 1] = 0.9 * y[t] + 0.5 * u[t]
        >>> identified = qm.identify({"y": y, "u": u}, horizon=4)
        >>> [round(part.item(), 4) for part in identified.model[:2]]
        [0.9, 0.5]
    """
    for name, size in (("horizon", horizon), ("past", past)):
        check_whole(name, size, 1)
    check_choice("structure", structure, STRUCTURES)
    check_flag("causal", causal)
    if ridge is not None:
        check_number("ridge", ridge, lambda x: 0 <= x < torch.inf, "a finite number >= 0, or None")
    log = as_log(trajectories, n_x, n_d)
    sizes = len(log.outputs), len(log.inputs), int(horizon), int(past), len(log.known)
    layout = Layout(*sizes)
    check_excitation(log, layout)
    options = Options(layout, structure, causal, ridge, check_held(held, layout.n_x))
    return Identified(*fit(log.trajectories, options), options, log)


def check_held(held: Sequence[int], n_x: int) -> tuple[int, ...]:
    """Return the indices of the outputs that a model holds, each once and in order.

    Raises:
        QPError: they are no indices of outputs.
    """
    whole = isinstance(held, Sequence) and all(type(i) is int for i in held)
    if not whole or not {*held} <= {*range(n_x)}:
        want = f"a list of indices of the {n_x} outputs, from 0 on"
        raise QPError.expected("held", repr(held), want, "In train.py it is task.held.")
    return (*sorted({*held}),)


def check_excitation(log: Log, layout: Layout) -> None:
    """Raise `QPError` unless the data determine an ARX model.

    There must be more transitions than coefficients, and each action must move in a way that the
    other regressors do not explain.
    """
    past, n_x, n_u, n_d = layout.past, layout.n_x, layout.n_u, layout.n_d
    needed, trajectories = _needed(layout), log.trajectories
    usable = sum(max(log.steps - past + 1, 0) for log in trajectories)
    if usable <= needed:
        got = f"{log.steps} transitions in {len(trajectories)} trajectories"
        if past > 1:
            got += f", {usable} of them with {past - 1} before them"
        expected = f"at least {needed + 1} such for past={past}, n_x={n_x}, n_u={n_u} and n_d={n_d}"
        remedy = (
            f"A fit of as many transitions as coefficients, {needed}, has no error to judge it by. "
            f"Log more, in trajectories of more than {past} steps, or lower past."
        )
        raise QPError.expected("trajectories", got, expected, remedy)
    u = torch.cat([log.u for log in trajectories])
    if n_u > 1 and ((u == 0) | (u == 1)).all() and (u.sum(-1) == 1).all():
        raise QPError.expected("action", "one-hot vectors of discrete ones", "continuous actions")
    X, _ = transitions(trajectories, layout)
    middle = X.mean(0)
    X = X - middle
    size = X.square().mean(0).sqrt()
    X = X / torch.where(size > 0, size, 1.0)
    for i in range(n_u):
        column = X.shape[1] - n_u + i
        if size[column] <= STILL * middle[column].abs():
            got = f"{log.inputs[i]} constant at {middle[column].item():.6g}"
            raise QPError.expected("action", got, "one that moves", EXCITE)
        target = X[:, column : column + 1]
        others = X.index_fill(1, torch.tensor(column), 0.0)
        rest = target - others @ torch.linalg.lstsq(others, target, driver="gelsd").solution
        if rest.square().mean().sqrt() <= STILL:
            of = "a linear function of the outputs and other actions, as in feedback"
            raise QPError.expected(
                "action", f"{log.inputs[i]} {of}", "one that moves by itself", EXCITE
            )


def _needed(layout: Layout) -> int:
    """Return the number of an ARX model's coefficients for an output, with the offset."""
    return layout.past * layout.n + layout.n_d + 1
