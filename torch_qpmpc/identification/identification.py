"""Identification of a linear model with its noise from logged trajectories, and its errors.

`torch_qpmpc.identification.subspace` has the mathematics.
"""

import warnings
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torch_qpmpc.checks import check_whole, class_name, ungraded
from torch_qpmpc.errors import QPError
from torch_qpmpc.identification.innovations import Innovations
from torch_qpmpc.identification.log import STILL, Log
from torch_qpmpc.identification.reading import as_log
from torch_qpmpc.identification.subspace import (
    Fit,
    continued,
    equal_candidates,
    explained_by_inputs,
    fit_state_space,
    held_out_errors,
    late_inputs,
    visited,
    whiteness,
)

#: The covariance of a simulation's start, relative to that of the log's states.
ELSEWHERE = 10.0
#: The share of the residuals' variance that the inputs of the same rows may explain.
LATE = 0.1
EXCITE = "Add a random signal to the action, independent of the outputs."


@dataclass(frozen=True, eq=False)
class Identified:
    """A linear state-space model in innovations form, and its prediction errors.

    ``print`` shows the cross-validated errors: each belongs to a fit of the same order that has not
    seen its part of the data. They are NaN where the filter settles, and after an end.

    Attributes:
        model: the model, whose first states are the filtered outputs. If it has an order, its last
            states are slow disturbances, which the model of ``fit`` has not.
        log: the trajectories, with the names of their signals.
        horizon: the number of steps of the predictions, N.
        fit: how the model was chosen.
    """

    model: Innovations
    log: Log
    horizon: int
    fit: Fit

    @property
    def arguments(self) -> dict[str, Any]:
        """The arguments of `QPMPC.of` for the model: ``QPMPC.of(**identified.arguments, ..)``.

        Its state is the estimate by a `torch_qpmpc.envs.KalmanFilter` of ``model``.
        """
        return {**model_arguments(self.model), "horizon": self.horizon}

    @cached_property
    def errors(self) -> Tensor:
        """y_{k+1}, .. minus their predictions at k, ``(steps, N, n_y)``; NaN after an end.

        They are NaN in the first steps of each trajectory, too, in which the filter settles.
        """
        parts = [part.disturbed() for part in self.fit.parts]
        errors = held_out_errors(self.log.trajectories, parts, self.horizon)
        return torch.as_tensor(errors)

    @property
    def rmse(self) -> Tensor:
        """The root mean square of the errors after 1, .., N steps, ``(N, n_y)``."""
        return self.errors.square().nanmean(0).sqrt()

    @property
    def R2(self) -> Tensor:
        """The share of each output's variance that is predicted 1, .., N steps ahead."""
        outputs = torch.cat([log.y for log in self.log.trajectories]).numpy()
        return 1 - (self.rmse / torch.as_tensor(np.nanstd(outputs, 0))).square()

    def simulate(self, u: Any, y: Any, d: Any = None) -> Tensor:
        """Return the outputs of fit's model alone, without corrections by measurements.

        Args:
            u: actions ``(T, n_u)``.
            y: the first outputs, from which the state is estimated, ``(steps, n_y)``: it may be
                anywhere in the log's range, and NaN is missing.
            d: known signals ``(T, n_d)``, if the model has any.

        Returns:
            y_0, .., y_T, ``(T + 1, n_y)``; the first ones are ``y``.

        Raises:
            QPError: a shape does not match the model.
        """
        model, arrays = self.fit.model, []
        for name, x in {"u": u, "y": y, "d": d}.items():
            given = ungraded(name, x)
            try:
                arrays.append(np.asarray(given, dtype=float))
            except (TypeError, ValueError) as error:
                raise QPError.expected(name, class_name(x), "an array of numbers") from error
        u, y, steps = *arrays[:2], len(arrays[0]) if arrays[0].ndim else 0
        d = np.zeros((steps, 0)) if d is None else arrays[2]
        first, n_y = min(len(y) if y.ndim else 0, steps + 1), len(model.C)
        sizes = {"u": (steps, model.B.shape[1]), "y": (max(first, 1), n_y)}
        sizes["d"] = steps, model.E.shape[1]
        for value, (name, shape) in zip((u, y, d), sizes.items(), strict=True):
            if value.shape != shape:
                raise QPError.expected(name, f"shape {value.shape}", f"{shape}")
        mean, cov = visited(model, self.log.trajectories)
        seen = np.vstack((y, np.full((steps + 1 - first, n_y), np.nan)))
        x = model._replace(x0=mean, P0=ELSEWHERE * cov).estimates(seen, u, d)
        return torch.as_tensor(np.vstack((y, x[first:] @ model.C.T)))

    def __str__(self) -> str:
        log, N = self.log, self.horizon
        poles = ", ".join(f"{abs(pole):.3g}" for pole in self.fit.model.poles)
        white = ", ".join(f"{share:.0%}" for share in whiteness(self.model, log.trajectories))
        n = {row.order for row in equal_candidates(self.fit.candidates)} or {0}
        drifts = f", of which no input moves {self.fit.drifts}" * bool(self.fit.drifts)
        equal = f"; orders {min(n)} to {max(n)} are as good within their error" * (len(n) > 1)
        lines = [
            str(log),
            f"Model of order {len(self.fit.model.A)} with poles of sizes {poles}{drifts}{equal}",
            f"Autocorrelations of the residuals in their 95 % bound: {white}",
        ]
        shares = explained_by_inputs(self.model, log.trajectories)
        if shares.max() > LATE:
            output = log.label(log.outputs[int(shares.argmax())])
            lines.append(
                f"The inputs of a row explain {shares.max():.0%} of the residuals of its {output}. "
                "Unless a controller chose them, they acted before the outputs: move them up a row."
                " If one did, only the rest shows their effect: near 100%, add a random signal."
            )
        rows = [("RMSE of " + ", ".join(map(log.label, log.outputs)), "R2, cross-validated")]
        longest = min(N, max(part.steps for part in log.trajectories))  # single steps have one
        steps = sorted({k for k in (1, 2, 5, 10, 20, 50, 100) if k < longest} | {longest})
        rmse, R2 = self.rmse, self.R2
        for k in steps:
            errors = " ".join(f"{x:.3g}" for x in rmse[k - 1].tolist())
            rows.append((errors, " ".join(f"{x:.3f}" for x in R2[k - 1].tolist())))
        width = max(38, *(len(errors) + 2 for errors, _ in rows))
        lines += [
            f"{k:>6}  {errors:{width}}{R2}"
            for k, (errors, R2) in zip(("steps", *steps), rows, strict=True)
        ]
        return "\n".join(lines)


def identify(
    trajectories: Any,
    horizon: int = 20,
    *,
    order: int | None = None,
    n_d: int | None = None,
    n_x: int | None = None,
) -> Identified:
    """Fit a linear state-space model with its noise to logged trajectories.

    Slow modes that the inputs are not shown to move are drifts: no input moves them.

    Args:
        trajectories: a `Log`, or what `read_log` takes; or logged steps, ``(T,)`` or ``(episodes,
            T)``, in a TensorDict with ``observation``, ``action`` (as applied) and ``("next",
            "observation")``. Done flags and the ids of trajectories are respected. A list or lazy
            stack of logs may have different lengths.
        horizon: N, the number of steps of the predictions that are reported.
        order: the number of states but disturbances, at most what the log shows; by default chosen
            by held-out errors. Warnings tell of none or longer dead times. 0: the outputs alone.
        n_d: entries of d_k: by default the known signals of a `Log`, and 0 in a TensorDict, where
            they are the first of the entry ``preview``.
        n_x: the number of outputs, the last entries of ``observation``; all of them by default.

    Raises:
        QPError: an argument or an entry is invalid, the data are too short, or the actions do not
            move enough to show their effect.

    Example:
        >>> import numpy as np, torch_qpmpc as qm
        >>> u, y = np.random.default_rng(0).uniform(-1, 1, 50), np.zeros(51)
        >>> for t in range(50):
        ...     y[t + 1] = 0.9 * y[t] + 0.5 * u[t]
        >>> model = qm.identify({"y": y, "u": u}).model
        >>> model.A.round(4), model.B.round(4)
        (array([[0.9]]), array([[0.5]]))
    """
    check_whole("horizon", horizon, 1)
    if order is not None:
        check_whole("order", order, 0)
    log = as_log(trajectories, n_x, n_d)
    check_excitation(log)
    fit = fit_state_space(log.trajectories, order)
    if order is None and (late := late_inputs(fit, log.trajectories)).any():
        names = [(log.outputs[i], log.inputs[j], late[i, j]) for i, j in np.argwhere(late)]
        text = ", ".join(f"{y} follows {u} {rows} rows late" for y, u, rows in names)
        advice = f"If these are dead times, pass order={fit.order + late.max(0).sum()}."
        warnings.warn(f"{text}: a model of order {fit.order} ends before. {advice}", stacklevel=2)
    if order and not fit.order:
        warnings.warn(f"order: {log.steps} steps show no states but the outputs", stacklevel=2)
    return Identified(fit.model.disturbed(), log, int(horizon), fit)


def measured_model(
    trajectories: Any, n_x: int | None = None, n_d: int | None = None
) -> tuple[Innovations, Log]:
    """Fit the model whose states are the outputs, and return it with the log; see `identify`."""
    log = as_log(trajectories, n_x, n_d)
    check_excitation(log)
    return fit_state_space(log.trajectories, 0, 0).model, log


def model_arguments(model: Innovations) -> dict[str, Any]:
    """Return the sizes and matrices of a model as arguments of `QPMPC.of`."""
    sizes = {"n_x": len(model.A), "n_u": model.B.shape[1], "n_d": model.E.shape[1]}
    return sizes | {name: torch.tensor(getattr(model, name)) for name in ("A", "B", "E", "offset")}


def check_excitation(log: Log) -> None:
    """Raise `QPError` unless the data determine a model whose states are the outputs.

    There must be more transitions than coefficients, and each action must move in a way that the
    other regressors do not explain.
    """
    n_x, n_u, n_d = len(log.outputs), len(log.inputs), len(log.known)
    needed, trajectories = n_x + n_u + n_d + 1, log.trajectories
    if log.steps <= needed:
        parts = "1 trajectory" if len(trajectories) == 1 else f"{len(trajectories)} trajectories"
        got = f"{log.steps} transitions in {parts}"
        expected = f"at least {needed + 1} for n_x={n_x}, n_u={n_u} and n_d={n_d}"
        remedy = "Log more: the error of as many transitions as coefficients says nothing."
        raise QPError.expected("trajectories", got, expected, remedy)
    u = torch.cat([log.u for log in trajectories])
    if n_u > 1 and ((u == 0) | (u == 1)).all() and (u.sum(-1) == 1).all():
        raise QPError.expected("action", "one-hot vectors of discrete ones", "continuous actions")
    X = np.concatenate([np.hstack((x.d, continued(x.y.numpy())[:-1], x.u)) for x in trajectories])
    middle, size = X.mean(0), X.std(0)
    X = (X - middle) / np.where(size > 0, size, 1.0)
    for i, name in enumerate(log.inputs):
        column = X.shape[1] - n_u + i
        if size[column] <= STILL * abs(middle[column]):
            got = f"{name} constant at {middle[column]:.6g}"
            raise QPError.expected("action", got, "one that moves", EXCITE)
        target, others = X[:, column], np.delete(X, column, 1)
        rest = target - others @ np.linalg.lstsq(others, target, rcond=None)[0]
        if np.sqrt((rest**2).mean()) <= STILL:
            got = f"{name} a linear function of the outputs and other actions, as in feedback"
            raise QPError.expected("action", got, "one that moves by itself", EXCITE)
