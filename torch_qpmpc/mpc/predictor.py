"""Linear predictors by least squares: C and b from trajectories.

The start is an ARX model with L lags, by ridge regression on one-step transitions,

    y_{k+1} = A_1 y_k + .. + A_L y_{k+1-L} + B_1 u_k + .. + B_L u_{k+1-L} + E d_k + offset,

which gives the banded C_0 (``structure="tied"``). The other structures correct its row blocks in
turn. From each start in the data, row block k predicts y_{k+1} from the *predicted* y_1, .., y_k;
its error is regressed on what the row block may read, again with a ridge:

* ``"free"``: on all that is known and u_0, .., u_k, which gives a multi-step predictor;
* ``"varying"``: on the band, which gives one ARX model for each stage.

So C keeps the gauge of the band, with -1 at y_{k+1}, and differs from C_0 only by the corrections.
Its predictions are as general as regressions of each y_{k+1} on (p, u_0, .., u_k), since
these determine the predicted y_1, .., y_k. But the ridge shrinks them to the ARX model's next step
from the corrected prediction, instead of to zero, and an exact ARX model is not corrected.

The ridge penalises changes of a signal's coefficients from each step to the next, as responses are
smooth. So it averages over noise where a ridge on the coefficients themselves lowers all of them,
and with them the predicted steady state.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from torch_qpmpc.mpc.banded import banded_matrix
from torch_qpmpc.mpc.layout import Layout
from torch_qpmpc.mpc.log import Trajectory
from torch_qpmpc.mpc.ridge import ridge

#: The correction of a prediction k steps ahead needs more than this many times k starts, because
#: the errors of fewer than k starts overlap.
SPANS = 3


class ARX(NamedTuple):
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


class Windows(NamedTuple):
    """z from each possible start in a log, ``(starts, n_z)``, with zeros after the end.

    ``ahead`` is the number of steps from there to the end of the trajectory, ``(starts,)``.
    """

    z: Tensor
    ahead: Tensor


#: Trajectories, or their windows.
Data = Sequence[Trajectory] | Windows


class Options(NamedTuple):
    """How to fit: the sizes of z, and the arguments of `identify`; None chooses each ridge."""

    layout: Layout
    structure: str = "free"
    causal: bool = True
    ridge: float | None = None
    held: tuple[int, ...] = ()


def arx(
    data: Data,
    layout: Layout,
    strength: float | None = None,
    held: tuple[int, ...] = (),
) -> ARX:
    """Fit an ARX model with as many lags as the window of ``layout``; see `ridge`.

    Outputs that are ``held`` keep their last value.
    """
    X, Y = transitions(data, layout)
    W, offset = _regression(X, Y, _differences(layout, known(layout, 0)), strength)
    E, window = W[:, : layout.n_d], W[:, layout.n_d :]
    pairs = window.unflatten(-1, (layout.past, layout.n)).flip(-2)
    A, B = (x.flatten(1) for x in pairs.split((layout.n_x, layout.n_u), dim=-1))
    kept = torch.tensor(held, dtype=torch.long)
    for part in (A, B, E, offset):
        part[kept] = 0.0
    A[kept, kept] = 1.0
    return ARX(A, B, E, offset)


def fit(data: Data, options: Options) -> tuple[ARX, Constraints]:
    """Fit an ARX model, and correct its banded C and b as the structure allows.

    A row block is not corrected if the data have too few starts.
    """
    layout, structure, causal, strength, held = options
    N, n_x = layout.horizon, layout.n_x
    measured, ahead = data = windows(data, layout)
    model = arx(data, layout, strength, held)
    C = banded_matrix(model.A, model.B, N, model.E)
    b = -model.offset.repeat(N)
    if structure == "tied":
        return model, Constraints(C, b)
    outputs = outputs_in(layout)
    Z = measured.index_fill(1, outputs.flatten(), 0.0)  # the predictions, one by one
    for k in range(N):
        rows = slice(k * n_x, (k + 1) * n_x)
        last = k if causal or structure == "varying" else N - 1
        read = _band(layout, k) if structure == "varying" else known(layout, last)
        inside = ahead > last  # starts whose windows end after the log are left out
        X = Z[inside]
        if (k or last) and len(X) > SPANS * last:
            Y = measured[inside][:, outputs[k]] - X @ C[rows].mT + b[rows]
            Y[:, torch.tensor(held, dtype=torch.long)] = 0.0
            change, shift = _regression(X[:, read], Y, _differences(layout, read), strength)
            C[rows, read] += change
            b[rows] -= shift
        Z[:, outputs[k]] = Z @ C[rows].mT - b[rows]
    return model, Constraints(C, b)


def predict(constraints: Constraints, Z: Tensor, layout: Layout) -> Tensor:
    """Predict y_1, .., y_N ``(*batch, N, n_x)`` from p and the actions in z ``(*batch, n_z)``."""
    outputs = outputs_in(layout).flatten()
    Z = Z.index_fill(-1, outputs, 0.0)
    Y = torch.linalg.solve(constraints.C[:, outputs], (constraints.b - Z @ constraints.C.mT).mT).mT
    return Y.unflatten(-1, (layout.horizon, layout.n_x))


def prediction_errors(
    data: Data, constraints: Constraints, layout: Layout, causal: bool = True
) -> Tensor:
    """Return y_{k+1} minus its prediction from each start, ``(starts, N, n_x)``.

    It is NaN for steps after the end of the trajectory. If the predictions are not ``causal``,
    those from a start are all NaN if one of their actions is after the end.
    """
    N = layout.horizon
    needed = torch.arange(N) if causal else torch.full((N,), N - 1)
    Z, ahead = windows(data, layout)
    error = Z[:, outputs_in(layout)] - predict(constraints, Z, layout)
    over = needed >= ahead.unsqueeze(-1)
    return error.masked_fill(over.unsqueeze(-1), torch.nan)


def windows(data: Data, layout: Layout) -> Windows:
    """Return the windows of trajectories, all at once."""
    if isinstance(data, Windows):
        return data
    past, horizon = layout.past, layout.horizon
    y, u, d = map(torch.cat, zip(*data, strict=True))
    steps = torch.tensor([log.steps for log in data])
    # One table of all rows; those of a trajectory's last outputs have neither action nor signals.
    last = (steps + 1).cumsum(0) - 1
    moves = torch.ones(len(y), dtype=torch.bool).index_fill(0, last, False)
    rows = y.new_zeros(len(y), layout.n_d + layout.n)
    rows[:, layout.n_d : layout.n_d + layout.n_x] = y
    rows[moves, : layout.n_d], rows[moves, layout.n_d + layout.n_x :] = d, u
    ends = last.repeat_interleave(steps + 1)
    ahead = ends - torch.arange(len(y)) - past + 1
    starts = (ahead > 0).nonzero()
    index = starts + torch.arange(past + horizon)
    inside = index <= ends[starts]
    Z = rows[index.clamp(max=len(y) - 1)] * inside.unsqueeze(-1)
    preview, stages = Z[:, past - 1 :, : layout.n_d], Z[..., layout.n_d :].flatten(1)
    Z = torch.cat((preview.flatten(1), stages[:, : stages.shape[1] - layout.n_u]), dim=-1)
    return Windows(Z, ahead[starts[:, 0]])


def outputs_in(layout: Layout) -> Tensor:
    """Return the columns of y_1, .., y_N in z, ``(N, n_x)``."""
    first = layout.n_before + layout.n * torch.arange(1, layout.horizon + 1)
    return first.unsqueeze(-1) + torch.arange(layout.n_x)


def transitions(data: Data, layout: Layout) -> tuple[Tensor, Tensor]:
    """Return the regressors and targets of an ARX model: the columns `known` of z, and y_1."""
    if not isinstance(data, Windows):
        layout = replace(layout, horizon=1)
    Z, _ = windows(data, layout)
    return Z[:, known(layout, 0)], Z[:, outputs_in(layout)[0]]


def known(layout: Layout, last: int) -> Tensor:
    """Return the columns of z of d_0, .., d_last, the window and u_0, .., u_last."""
    actions = torch.arange(last + 1).unsqueeze(-1) * layout.n + torch.arange(layout.n_u)
    preview = torch.arange((last + 1) * layout.n_d)
    window = torch.arange(layout.n_preview, layout.n_p)
    return torch.cat((preview, window, layout.n_p + actions.flatten()))


def _band(layout: Layout, k: int) -> Tensor:
    """Return the columns of z in the band of row block k, without y_{k+1}."""
    window = layout.n_preview + k * layout.n + torch.arange(layout.reach)
    return torch.cat((k * layout.n_d + torch.arange(layout.n_d), window))


def _regression(
    X: Tensor, Y: Tensor, differences: Tensor, strength: float | None
) -> tuple[Tensor, Tensor]:
    """Return W and an offset of Y ~ X W' + offset, with a ridge on the differences in W."""
    middle, mean = X.mean(0), Y.mean(0)
    W = (differences @ ridge((X - middle) @ differences, Y - mean, strength)).mT
    return W, mean - W @ middle


def _differences(layout: Layout, read: Tensor) -> Tensor:
    """Return the matrix from changes of coefficients to the coefficients of columns of z.

    A coefficient is the sum of its signal's changes up to its step.
    """
    n, steps = layout.n, torch.arange(1 - layout.past, layout.horizon + 1)
    size = layout.n_z - layout.n_preview
    time = torch.cat(
        (
            torch.arange(layout.horizon + 1).repeat_interleave(layout.n_d),
            steps.repeat_interleave(n)[:size],
        )
    )[read]
    signal = torch.cat(
        (
            -1 - torch.arange(layout.n_d).repeat(layout.horizon + 1),
            torch.arange(n).repeat(len(steps))[:size],
        )
    )[read]
    earlier = time.unsqueeze(-1) >= time
    return ((signal.unsqueeze(-1) == signal) & earlier).to(torch.float64)
