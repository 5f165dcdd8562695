"""Identification: C and b by least squares on logged trajectories.

The start is an ARX model with L lags, by ridge regression on one-step transitions,

    y_{k+1} = A_1 y_k + .. + A_L y_{k+1-L} + B_1 u_k + .. + B_L u_{k+1-L} + E d_k + offset,

which gives the banded C_0 (``structure="tied"``). The other structures correct its row blocks in
turn. From each start in the data, row block k predicts y_{k+1} from the *predicted* y_1, .., y_k;
its error is regressed on what the row block may read, again with a ridge:

* ``"free"``: on all that is known and u_0, .., u_k, which gives a multi-step predictor;
* ``"varying"``: on the band, which gives one ARX model for each stage.

So C keeps the gauge of the band, with -1 at y_{k+1}, and differs from C_0 only by the corrections.
Its predictions are as general as those of a regression of each y_{k+1} on (p, u_0, .., u_k), since
these determine the predicted y_1, .., y_k. But the ridge shrinks them to the ARX model's next step
from the corrected prediction, instead of to zero, and an exact ARX model is not corrected.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from torch_qpmpc.checks import check_choice, check_flag, check_number, check_whole
from torch_qpmpc.errors import QPError
from torch_qpmpc.mpc.banded import banded_matrix
from torch_qpmpc.mpc.layout import Layout
from torch_qpmpc.mpc.ridge import ridge
from torch_qpmpc.mpc.trajectories import Trajectory, folds, read_trajectories
from torch_qpmpc.mpc.validation import STRUCTURES

#: The largest number of parts of the data in cross-validation.
PARTS = 5
#: An action that the other regressors explain up to this share of its size does not excite.
STILL = 1e-6
EXCITE = "Add a random signal to the action, independent of the outputs."
SIZES = ("n_x", "n_u", "horizon", "past", "n_d")


class Model(NamedTuple):
    """An ARX model: A ``(n_x, L n_x)``, B ``(n_x, L n_u)``, E ``(n_x, n_d)``, offset ``(n_x,)``.

    A and B have the newest lag first.
    """

    A: Tensor
    B: Tensor
    E: Tensor
    offset: Tensor


class Constraints(NamedTuple):
    """``C z = b``: C ``(N n_x, n_z)`` and b ``(N n_x,)``."""

    C: Tensor
    b: Tensor


class Options(NamedTuple):
    """How to fit: the sizes of z, and the arguments of `identify`; None chooses each ridge."""

    layout: Layout
    structure: str = "free"
    causal: bool = True
    ridge: float | None = None


@dataclass(frozen=True, eq=False)
class Identified:
    """An ARX model, the constraints ``C z = b`` that start from it, and their prediction errors.

    ``print`` shows the errors, which are those of cross-validation: each is of a fit without the
    part of the data that it is in. They are NaN for steps that no part is long enough for, and if
    the other parts determine no model. Their root mean square is the standard deviation that a
    back-off from bounds needs.

    Attributes:
        model: the ARX model.
        constraints: C and b.
        options: how they were fitted.
        data: the trajectories.
    """

    model: Model
    constraints: Constraints
    options: Options
    data: Sequence[Trajectory]

    @property
    def arguments(self) -> dict[str, Any]:
        """The arguments of `QPMPC` that start it here: ``QPMPC(**identified.arguments, ..)``."""
        structure, start = self.options.structure, self.constraints._asdict()
        sizes = {name: getattr(self.options.layout, name) for name in SIZES}
        more = {} if structure == "tied" else {"start": start}
        return {**sizes, "structure": structure, **self.model._asdict(), **more}

    @cached_property
    def errors(self) -> Tensor:
        """y_{k+1} minus its prediction, ``(starts, N, n_x)``; NaN after a trajectory's end."""
        layout, causal = self.options.layout, self.options.causal
        total = sum(log.steps for log in self.data)
        count = max(min(PARTS, total // (2 * (layout.past + layout.horizon))), 2)
        parts = folds(self.data, count)
        errors = [torch.full((1, layout.horizon, layout.n_x), torch.nan, dtype=torch.float64)]
        for i, part in enumerate(parts):
            others = [log for j, other in enumerate(parts) if j != i for log in other]
            if _usable(others, layout) >= _needed(layout):
                found = fit(others, self.options)[1]
                errors.append(prediction_errors(part, found, layout, causal))
        return torch.cat(errors)

    @property
    def rmse(self) -> Tensor:
        """The root mean square of the errors after 1, .., N steps, ``(N, n_x)``."""
        return self.errors.square().nanmean(0).sqrt()

    @property
    def R2(self) -> Tensor:
        """The share of each output's variance that is predicted 1, .., N steps ahead."""
        outputs = torch.cat([log.y for log in self.data])
        return 1 - (self.rmse / outputs.std(0, correction=0)).square()

    @property
    def covariance(self) -> Tensor:
        """The covariance of the one-step errors, ``(n_x, n_x)``."""
        e = self.errors[:, 0]
        e = e[e.isfinite().all(-1)]
        return e.mT @ e / len(e)

    def __str__(self) -> str:
        layout, N = self.options.layout, self.options.layout.horizon
        total = sum(log.steps for log in self.data)
        lines = [
            f"{self.options.structure} C from {total} transitions in {len(self.data)} trajectories,"
            f" {', '.join(f'{name}={getattr(layout, name)}' for name in SIZES)}",
            f"{'steps':>6}  {'RMSE of each output, cross-validated':38}R2",
        ]
        for k in sorted({k for k in (1, 2, 5, 10, 20, 50, 100) if k < N} | {N}):
            errors = " ".join(f"{x:.3g}" for x in self.rmse[k - 1].tolist())
            lines.append(f"{k:6}  {errors:38}{' '.join(f'{x:.3f}' for x in self.R2[k - 1])}")
        return "\n".join(lines)


def identify(
    trajectories: Any,
    horizon: int,
    *,
    past: int = 1,
    n_d: int = 0,
    n_x: int | None = None,
    structure: str = "free",
    causal: bool = True,
    ridge: float | None = None,
) -> Identified:
    """Fit C and b to logged trajectories; see `torch_qpmpc.mpc.identification`.

    Args:
        trajectories: logged steps, ``(T,)`` or ``(episodes, T)``, with ``observation``, ``action``
            (as applied) and ``("next", "observation")``. Done flags and the ids of trajectories are
            respected.
        horizon: N.
        past: L, the number of lags.
        n_d: entries of d_k, the first of the entry ``preview``.
        n_x: the number of outputs, the last entries of ``observation``, which may be a window; all
            of them by default.
        structure: ``"tied"``: an ARX model. ``"varying"``: one for each stage, fitted to the
            predictions before it. ``"free"``: a multi-step predictor.
        causal: let row block k of a free C read d_0, .., d_k and u_0, .., u_k only.
        ridge: the weight of the squared coefficients, in units of the root mean squares of the
            regressors, relative to the mean squared error; by default each regression has the one
            of the largest evidence.

    Raises:
        QPError: an argument or an entry is invalid, the data are too short for ``past``, or the
            actions do not move enough to show their effect.

    Example:
        >>> import torch, torch_qpmpc as qm
        >>> from tensordict import TensorDict
        >>> u = 2 * torch.rand(50, 1, generator=torch.Generator().manual_seed(0)) - 1
        >>> y = torch.zeros(51, 1)
        >>> for t in range(50):
        ...     y[t + 1] = 0.9 * y[t] + 0.5 * u[t]
        >>> log = {"observation": y[:-1], "action": u, "next": {"observation": y[1:]}}
        >>> found = qm.identify(TensorDict(log, [50]), horizon=4)
        >>> [round(part.item(), 4) for part in found.model[:2]]
        [0.9, 0.5]
    """
    for name, size in (("horizon", horizon), ("past", past)):
        check_whole(name, size, 1)
    check_choice("structure", structure, STRUCTURES)
    check_flag("causal", causal)
    if ridge is not None:
        check_number("ridge", ridge, lambda x: 0 <= x < torch.inf, "a finite number >= 0, or None")
    data = read_trajectories(trajectories, n_x, n_d)
    layout = Layout(data[0].y.shape[-1], data[0].u.shape[-1], int(horizon), int(past), int(n_d))
    check_excitation(data, layout)
    options = Options(layout, structure, causal, ridge)
    return Identified(*fit(data, options), options, data)


def check_excitation(trajectories: Sequence[Trajectory], layout: Layout) -> None:
    """Raise `QPError` unless the data determine an ARX model.

    There must be more transitions than coefficients, and each action must move in a way that the
    other regressors do not explain.
    """
    past, needed = layout.past, _needed(layout)
    usable = _usable(trajectories, layout)
    if usable < needed:
        total = sum(log.steps for log in trajectories)
        got = f"{total} transitions in {len(trajectories)} trajectories"
        if past > 1:
            got += f", {usable} of them with {past - 1} before them"
        n_x, n_u, n_d = layout.n_x, layout.n_u, layout.n_d
        expected = f"at least {needed} such for past={past}, n_x={n_x}, n_u={n_u} and n_d={n_d}"
        remedy = f"Log trajectories of more than {past} steps, or lower past."
        raise QPError.expected("trajectories", got, expected, remedy)
    X, _ = transitions(trajectories, past)
    middle = X.mean(0)
    X, first = X - middle, past * layout.n_x
    size = X.square().mean(0).sqrt()
    X = X / torch.where(size > 0, size, 1.0)
    for i, column in enumerate(range(first, first + layout.n_u)):
        if size[column] <= STILL * middle[column].abs():
            got = f"entry {i} constant at {middle[column].item():.6g}"
            raise QPError.expected("action", got, "one that moves", EXCITE)
        target = X[:, column : column + 1]
        others = X.index_fill(1, torch.tensor(column), 0.0)
        rest = target - others @ torch.linalg.lstsq(others, target, driver="gelsd").solution
        if rest.square().mean().sqrt() <= STILL:
            got = f"entry {i} a linear function of the outputs and other actions, as in feedback"
            raise QPError.expected("action", got, "one that moves by itself, too", EXCITE)


def _needed(layout: Layout) -> int:
    """Return the number of an ARX model's coefficients for an output, with the offset."""
    return layout.past * layout.n + layout.n_d + 1


def _usable(trajectories: Sequence[Trajectory], layout: Layout) -> int:
    """Return the number of transitions that have a window before them."""
    return sum(max(log.steps - layout.past + 1, 0) for log in trajectories)


def arx(trajectories: Sequence[Trajectory], past: int, strength: float | None = None) -> Model:
    """Fit an ARX model with L = ``past`` lags by `ridge` regression of that ``strength``."""
    X, Y = transitions(trajectories, past)
    middle, mean = X.mean(0), Y.mean(0)
    W = ridge(X - middle, Y - mean, strength).mT
    n_x, n_u, n_d = (part.shape[-1] for part in trajectories[0])
    A, B, E = W.split((past * n_x, past * n_u, n_d), dim=-1)
    return Model(A, B, E, mean - W @ middle)


def fit(trajectories: Sequence[Trajectory], options: Options) -> tuple[Model, Constraints]:
    """Fit an ARX model, and correct its banded C and b as the structure allows.

    A row block with no more starts in the data than steps ahead is not corrected.
    """
    layout, structure, causal, strength = options
    N, n_x = layout.horizon, layout.n_x
    model = arx(trajectories, layout.past, strength)
    C = banded_matrix(model.A, model.B, N, model.E)
    b = -model.offset.repeat(N)
    if structure == "tied":
        return model, Constraints(C, b)
    Z = [windows(log, layout) for log in trajectories]
    measured = [z.clone() for z in Z]
    for k in range(N):
        rows, following = slice(k * n_x, (k + 1) * n_x), _output(layout, k + 1)
        last = k if causal or structure == "varying" else N - 1
        read = _band(layout, k) if structure == "varying" else _known(layout, last)
        predicted = [z.index_fill(1, following, 0.0) @ C[rows].mT - b[rows] for z in Z]
        # Starts whose windows end after the log are left out.
        inside = [max(len(z) - last, 0) for z in Z]
        if (k or last) and sum(inside) > last:
            X = torch.cat([z[:i, read] for z, i in zip(Z, inside, strict=True)])
            parts = zip(measured, predicted, inside, strict=True)
            Y = torch.cat([y[:i, following] - x[:i] for y, x, i in parts])
            middle, mean = X.mean(0), Y.mean(0)
            change = ridge(X - middle, Y - mean, strength).mT
            C[rows, read] += change
            b[rows] += change @ middle - mean
            predicted = [z.index_fill(1, following, 0.0) @ C[rows].mT - b[rows] for z in Z]
        for z, x in zip(Z, predicted, strict=True):
            z[:, following] = x
    return model, Constraints(C, b)


def predict(found: Constraints, Z: Tensor, layout: Layout) -> Tensor:
    """Predict y_1, .., y_N ``(*batch, N, n_x)`` from p and the actions in z ``(*batch, n_z)``."""
    following = torch.cat([_output(layout, k + 1) for k in range(layout.horizon)])
    Z = Z.index_fill(-1, following, 0.0)
    Y = torch.linalg.solve(found.C[:, following], (found.b - Z @ found.C.mT).mT).mT
    return Y.unflatten(-1, (layout.horizon, layout.n_x))


def prediction_errors(
    trajectories: Sequence[Trajectory], found: Constraints, layout: Layout, causal: bool = True
) -> Tensor:
    """Return y_{k+1} minus its prediction from each start, ``(starts, N, n_x)``.

    It is NaN for steps after the end of the trajectory; so are all steps if such a step is an
    argument of a prediction that is not ``causal``.
    """
    N = layout.horizon
    following = torch.stack([_output(layout, k + 1) for k in range(N)])
    parts = [torch.zeros(0, N, layout.n_x, dtype=torch.float64)]
    for log in trajectories:
        Z = windows(log, layout)
        needed = torch.arange(N) if causal else torch.full((N,), N - 1)
        over = torch.arange(len(Z)).unsqueeze(-1) + needed >= len(Z)
        error = Z[:, following] - predict(found, Z, layout)
        parts.append(error.masked_fill(over.unsqueeze(-1), torch.nan))
    return torch.cat(parts)


def windows(log: Trajectory, layout: Layout) -> Tensor:
    """Return z from each possible start, ``(T - L + 1, n_z)``, with zeros after the end."""
    length = layout.past + layout.horizon
    pairs = _padded(torch.cat((log.y, F.pad(log.u, (0, 0, 0, 1))), dim=-1), layout.horizon)
    preview = _padded(log.d, layout.horizon + 1)[layout.past - 1 :]
    stages = pairs.unfold(0, length, 1)[: max(log.steps - layout.past + 1, 0)].mT.flatten(1)
    preview = preview.unfold(0, layout.horizon + 1, 1)[: len(stages)].mT.flatten(1)
    return torch.cat((preview, stages[:, : stages.shape[1] - layout.n_u]), dim=-1)


def transitions(trajectories: Sequence[Trajectory], past: int) -> tuple[Tensor, Tensor]:
    """Return the regressors and targets of an ARX model: [y lags, u lags, d] and the next y."""
    X, Y = [], []
    for log in trajectories:
        if log.steps >= past:
            X.append(
                torch.cat((_lags(log.y[:-1], past), _lags(log.u, past), log.d[past - 1 :]), -1)
            )
            Y.append(log.y[past:])
    return torch.cat(X), torch.cat(Y)


def _lags(x: Tensor, count: int) -> Tensor:
    """Return the ``count`` rows up to each row, the newest first, ``(T - count + 1, count n)``."""
    return x.unfold(0, count, 1).flip(-1).mT.flatten(1)


def _padded(x: Tensor, rows: int) -> Tensor:
    return F.pad(x, (0, 0, 0, rows))


def _output(layout: Layout, k: int) -> Tensor:
    """Return the columns of y_k in z."""
    return layout.n_before + k * layout.n + torch.arange(layout.n_x)


def _band(layout: Layout, k: int) -> Tensor:
    """Return the columns of z in the band of row block k, without those of y_{k+1}."""
    window = layout.n_preview + k * layout.n + torch.arange(layout.reach)
    return torch.cat((k * layout.n_d + torch.arange(layout.n_d), window))


def _known(layout: Layout, last: int) -> Tensor:
    """Return the columns of z of d_0, .., d_last, the window and u_0, .., u_last."""
    actions = torch.arange(last + 1).unsqueeze(-1) * layout.n + torch.arange(layout.n_u)
    preview = torch.arange((last + 1) * layout.n_d)
    window = torch.arange(layout.n_preview, layout.n_p)
    return torch.cat((preview, window, layout.n_p + actions.flatten()))
