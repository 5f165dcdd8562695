"""Identification of a state-space model with its noise: a subspace start and maximum likelihood.

The start is an ARX model with p lags, by ridge regression, and its reduction: the singular vectors
of its predictions over twenty steps are the states, whose model is that of least squares (PBSID,
Chiuso 2007, takes predictions of one step). Expectation maximisation (Shumway and Stoffer 1982)
then raises the likelihood of

    x_{k+1} = A x_k + B u_k + E d_k + offset + w_k,   y_k = C x_k + v_k,   cov w = Q, cov v = R,

and of the distribution of x_0. Noise that has one source in w and v, or is delayed, takes more
states. Signals are normalised, so that units decide nothing.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy  # imports its parts at their first use: a fifth of a second
import torch
from numpy.lib.stride_tricks import sliding_window_view

from torch_qpmpc.errors import QPError
from torch_qpmpc.identification.filter import Array, grouped
from torch_qpmpc.identification.innovations import Innovations
from torch_qpmpc.identification.likelihood import (
    Noisy,
    Signals,
    em,
    lasting,
    starting,
    steady,
    with_drifts,
)
from torch_qpmpc.identification.log import Trajectory, runs
from torch_qpmpc.identification.ridge import ridge

#: Iterations of expectation maximisation, of a candidate and of the fit; further ones, their growth
#: and the least gain of a row by them: less is often noise that varies, not a better model.
FEW, SOME, MANY, GROWTH, GAIN = 5, 10, 200, 1.2, 0.1
#: Directions of the states, of unit variance, that the outputs show less than this are kept as
#: states of their own.
HIDDEN = 1e-2
#: Candidates, as far as the data allow; 0 states are the outputs alone.
ORDERS, LAGS = (1, 2, 3, 4, 5, 6, 8, 10, 12, 16, 20), (2, 5, 10, 20, 40)
#: Cross-validation leaves out every PARTS-th block of a log. Longer trajectories are cut into
#: blocks of LONG steps, or fewer so that there are BLOCKS, but no shorter than SHORT.
PARTS, BLOCKS, LONG, SHORT = 4, 12, 200, 10
#: Steps of the predictions that decide.
HORIZONS = np.array([1, 2, 5, 10, 20])
#: Gaps of so many rows are filled for the starts of the fits.
FILLED = 20
#: First steps of a trajectory in which its filter settles, at most a quarter: they decide nothing.
SETTLING = 20
#: Squared errors that differ by less than the share MARGIN, in the geometric mean, are equal, and
#: so are those that differ by less than ERRORS standard errors and the share MOST. Errors below
#: EXACT, as a share of the variance, are none.
MARGIN, ERRORS, MOST, EXACT = 0.004, 2.0, 0.1, 1e-8
#: Drifts may raise squared errors far ahead, which inputs of chance lower, by the share WORSE; in
#: place of a `lasting` mode also by ERRORS standard errors: those of a horizon are as one.
WORSE = 0.2
#: Errors of a model that diverges, in standard deviations.
WORST = 1e6
#: Outputs may be unmoved if this share of their measurements repeats the last one; the number of
#: past inputs in the test, and its level.
CONSTANT, LAST, LEVEL, TINY = 0.5, 10, 0.01, 1e-300
#: So many orders, whose starts have the least errors, are compared by their likeliest models; more,
#: then with other lags, while the rows of their logs together are at most ROWS.
REFINED, ROWS = 2, 10_000
#: Autocorrelations of the residuals in the test of whiteness. An input acts late, by at most LATEST
#: rows, if its correlation with them is SURE standard errors and its square SEEN.
CORRELATIONS, LATEST, SURE, SEEN = 20, 100, 5.0, 0.02


class Candidate(NamedTuple):
    """An order and lags, and the mean logarithm of held-out squared errors of unit variances.

    ``error`` is the standard error of the score's distance to the least one.
    """

    order: int
    lags: int
    score: float
    error: float = 0.0


class Fit(NamedTuple):
    """An identified model, and how it was chosen."""

    model: Innovations  # the model
    #: As in `fit_state_space`.
    order: int
    lags: int
    candidates: tuple[Candidate, ...] = ()  # those that were compared
    #: Models that have not seen the outputs of a part of the log each.
    parts: tuple[Innovations, ...] = ()
    drifts: int = 0  # the number of modes that no input moves
    #: The model without these, whose E has the columns of known signals and of the drifts w, and
    #: C_w ``(n_y, n_w)``, so that y = C x + C_w w; w changes by one in the root mean square of the
    #: steps. None without drifts, or with outputs that no input moves.
    plant: tuple[Innovations, Array] | None = None


def fit_state_space(
    trajectories: Sequence[Trajectory], order: int | None = None, lags: int | None = None
) -> Fit:
    """Fit an innovations form to a log, whose first states are the outputs.

    Order and lags have the least multi-step errors in blocks of the log whose outputs a fit has not
    seen, while the filter has; of orders as good within the error of their score, the smallest. An
    output that is NaN is missing.

    Args:
        trajectories: the log.
        order: states of the likelihood's model; 0 for the outputs alone, each measured exactly.
            The innovations form has more if the outputs are not independent functions of them.
        lags: lags of the ARX model of the start; with an ``order`` only.
    """
    normal = _Normal(trajectories)
    data = normal.apply(trajectories)
    filled, rows, parts = _filled(data), [], []
    if lags is None:
        found = _compare(data, filled, trajectories, ORDERS if order is None else (order,))
        rows = [row for row, _ in found]
        best = equal_candidates(rows)[0]
        order, lags = best.order, best.lags
        parts = [readable(x, data) if order else x for x in found[rows.index(best)][1]]
    model, drifts = measured(data, filled), 0
    if order:
        par = em(_states(_predictor(filled, lags, order), order), data, SOME)
        likely, held = em(par, data, MANY, GROWTH, GAIN), _Held(trajectories)

        def far(one: Noisy) -> float:  # the score of predictions over the last horizon
            sums = _sums([steady(one)] * PARTS, data, held).sum(1)
            return _score(*sums[:, np.flatnonzero(sums[1].any(1))[-1:]])

        par = min((likely, par), key=far) if likely is not par else par
        drifting, count = with_drifts(par, data)
        chance = ERRORS * lasting(par.A) * np.sqrt(HORIZONS[-1] / sum(len(v) for _, v in data))
        if count and far(drifting) <= far(par) + WORSE + chance:
            par, drifts = drifting, count
        model = readable(steady(par), data)
    plant = None
    if order and 0 < drifts < order and not normal.apart.any():
        own, C_w = _without_drifts(par, drifts, data)
        plant = normal.restore(own), normal.y_size[:, None] * C_w
    model, *parts = map(normal.restore, (model, *parts))
    return Fit(model, order or 0, lags, tuple(rows), tuple(parts), drifts, plant)


def _without_drifts(par: Noisy, drifts: int, data: Sequence[Signals]) -> tuple[Innovations, Array]:
    """Return `Fit.plant` of a model whose last states are drifts, their means as offsets."""
    A, B, C, Q, R, m0, P0 = par
    n, model = len(A) - drifts, steady(par)
    level = np.concatenate(each(model, data, model.estimates))[:, n:].mean(0)
    shift = np.linalg.pinv(C[:, :n]) @ C[:, n:] @ level
    B = B[:n].copy()
    B[:, -1] += A[:n, n:] @ level + shift - A[:n, :n] @ shift
    own = Noisy(A[:n, :n], B, C[:, :n], Q[:n, :n], R, m0[:n] + shift, P0[:n, :n])
    change = np.linalg.cholesky(Q[n:, n:])
    return readable(steady(own), data, A[:n, n:] @ change), C[:, n:] @ change


def held_out_errors(
    trajectories: Sequence[Trajectory], parts: Sequence[Innovations], horizon: int
) -> Array:
    """Return errors ``(steps, horizon, n_y)`` of models that have not seen a part's outputs each.

    The filter knows the outputs before. Errors of the steps in which it settles are NaN.
    """
    held, steps = _Held(trajectories), np.arange(1, horizon + 1)
    errors = held.errors(parts, signals(trajectories), steps)
    return np.delete(errors, np.cumsum([one.steps + 1 for one in trajectories]) - 1, 0)


def whiteness(model: Innovations, trajectories: Sequence[Trajectory]) -> Array:
    """Return the share of autocorrelations in the 95 % bound of white residuals, ``(n_y,)``."""
    z = _correlations(model, trajectories, CORRELATIONS)
    return np.mean(np.abs(np.diagonal(z, 0, 1, 2)[:, : len(model.C)]) <= 1.96, 0)


def late_inputs(fit: Fit, trajectories: Sequence[Trajectory]) -> Array:
    """Return the most rows late that inputs act, ``(n_y, n_u)``; 0 within the order's reach."""
    steps, n_y = sum(one.steps for one in trajectories), len(fit.model.C)
    last = max(min(LATEST, steps // len(trajectories) // 2), fit.order + 1)
    both = np.abs(_correlations(fit.model, trajectories, last, LATEST))[fit.order :]
    z, future = both[:, :n_y, n_y:], both[:, n_y:, :n_y].max(0).T  # periodic inputs have both
    _, size = _scale(np.concatenate([one.y.numpy() for one in trajectories]))
    z[:, np.diag(fit.model.S) < 100 * EXACT * size**2] = 0.0
    least = np.maximum(2 * future, max(SURE, np.sqrt(SEEN * steps)))
    return (z.max(0) > least) * (fit.order + 1 + z.argmax(0))


def _correlations(
    model: Innovations, trajectories: Sequence[Trajectory], last: int, settling: int = 0
) -> Array:
    """Return correlations of residuals and inputs with those 1, .., ``last`` rows before.

    They are in standard errors, ``(last, n_y + n_u, n_y + n_u)``, without the ``settling`` rows.
    """
    z, errors = [], _errors(model, signals(trajectories), 1)
    data = [np.hstack((e[:, 0], x.u.numpy())) for e, x in zip(errors, trajectories, strict=True)]
    data = [rows[min(settling, len(rows) // 4) :] for rows in data]
    mean = np.nanmean(np.concatenate(data), 0)
    data = [np.nan_to_num(rows - mean) for rows in data]  # what is missing adds nothing
    for lag in range(1, last + 1):
        after = np.concatenate([rows[lag:] for rows in data])
        before = np.concatenate([rows[: max(len(rows) - lag, 0)] for rows in data])
        squares = (after**2).T @ before**2  # past and future ones are as sure: no end decides
        size = np.sqrt(np.maximum(squares, squares.T))
        z.append(after.T @ before / np.where(size > 0, size, 1.0))
    return np.array(z)


def explained_by_inputs(model: Innovations, trajectories: Sequence[Trajectory]) -> Array:
    """Return the share of residuals' variance that inputs of the same rows explain, ``(n_y,)``.

    What the row before and the prediction say of both is taken off: a share above zero is feedback,
    or an input that is logged a row late.
    """
    n_y, n_u, parts = len(model.C), model.B.shape[1], []
    for errors, one in zip(_errors(model, signals(trajectories), 1), trajectories, strict=True):
        (y, u, _), e = (x.numpy() for x in one), errors[:-1, 0]
        parts.append(np.hstack((e, u[1:], u[:-1], y[:-2], y[1:-1] - e)))
    rows = np.concatenate(parts)
    rows = rows[np.isfinite(rows).all(1)]
    if (free := len(rows) - rows.shape[1] + n_y - 1) <= 0:  # as of trajectories of single steps
        return np.zeros(n_y)
    (mean, unit), every = _scale(rows), np.concatenate([one.y.numpy() for one in trajectories])
    now, past = np.split((rows - mean) / unit, [n_y + n_u], 1)
    e, u = np.split(now - past @ np.linalg.lstsq(past, now, rcond=None)[0], [n_y], 1)
    left = e - u @ np.linalg.lstsq(u, e, rcond=None)[0]
    before, after = (e**2).sum(0) / (free + n_u), (left**2).sum(0) / free
    noisy = before > (EXACT * np.nanmax(np.abs(every), 0) / unit[:n_y]) ** 2
    return np.where(noisy, 1 - after / np.where(noisy, before, 1.0), 0.0)


def visited(model: Innovations, trajectories: Sequence[Trajectory]) -> tuple[Array, Array]:
    """Return mean ``(n,)`` and covariance ``(n, n)`` of the log's states before their outputs."""

    def before(y: Array, *v: Array) -> Array:
        return model.estimates(y, *v)[:, :-1] @ model.A.T + model.inputs(*v)

    x = np.concatenate(each(model, signals(trajectories), before))
    return x.mean(0), np.cov(x.T, bias=True).reshape(len(model.A), -1)


def signals(trajectories: Sequence[Trajectory]) -> list[Signals]:
    """Return the outputs, and the inputs with the known signals, of each trajectory."""
    return [Signals(x.y.numpy(), np.hstack((x.u.numpy(), x.d.numpy()))) for x in trajectories]


def _errors(model: Innovations, data: Sequence[Signals], horizon: int) -> list[Array]:
    """Return multi-step errors ``(T, horizon, n_y)`` of each trajectory."""
    return each(model, data, lambda y, u, d: model.errors(y, u, d, horizon))


def each(model: Innovations, data: Sequence[Signals], of: Callable) -> list[Any]:
    """Return what ``of`` says of each trajectory's y, u and d; it takes those of equal length."""
    found: dict[int, Any] = {}
    for places in grouped(len(one.v) for one in data):
        y, v = map(np.stack, zip(*(data[i] for i in places), strict=True))
        found |= zip(places, of(y, *np.split(v, [model.B.shape[1]], -1)), strict=True)
    return [found[i] for i in range(len(data))]


# The choice


class _Held:
    """The blocks of a log whose outputs are left out of a fit, in turn."""

    def __init__(self, trajectories: Sequence[Trajectory]) -> None:
        steps = [one.steps for one in trajectories]
        length = max(min(max(sum(steps) // BLOCKS, SHORT), LONG, sum(steps) // 2), 1)
        self.rows: list[Array] = []
        self.count = 0
        for T in steps:
            cuts = max(round(T / length), 1)
            self.rows.append(self.count + np.arange(T + 1) * cuts // (T + 1))
            self.count += cuts

    def out(self, part: int, data: Sequence[Signals]) -> list[Signals]:
        """Return normalised trajectories without the outputs of the part's blocks."""
        masks = (rows % PARTS == part for rows in self.rows)
        pairs = [(one, mask) for one, mask in zip(data, masks, strict=True) if not mask.all()]
        return [one._replace(y=np.where(mask[:, None], np.nan, one.y)) for one, mask in pairs]

    def targets(self, steps: Array) -> Array:
        """Return the blocks of the targets so many steps after each row, -1 for none."""
        found = []
        for rows in self.rows:
            T = len(rows) - 1
            target = np.arange(T + 1)[:, None] + steps
            found.append(np.where(target <= T, rows[np.minimum(target, T)], -1))
            found[-1][: min(SETTLING, T // 4)] = -1
        return np.concatenate(found)

    def errors(self, models: Sequence[Innovations], data: Sequence[Signals], steps: Array) -> Array:
        """Return the errors of predictions of the `targets`, NaN without one."""
        block = self.targets(steps)
        total = np.full((*block.shape, data[0].y.shape[1]), np.nan)
        for part, model in enumerate(models):
            own, mask = _errors(model, data, max(steps)), (block >= 0) & (block % PARTS == part)
            errors = np.concatenate([np.pad(e, ((0, 1), (0, 0), (0, 0))) for e in own])
            total[mask] = errors[:, steps - 1][mask]
        return total


def _feasible(starts: Sequence[Sequence[Signals]], longest: int) -> tuple[int, ...]:
    """Return the lags, also ``longest``, whose windows are in at least half of the steps."""
    found = {*LAGS, max(*LAGS, longest)}
    for data in starts:
        steps, width = np.array([len(v) for _, v in data]), sum(x.shape[1] for x in data[0])
        least = max(steps.sum() / 2, 2 * width)
        found = {p for p in found if (steps - p).clip(0).sum() >= least}
    return tuple(sorted(found))[-3:]


@np.errstate(over="ignore", invalid="ignore")  # of candidates that diverge
def _compare(
    data: Sequence[Signals],
    filled: Sequence[Signals],
    trajectories: Sequence[Trajectory],
    orders: Sequence[int],
) -> list[tuple[Candidate, list[Innovations]]]:
    """Return the candidates and their models, each fitted without a part of the log.

    The starts of all orders and lags are compared, and the likeliest models of the best of them.
    """
    held = _Held(trajectories)
    folds, bases = ([held.out(part, x) for part in range(PARTS)] for x in (data, filled))

    def judged(found: dict[tuple[int, int], list[Innovations]]) -> list[Candidate]:
        sums = [_sums(models, data, held) for models in found.values()]
        scores = np.array([_score(*parts.sum(1)) for parts in sums])
        used = np.flatnonzero(sums[0][1].any((1, 2)))
        # The jackknife over the blocks gives the errors of the scores' distances.
        left = np.array([[_score(*(x.sum(1) - x[:, b])) for b in used] for x in sums])
        errors = np.sqrt((len(used) - 1) * (left - left[scores.argmin()]).var(1))
        return [*map(Candidate, *zip(*found, strict=True), scores.tolist(), errors.tolist())]

    found = {(0, 0): [*map(measured, folds, bases)]}
    pars, feasible = {}, _feasible([_runs(base) for base in bases], max(orders))
    if len(orders) == 1 or judged(found)[0].score > np.log(EXACT) + MARGIN:
        for p in feasible if any(orders) else ():
            starts = [_predictor(base, p, max(orders)) for base in bases]
            shown = min(states[0].shape[1] for states, *_ in starts)
            for n in orders if len(orders) > 1 else (min(orders[0], shown),):
                if 0 < n <= shown:
                    pars[n, p] = [_states(start, n) for start in starts]
    if pars:
        rows = judged({key: [*map(steady, x)] for key, x in pars.items()})
        rows.sort(key=lambda row: row.score)
        best = {row.order: row for row in reversed(rows)}.values()
        few = list(dict.fromkeys([*sorted(best, key=lambda row: row.score), *rows]))
        few = few[: max(REFINED, ROWS // sum(one.steps for one in trajectories))]
        few.append(equal_candidates(rows)[0])
        found = found if len(orders) > 1 else {}
        for key in dict.fromkeys(row[:2] for row in few):
            pairs = zip(pars[key], folds, strict=True)
            found[key] = [steady(em(par, fold, FEW)) for par, fold in pairs]
    return list(zip(judged(found), found.values(), strict=True))


def _sums(models: Sequence[Innovations], data: Sequence[Signals], held: _Held) -> Array:
    """Return the squared errors of the blocks and their number ``(2, count, horizons, n_y)``."""
    block, y = held.targets(HORIZONS), np.concatenate([one.y for one in data])
    sums = np.zeros((2, held.count, len(HORIZONS), y.shape[1]))
    rows, places = np.nonzero(block >= 0)
    e = held.errors(models, data, HORIZONS)[rows, places]
    seen = np.isfinite(y[rows + HORIZONS[places]])
    off = np.where(np.abs(e) < WORST, e, WORST) ** 2 * seen  # NaN is WORST
    for total, weights in zip(sums, (off, seen), strict=True):
        np.add.at(total, (block[rows, places], places), weights)
    return sums


def _score(total: Array, count: Array) -> float:
    """Return the mean logarithm of the outputs' mean squared errors of all horizons."""
    mse = (total / np.maximum(count, 1)).sum(0) / np.maximum((count > 0).sum(0), 1)
    return float(np.log(np.maximum(mse[count.any(0)], EXACT)).mean())


def equal_candidates(rows: Sequence[Candidate]) -> list[Candidate]:
    """Return the candidates whose scores are the least one within its error, by order."""
    least = min((row.score for row in rows), default=0.0)
    equal = [x for x in rows if x.score <= least + max(MARGIN, min(ERRORS * x.error, MOST))]
    return sorted(equal, key=lambda row: (row.order, row.score))


# Normalised signals


class _Normal:
    """Outputs, inputs and known signals of unit variance.

    Outputs that no input moves are known signals of the others, and stay where they are.
    """

    def __init__(self, trajectories: Sequence[Trajectory]) -> None:
        self.apart, self.n_u = unmoved_outputs(trajectories), trajectories[0].u.shape[1]
        y = np.concatenate([x.y.numpy() for x in trajectories])
        held = [continued(x.y.numpy()[:, self.apart]) for x in trajectories]
        self.first = np.array([x[0] for x in held])
        self.changes = np.concatenate([np.diff(x, axis=0) for x in held])
        self.y, self.y_size = _scale(y[:, ~self.apart])
        self.v, self.v_size = _scale(np.concatenate([self._known(x) for x in trajectories]))

    def _known(self, one: Trajectory) -> Array:
        y, u, d = (x.numpy() for x in one)
        return np.hstack((u, d, continued(y[:-1, self.apart])))

    def apply(self, trajectories: Sequence[Trajectory]) -> list[Signals]:
        """Return the signals."""
        data = []
        for one in trajectories:
            v = (self._known(one) - self.v) / self.v_size
            y = (one.y.numpy().compress(~self.apart, 1) - self.y) / self.y_size
            data.append(Signals(y, np.hstack((v, np.ones((len(v), 1))))))
        return data

    def restore(self, model: Innovations) -> Innovations:
        """Return a model of normalised signals, whose B has the columns of v and 1, in units."""
        n_y, n, n_v = len(self.y), len(model.A), len(self.v)
        size, shift = np.ones(n), np.zeros(n)
        size[:n_y], shift[:n_y] = self.y_size, self.y
        B = model.B[:, :n_v] / self.v_size
        offset = model.B[:, n_v] - B @ self.v
        # The origin of hidden states is free: where they rest without an input if y = 0.
        move, level = np.eye(n) - model.A, shift / size
        shift[n_y:] = np.linalg.lstsq(move[:, n_y:], -offset - move @ level, rcond=1e-9)[0]
        S = self.y_size[:, None] * model.S * self.y_size
        C, L = self.y_size[:, None] * model.C, model.L / self.y_size
        model = model._replace(B=B, offset=offset, C=C, L=L, S=S)
        return self._with_apart(model.transformed(np.diag(size), np.diag(1 / size), shift))

    def _with_apart(self, model: Innovations) -> Innovations:
        """Return the model with outputs that no input moves, as states that stay."""
        n_y, n, count = len(self.apart), len(model.A), int(self.apart.sum())
        n_d = model.B.shape[1] - self.n_u - count
        outputs = np.argsort(np.argsort(self.apart, kind="stable"))
        hidden = np.arange(n_y - count, n)
        joined: Any = scipy.linalg.block_diag
        moved = np.where(outputs < n_y - count, outputs, outputs + len(hidden))
        states = np.concatenate((moved, hidden))
        one, S = np.eye(count), self.changes.T @ self.changes / len(self.changes)
        A = joined(model.A, one)
        A[:n, n:] = model.B[:, self.n_u + n_d :]
        B, E = (np.pad(x, ((0, count), (0, 0)))[states] for x in (model.B, model.E))
        spread = np.cov(self.first.T, bias=True).reshape(count, count) - S
        return Innovations(
            A[np.ix_(states, states)],
            B[:, : self.n_u],
            np.hstack((B[:, self.n_u : self.n_u + n_d], E)),
            np.pad(model.offset, (0, count))[states],
            np.eye(n_y, n + count),
            joined(model.L, one)[np.ix_(states, outputs)],
            joined(model.S, S)[np.ix_(outputs, outputs)],
            np.concatenate((model.x0, self.first.mean(0)))[states],
            joined(model.P0, spread)[np.ix_(states, states)],
        )


def unmoved_outputs(trajectories: Sequence[Trajectory]) -> Any:
    """Return True for outputs that never change, or seldom and whatever the inputs, ``(n_y,)``.

    Changes of an output that most measurements repeat, such as a set-point, are regressed on the
    last inputs and their squares. An F-test of 1 % decides whether these explain them.
    """
    outputs = [continued(x.y.numpy()) for x in trajectories]
    changes = np.concatenate([np.diff(y, axis=0) for y in outputs])
    seen = np.concatenate([x.y[1:].isfinite().numpy() for x in trajectories])
    unmoved: Any = ~(changes != 0).any(0)
    repeated = ((changes == 0) & seen).sum(0) >= CONSTANT * seen.sum(0)
    seldom = np.flatnonzero(~unmoved & repeated)
    use = [(x.u.numpy(), y) for x, y in zip(trajectories, outputs, strict=True) if x.steps > LAST]
    if not len(seldom) or not use:
        return unmoved & ~unmoved.all()
    windows = [sliding_window_view(u, LAST, 0) for u, _ in use]
    U = np.concatenate([w.reshape(len(w), -1) for w in windows])
    U = np.hstack((np.ones((len(U), 1)), U, U**2))
    after = np.concatenate([np.diff(y[LAST - 1 :, seldom], axis=0) for _, y in use])
    m, left = U.shape[1] - 1, len(U) - U.shape[1]
    if left > 0:
        rest = np.square(after - U @ np.linalg.lstsq(U, after, rcond=None)[0]).sum(0)
        ratio = (len(U) * after.var(0) - rest) / np.maximum(rest, TINY) * left / m
        unmoved[seldom] = scipy.special.fdtrc(m, left, ratio) > LEVEL
    return unmoved & ~unmoved.all()


def continued(y: Array) -> Array:
    """Return outputs with the last ones in place of the missing, or else the next ones."""
    seen, rows = np.isfinite(y), np.arange(len(y))[:, None]
    last = np.maximum.accumulate(np.where(seen, rows, -1))
    last = np.where(last < 0, seen.argmax(0), last)
    return np.nan_to_num(np.take_along_axis(y, last, 0)) if len(y) else y


def _scale(x: Array) -> tuple[Array, Array]:
    mean, size = np.nanmean(x, 0), np.nanstd(x, 0)
    return mean, np.where(size > 1e-12 * np.abs(mean), size, 1.0)


# Starts


def _runs(data: Sequence[Signals]) -> list[Signals]:
    """Return the parts of the trajectories in which all outputs are seen."""
    cuts = [(y, v, runs(np.isfinite(y).all(1))) for y, v in data]
    return [Signals(y[i:k], v[i : k - 1]) for y, v, rows in cuts for i, k in rows if k - i > 1]


def _filled(data: Sequence[Signals]) -> list[Signals]:
    """Fill gaps of outputs along lines: up to FILLED rows, or all of a sensor that is slow."""
    filled = [one._replace(y=one.y.copy()) for one in data]
    for column in (column for one in filled for column in one.y.T):
        most = FILLED if np.isfinite(np.diff(column)).any() else len(column)
        for i, k in runs(np.isnan(column)):
            if i > 0 and k < len(column) and k - i <= most:
                column[i:k] = np.interp(range(i, k), (i - 1, k), column[[i - 1, k]])
    return filled


def measured(data: Sequence[Signals], filled: Sequence[Signals]) -> Innovations:
    """Return the model whose states are the outputs, by ridge regression on single steps.

    If too few steps have all outputs, gaps are ``filled``.
    """
    n = data[0].y.shape[1]
    data = _runs(data)
    if sum(len(v) for _, v in data) <= n + filled[0].v.shape[1]:
        data = _runs(filled)
    X = np.concatenate([np.hstack((y[:-1], v)) for y, v in data])
    Y = np.concatenate([y[1:] for y, _ in data])
    W = ridge(torch.as_tensor(X), torch.as_tensor(Y)).numpy().T
    e = Y - X @ W.T
    S, one, none = e.T @ e / len(e), np.eye(n), np.zeros((n, 0))
    first, every = (np.concatenate(x) for x in ([y[:1] for y, _ in data], [y for y, _ in data]))
    mean, P0 = starting(first, every)
    return Innovations(W[:, :n], W[:, n:], none, np.zeros(n), one, one, S, mean, P0 - S)


def _predictor(
    data: Sequence[Signals], lags: int, order: int
) -> tuple[list[Array], list[Signals], Array]:
    """Fit an ARX model of ``lags``; decompose its predictions over HORIZONS, or ``order`` steps.

    Return the states of windows, those that predict the most first, the steps after, and the mean
    of the first outputs.
    """
    n_y = data[0].y.shape[1]
    windows, after = [], []
    for y, v in _runs(data):
        if len(v) >= lags:
            w = np.hstack((y[:-1], v[:, :-1]))
            windows.append(sliding_window_view(w.ravel(), lags * w.shape[1])[:: w.shape[1]])
            after.append(Signals(y[lags:], v[lags:]))
    if not windows:
        raise QPError.expected("trajectories", f"none of {lags} steps without gaps", "a longer one")
    Z, F = np.concatenate(windows), np.concatenate([y for y, _ in after])
    Z, q = np.hstack((Z, np.ones((len(Z), 1)))), Z.shape[1] // lags
    W = ridge(torch.as_tensor(Z), torch.as_tensor(F)).numpy()
    step, rows = np.eye(len(W) - 1, k=q), [W[:-1].T]
    step[-q : n_y - q or None] = W[:-1].T
    for _ in range(max(*HORIZONS, order) - 1):
        rows.append(rows[-1] @ step)
    G = np.concatenate(rows)
    first = np.mean([y[0] for y, _ in _runs(data)], 0)
    _, s, Vh = np.linalg.svd(np.linalg.qr(Z[:, :-1], mode="r") @ G.T, full_matrices=False)
    s = s[s > 1e-9 * s[0]][:order] / np.sqrt(len(Z))
    T = (Vh[: len(s)] / s[:, None]) @ G
    return [z @ T.T for z in windows], after, first


def _states(predictor: tuple[list[Array], list[Signals], Array], order: int) -> Noisy:
    """Return the model of the first ``order`` states, by least squares."""
    states, after, first = predictor
    X = [x[:, :order] for x in states]
    F = np.concatenate([y for y, _ in after])
    V = np.concatenate([np.hstack((x[:-1], v)) for x, (_, v) in zip(X, after, strict=True)])
    X1, X0 = np.concatenate([x[1:] for x in X]), np.concatenate(X)
    AB, C = (np.linalg.lstsq(x.T @ x, x.T @ z, rcond=None)[0].T for x, z in ((V, X1), (X0, F)))
    w, r = X1 - V @ AB.T, F - X0 @ C.T
    Q = w.T @ w / len(w) + 1e-6 * np.eye(order)
    R = r.T @ r / len(r) + 1e-9 * np.eye(len(C))
    return Noisy(AB[:, :order], AB[:, order:], C, Q, R, np.linalg.pinv(C) @ first, np.eye(order))


def readable(model: Innovations, data: Sequence[Signals], E: Array | None = None) -> Innovations:
    """Return the model, with E, of the outputs as first states, and others of unit variance."""
    n, C = len(model.A), model.C
    cov = np.cov(np.concatenate(each(model, data, model.estimates)).T, bias=True).reshape(n, n)
    root = np.linalg.cholesky(cov + 1e-12 * np.trace(cov) * np.eye(n))
    _, s, Vh = np.linalg.svd(C @ root)
    hidden = np.linalg.solve(root.T, Vh[int((s > HIDDEN * s[0]).sum()) :].T).T
    hidden *= np.sign(hidden[np.arange(len(hidden)), np.abs(hidden).argmax(1)])[:, None]
    T = np.concatenate((C, hidden))
    model = model if E is None else model._replace(E=E)
    model = model.transformed(T, np.linalg.pinv(T), np.zeros(len(T)))
    return model._replace(C=np.eye(len(C), len(T)))
