"""Identification of a state-space model with its noise: a subspace start and maximum likelihood.

The start is PBSID (Chiuso 2007): an ARX model with p lags, by ridge regression, predicts the
outputs; the singular vectors of its predictions of the next p outputs are the states, and least
squares give their model. Expectation maximisation (Shumway and Stoffer 1982) then raises the
likelihood of

    x_{k+1} = A x_k + B u_k + E d_k + offset + w_k,   y_k = C x_k + v_k,   cov w = Q, cov v = R,

and of the distribution of x_0. Noise that has one source in w and v, or is delayed, takes more
states. Signals are normalised, so that units decide nothing.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy  # imports its parts at their first use: a fifth of a second
import torch

from torch_qpmpc.identification.innovations import Array, Innovations
from torch_qpmpc.identification.log import Trajectory, folds
from torch_qpmpc.identification.ridge import ridge
from torch_qpmpc.qp.kernels.linalg import compiled

#: Iterations of expectation maximisation, of a candidate and of the fit, and the gain of the
#: log-likelihood per step that ends them.
FEW, MANY, STALLED = 5, 20, 1e-5
#: A covariance that changes by less than this share has settled.
SAME = 1e-8
#: The least variances of the noise of normalised states and outputs.
FLOOR_Q, FLOOR_R = 1e-12, 1e-8
#: Directions of the states, of unit variance, that the outputs show less than this are kept as
#: states of their own.
HIDDEN = 1e-2
#: Candidates, as far as the data allow; 0 states are the outputs alone.
ORDERS, LAGS = (1, 2, 3, 4, 5, 6, 7, 8, 10, 12, 14, 16, 20), (2, 5, 10, 20)
#: Parts of the log in cross-validation, which cuts longer trajectories.
PARTS, LONG = 2, 200
#: Steps of the predictions that decide.
HORIZONS = (1, 2, 5, 10, 20)
#: The smallest order is chosen whose squared errors are above the best's by less than this share,
#: in the geometric mean. Errors below EXACT, as a share of the variance, are none.
MARGIN, EXACT = 0.004, 1e-8
#: Outputs may be unmoved if they are constant in this share of the steps; the number of past inputs
#: in the test, and its level.
CONSTANT, LAST, LEVEL, TINY = 0.5, 10, 0.01, 1e-300
#: So many orders in turn that are no better end the search.
PATIENCE = 3
#: Autocorrelations of the residuals in the test of whiteness.
CORRELATIONS = 20


class Candidate(NamedTuple):
    """An order and lags, and the mean logarithm of held-out squared errors of unit variances."""

    order: int
    lags: int
    score: float


class Fit(NamedTuple):
    """An identified model, and how it was chosen.

    Attributes:
        model: the model.
        order, lags: as in `fit_state_space`.
        candidates: those that were compared.
    """

    model: Innovations
    order: int
    lags: int
    candidates: tuple[Candidate, ...] = ()


class Signals(NamedTuple):
    """Normalised outputs ``(*batch, T + 1, n_y)`` and [u, d, 1] ``(*batch, T, n_v)``."""

    y: Array
    v: Array


class Noisy(NamedTuple):
    """The model of the likelihood; B has the columns of u, d and 1."""

    A: Array
    B: Array
    C: Array
    Q: Array
    R: Array
    m0: Array
    P0: Array


def fit_state_space(
    trajectories: Sequence[Trajectory], order: int | None = None, lags: int | None = None
) -> Fit:
    """Fit an innovations form to a log, whose first states are the outputs.

    Order and lags have the least multi-step errors in parts of the log that a fit has not seen; of
    orders that are nearly as good, the smallest.

    Args:
        trajectories: the log.
        order: states of the likelihood's model; 0 for the outputs alone, each measured exactly.
            The innovations form has more if the outputs are not independent functions of them.
        lags: lags of the ARX model of the start.
    """
    normal = _Normal(trajectories)
    data, rows = normal.apply(trajectories), ()
    if order is None or (lags is None and order):
        orders = ORDERS if order is None else (order,)
        feasible = _feasible(data) if lags is None else (lags,)
        short = [
            one.between(first, min(first + LONG, one.steps))
            for one in trajectories
            for first in range(0, one.steps, LONG)
        ]
        parts = [normal.apply(part) for part in folds(short, PARTS)]
        rows = tuple(_compare(parts, orders, feasible, order is None))
        order, lags = _best(rows)[:2]
    if order:
        par = em(_states(_predictor(data, lags or 0), order), data, MANY)
        model = readable(steady(par), data)
    else:
        model = measured(data)
    return Fit(normal.restore(model), order, lags or 0, rows)


def held_out_errors(
    trajectories: Sequence[Trajectory], order: int, lags: int, horizon: int
) -> Array:
    """Return multi-step errors ``(steps, horizon, n_y)`` of fits that have not seen their part.

    Those of the first ``lags`` steps of long trajectories, in which the filter settles, are left
    out.
    """
    parts, errors = folds(trajectories, PARTS), []
    for i, part in enumerate(parts):
        others = [one for j, other in enumerate(parts) if j != i for one in other]
        model = fit_state_space(others, order, lags).model
        for e in _errors(model, part, horizon):
            settled = lags if e.shape[1] > 2 * lags else 0
            errors.append(e[:, settled:].reshape(-1, *e.shape[2:]))
    return np.concatenate(errors)


def whiteness(model: Innovations, trajectories: Sequence[Trajectory]) -> Array:
    """Return the share of autocorrelations in the 95 % bound of white residuals, ``(n_y,)``."""
    errors = [e[:, :, 0] for e in _errors(model, trajectories, 1)]
    whole, inside = np.concatenate([e.reshape(-1, e.shape[-1]) for e in errors]), []
    mean, variance = whole.mean(0), whole.var(0)
    for lag in range(1, CORRELATIONS + 1):
        pairs = [(e[:, lag:] - mean) * (e[:, :-lag] - mean) for e in errors]
        pairs = np.concatenate([x.reshape(-1, x.shape[-1]) for x in pairs])
        size = variance * 1.96 * np.sqrt(max(len(pairs), 1))
        inside.append(np.abs(pairs.sum(0)) <= size)
    return np.mean(inside, 0)


def explained_by_inputs(model: Innovations, trajectories: Sequence[Trajectory]) -> Array:
    """Return the share of residuals' variance that inputs of the same rows explain, ``(n_y,)``.

    The model predicts an output from the inputs of the rows before: a share above zero is feedback,
    or an input that is logged a row late.
    """
    n_y, n_u = len(model.C), model.B.shape[1]
    parts = zip(_errors(model, trajectories, 1), _batches(_signals(trajectories)), strict=True)
    pairs = (np.concatenate((e[:, :-1, 0], v[:, 1:, :n_u]), -1) for e, (_, v) in parts)
    rows = np.concatenate([x.reshape(-1, n_y + n_u) for x in pairs])
    if len(rows) <= n_u + 1:  # such as from trajectories of single steps
        return np.zeros(n_y)
    e, u = np.split(rows - rows.mean(0), [n_y], 1)
    left = e - u @ np.linalg.lstsq(u, e, rcond=None)[0]
    before, after = (e**2).sum(0) / (len(rows) - 1), (left**2).sum(0) / (len(rows) - n_u - 1)
    size = np.abs(np.concatenate([one.y.numpy() for one in trajectories])).max(0)
    noisy = before > (EXACT * size) ** 2
    return np.where(noisy, 1 - after / np.where(noisy, before, 1.0), 0.0)


def visited(model: Innovations, trajectories: Sequence[Trajectory]) -> tuple[Array, Array]:
    """Return mean ``(n,)`` and covariance ``(n, n)`` of the log's states before their outputs."""
    states = []
    for y, v in _batches(_signals(trajectories)):
        u, d = np.split(v, [model.B.shape[1]], -1)
        x = model.estimates(y, u, d)[..., :-1, :] @ model.A.T + model.inputs(u, d)
        states.append(x.reshape(-1, len(model.A)))
    x = np.concatenate(states)
    return x.mean(0), np.cov(x.T, bias=True).reshape(len(model.A), -1)


def _signals(trajectories: Sequence[Trajectory]) -> list[Signals]:
    return [Signals(x.y.numpy(), np.hstack((x.u.numpy(), x.d.numpy()))) for x in trajectories]


def _errors(
    model: Innovations, trajectories: Sequence[Trajectory], horizon: int
) -> Iterator[Array]:
    """Yield multi-step errors ``(G, T, horizon, n_y)`` of the trajectories of each length."""
    n_u = model.B.shape[1]
    for y, v in _batches(_signals(trajectories)):
        yield model.errors(y, v[..., :n_u], v[..., n_u:], horizon)


# The choice


def _feasible(data: Sequence[Signals]) -> tuple[int, ...]:
    """Return the lags whose windows are in at least half of the steps."""
    total = sum(len(v) for _, v in data)
    usable = {p: sum(max(len(v) - p, 0) for _, v in data) for p in LAGS}
    width = data[0].y.shape[1] + data[0].v.shape[1]
    return tuple(p for p in LAGS if usable[p] >= max(total / 2, 2 * width))[-3:]


def _compare(
    parts: list[list[Signals]], orders: Sequence[int], lags: Sequence[int], alone: bool
) -> list[Candidate]:
    """Return the candidates with their scores; ``alone`` are the outputs without a filter, too."""
    folds = [
        ([x for j, p in enumerate(parts) if j != i for x in p], _batches(part))
        for i, part in enumerate(parts)
    ]
    rows = []
    if alone or not lags:
        rows.append(Candidate(0, 0, _score([measured(data) for data, _ in folds], folds)))
        if rows[0].score <= np.log(EXACT) + MARGIN:
            return rows
    for p in lags:
        starts = [_predictor(data, p) for data, _ in folds]
        best, misses = np.inf, 0
        for n in orders:
            if n <= min(len(start.s) for start in starts) and misses < PATIENCE:
                pairs = zip(starts, folds, strict=True)
                models = [steady(em(_states(start, n), data, FEW)) for start, (data, _) in pairs]
                rows.append(Candidate(n, p, _score(models, folds)))
                misses = 0 if rows[-1].score < best - MARGIN else misses + 1
                best = min(best, rows[-1].score)
    return rows


def _score(models: list[Innovations], folds: list) -> float:
    """Return the mean logarithm of the squared errors of all horizons and outputs."""
    last, total, count = max(HORIZONS), np.zeros(()), np.zeros(())
    for model, (_, batches) in zip(models, folds, strict=True):
        for y, v in batches:
            errors = model.errors(y, v, v[..., :0], last)[..., np.array(HORIZONS) - 1, :]
            errors = errors.reshape(-1, *errors.shape[-2:])
            total = total + np.nansum(errors**2, 0)
            count = count + np.isfinite(errors).sum(0)
    return float(np.log(np.maximum(total[count > 0] / count[count > 0], EXACT)).mean())


def _best(rows: Sequence[Candidate]) -> Candidate:
    limit = min(row.score for row in rows) + MARGIN
    return min((row for row in rows if row.score <= limit), key=lambda row: (row.order, row.score))


# Normalised signals


class _Normal:
    """Outputs, inputs and known signals of unit variance.

    Outputs that no input moves are known signals of the others, and stay where they are.
    """

    def __init__(self, trajectories: Sequence[Trajectory]) -> None:
        self.apart, self.n_u = _unmoved(trajectories), trajectories[0].u.shape[1]
        y = np.concatenate([x.y.numpy() for x in trajectories])
        held = [x.y.numpy()[:, self.apart] for x in trajectories]
        self.first = np.array([x[0] for x in held])
        self.changes = np.concatenate([np.diff(x, axis=0) for x in held])
        self.y, self.y_size = _scale(y[:, ~self.apart])
        self.v, self.v_size = _scale(np.concatenate([self._known(x) for x in trajectories]))

    def _known(self, one: Trajectory) -> Array:
        y, u, d = (x.numpy() for x in one)
        return np.hstack((u, d, y[:-1, self.apart]))

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
        B = np.pad(model.B, ((0, count), (0, 0)))[states]
        spread = np.cov(self.first.T, bias=True).reshape(count, count) - S
        return Innovations(
            A[np.ix_(states, states)],
            B[:, : self.n_u],
            B[:, self.n_u : self.n_u + n_d],
            np.pad(model.offset, (0, count))[states],
            np.eye(n_y, n + count),
            joined(model.L, one)[np.ix_(states, outputs)],
            joined(model.S, S)[np.ix_(outputs, outputs)],
            np.concatenate((model.x0, self.first.mean(0)))[states],
            joined(model.P0, spread)[np.ix_(states, states)],
        )


def _unmoved(trajectories: Sequence[Trajectory]) -> Any:
    """Return True for outputs that never change, or seldom and whatever the inputs, ``(n_y,)``.

    Changes of an output that is constant in most steps, such as a set-point, are regressed on the
    last inputs and their squares. An F-test of 1 % decides whether these explain them.
    """
    changes = np.concatenate([np.diff(x.y.numpy(), axis=0) for x in trajectories])
    unmoved: Any = ~(changes != 0).any(0)
    seldom = np.flatnonzero(~unmoved & ((changes == 0).mean(0) >= CONSTANT))
    use = [x for x in trajectories if x.steps > LAST]
    if not len(seldom) or not use:
        return unmoved & ~unmoved.all()
    windows = [np.lib.stride_tricks.sliding_window_view(x.u.numpy(), LAST, 0) for x in use]
    U = np.concatenate([w.reshape(len(w), -1) for w in windows])
    U = np.hstack((np.ones((len(U), 1)), U, U**2))
    after = np.concatenate([np.diff(x.y.numpy()[LAST - 1 :, seldom], axis=0) for x in use])
    for i, target in zip(seldom, after.T, strict=True):
        rest = target - U @ np.linalg.lstsq(U, target, rcond=None)[0]
        m, left = U.shape[1] - 1, len(U) - U.shape[1]
        if left > 0:
            explained = ((target - target.mean()) ** 2).sum() - rest @ rest
            unmoved[i] = (
                scipy.special.fdtrc(m, left, explained / max(rest @ rest, TINY) * left / m) > LEVEL
            )
    return unmoved & ~unmoved.all()


def _scale(x: Array) -> tuple[Array, Array]:
    mean, size = x.mean(0), x.std(0)
    return mean, np.where(size > 1e-12 * np.abs(mean), size, 1.0)


# Starts


def measured(data: Sequence[Signals]) -> Innovations:
    """Return the model whose states are the outputs, by ridge regression on single steps."""
    n = data[0].y.shape[1]
    X = np.concatenate([np.hstack((y[:-1], v)) for y, v in data])
    Y = np.concatenate([y[1:] for y, _ in data])
    W = ridge(torch.as_tensor(X), torch.as_tensor(Y)).numpy().T
    e = Y - X @ W.T
    S, one, none = e.T @ e / len(e), np.eye(n), np.zeros((n, 0))
    first = np.array([y[0] for y, _ in data])
    P0 = np.cov(first.T, bias=True).reshape(n, n) - S
    return Innovations(W[:, :n], W[:, n:], none, np.zeros(n), one, one, S, first.mean(0), P0)


class _Predictor(NamedTuple):
    """Windows of p steps, the steps after them, and the directions that predict the most."""

    windows: list[Array]
    after: list[Signals]
    Vh: Array
    s: Array
    G: Array
    first: Array


def _predictor(data: Sequence[Signals], lags: int) -> _Predictor:
    """Fit an ARX model of ``lags`` and decompose its predictions of as many steps."""
    n_y = data[0].y.shape[1]
    windows, after = [], []
    for y, v in data:
        if len(v) >= lags:
            w = np.hstack((y[:-1], v[:, :-1]))
            count = len(w) - lags + 1
            windows.append(np.hstack([w[i : i + count] for i in range(lags)]))
            after.append(Signals(y[lags:], v[lags:]))
    Z, F = np.concatenate(windows), np.concatenate([y for y, _ in after])
    W = ridge(torch.as_tensor(np.hstack((Z, np.ones((len(Z), 1))))), torch.as_tensor(F)).numpy()
    G, q = np.zeros((lags * n_y, Z.shape[1])), Z.shape[1] // lags
    for f in range(lags):
        G[f * n_y : (f + 1) * n_y, f * q :] = W[: (lags - f) * q].T
    _, s, Vh = np.linalg.svd(np.linalg.qr(Z, mode="r") @ G.T, full_matrices=False)
    s = s[s > 1e-9 * s[0]] / np.sqrt(len(Z))
    return _Predictor(windows, after, Vh, s, G, np.mean([y[0] for y, _ in data], 0))


def _states(predictor: _Predictor, order: int) -> Noisy:
    """Return the model of the first ``order`` directions, by least squares."""
    windows, after, Vh, s, G, first = predictor
    T = (Vh[:order] / s[:order, None]) @ G
    X, F = [z @ T.T for z in windows], np.concatenate([y for y, _ in after])
    V = np.concatenate([np.hstack((x[:-1], v)) for x, (_, v) in zip(X, after, strict=True)])
    X1, X0 = np.concatenate([x[1:] for x in X]), np.concatenate(X)
    AB = np.linalg.lstsq(V, X1, rcond=None)[0].T
    C = np.linalg.lstsq(X0, F, rcond=None)[0].T
    w, r = X1 - V @ AB.T, F - X0 @ C.T
    Q = w.T @ w / len(w) + 1e-6 * np.eye(order)
    R = r.T @ r / len(r) + 1e-9 * np.eye(len(C))
    return Noisy(AB[:, :order], AB[:, order:], C, Q, R, np.linalg.pinv(C) @ first, np.eye(order))


# Maximum likelihood


class _Moments(NamedTuple):
    """Smoothed means ``(G, T + 1, n)``, their covariances ``(T + 1, n, n)`` and neighbours'."""

    x: Array
    P: Array
    cross: Array
    likelihood: float


def smooth(par: Noisy, y: Array, v: Array) -> _Moments:
    """Smooth trajectories of equal length, y ``(G, T + 1, n_y)``."""
    A, B, C, Q, R, m, P = par
    (G, N, n_y), n = y.shape, len(A)
    before, after = np.empty((N, n, n)), np.empty((N, n, n))
    L, inverse, half = np.empty((N, n, n_y)), np.empty((N, n_y, n_y)), np.empty(N)
    steady = N
    for t in range(N):
        before[t] = A @ after[t - 1] @ A.T + Q if t else P
        change = np.abs(before[t] - before[t - 1]).max()
        if t > 1 and change <= SAME * np.abs(before[t]).max():
            for part in (before, after, L, inverse, half):
                part[t:] = part[t - 1]
            steady = t
            break
        V = C @ before[t] @ C.T + R
        inverse[t], half[t] = np.linalg.inv(V), np.linalg.slogdet(V)[1]
        L[t] = before[t] @ C.T @ inverse[t]
        P = before[t] - L[t] @ V @ L[t].T
        after[t] = (P + P.T) / 2
    y = np.moveaxis(y, 0, 1)
    moved = np.moveaxis(v @ B.T, 0, 1) + _apply(A @ L, y)[:-1]
    # Copies are contiguous, or the kernels would be compiled for each layout.
    start = np.broadcast_to(m, (G, n)).copy()
    prior = recursion((A - A @ L @ C)[:-1].copy(), moved.copy(), start)
    e = y - prior @ C.T
    post = prior + _apply(L, e)
    value = -(half.sum() * G + (_apply(inverse, e) * e).sum()) / 2
    J = np.linalg.solve(before[1 : steady + 1], A @ after[:steady][: N - 1]).swapaxes(-1, -2)
    J = J[np.arange(N - 1).clip(max=len(J) - 1)]
    back = (post[:-1] - _apply(J, prior[1:]))[::-1].copy()
    x = recursion(J[::-1].copy(), back, post[-1].copy())[::-1]
    own = after[:-1] - J @ before[1:] @ J.swapaxes(-1, -2)
    Ps = spread(J.copy(), own.copy(), after[-1])
    return _Moments(np.moveaxis(x, 0, 1), Ps, Ps[1:] @ J.swapaxes(-1, -2), float(value))


def _apply(M: Array, x: Array) -> Array:
    """Return the products of x ``(T, G, n)`` with the matrices of each step ``(T, .., n)``."""
    return np.matmul(M[:, None], x[..., None])[..., 0]


@compiled
def recursion(M, c, z):
    """Return z_0 = z and z_{t+1} = M_t z_t + c_t, ``(T + 1, G, n)``."""
    T, G, n = c.shape
    out = np.empty((T + 1, G, n))
    for i in range(G):
        for j in range(n):
            out[0, i, j] = z[i, j]
    for t in range(T):
        for i in range(G):
            for j in range(n):
                total = c[t, i, j]
                for k in range(n):
                    total += M[t, j, k] * out[t, i, k]
                out[t + 1, i, j] = total
    return out


@compiled
def spread(J, own, last):
    """Return P_T = last and P_t = J_t P_{t+1} J_t' + own_t, ``(T + 1, n, n)``."""
    T, n, _ = own.shape
    out, half = np.empty((T + 1, n, n)), np.empty((n, n))
    for j in range(n):
        for k in range(n):
            out[T, j, k] = last[j, k]
    for t in range(T - 1, -1, -1):
        for j in range(n):
            for k in range(n):
                half[j, k] = 0.0
                for m in range(n):
                    half[j, k] += J[t, j, m] * out[t + 1, m, k]
        for j in range(n):
            for k in range(n):
                total = own[t, j, k]
                for m in range(n):
                    total += half[j, m] * J[t, k, m]
                out[t, j, k] = total
    return out


def _batches(data: Sequence[Signals]) -> list[Signals]:
    """Return trajectories of the same length together."""
    groups: dict[int, list[Signals]] = defaultdict(list)
    for one in data:
        groups[len(one.v)].append(one)
    return [Signals(*map(np.stack, zip(*group, strict=True))) for group in groups.values()]


def em(par: Noisy, data: Sequence[Signals], iterations: int) -> Noisy:
    """Raise the likelihood by expectation maximisation."""
    batches, before = _batches(data), -np.inf
    steps = sum(len(y) for y, _ in data)
    for _ in range(iterations):
        moments = [smooth(par, y, v) for y, v in batches]
        value = sum(m.likelihood for m in moments) / steps
        if value - before < STALLED:
            break
        before, par = value, _maximise(batches, moments)
    return par


def _maximise(batches: list[Signals], moments: list[_Moments]) -> Noisy:
    Szz: Any = 0.0
    Sx1 = S11 = Syx = Sxx = Syy = first = Szz
    N, M, n = 0, 0, moments[0].x.shape[-1]
    for (y, v), (x, P, cross, _) in zip(batches, moments, strict=True):
        G = len(y)
        z = np.concatenate((x[:, :-1], v), -1).reshape(-1, n + v.shape[-1])
        x1, all_x, ys = x[:, 1:].reshape(-1, n), x.reshape(-1, n), y.reshape(-1, y.shape[-1])
        zz, xz = z.T @ z, x1.T @ z
        zz[:n, :n] += G * P[:-1].sum(0)
        xz[:, :n] += G * cross.sum(0)
        Szz, Sx1, S11 = Szz + zz, Sx1 + xz, S11 + x1.T @ x1 + G * P[1:].sum(0)
        Syx, Syy = Syx + ys.T @ all_x, Syy + ys.T @ ys
        Sxx = Sxx + all_x.T @ all_x + G * P.sum(0)
        N, M = N + len(x1), M + len(ys)
    count = sum(len(m.x) for m in moments)
    m0: Any = sum(m.x[:, 0].sum(0) for m in moments) / count
    for m in moments:
        first = first + (m.x[:, 0] - m0).T @ (m.x[:, 0] - m0) + len(m.x) * m.P[0]
    P0 = first / count
    AB = np.linalg.solve(_lifted(Szz), Sx1.T).T
    C = np.linalg.solve(_lifted(Sxx), Syx.T).T
    Q = _positive((S11 - AB @ Sx1.T) / N, FLOOR_Q)
    R = _positive((Syy - C @ Syx.T) / M, FLOOR_R)
    return Noisy(AB[:, :n], AB[:, n:], C, Q, R, m0, _positive(P0, FLOOR_Q))


def _lifted(S: Array) -> Array:
    return S + 1e-9 * np.trace(S) / len(S) * np.eye(len(S))


def _positive(M: Array, floor: float) -> Array:
    w, v = np.linalg.eigh((M + M.T) / 2)
    return (v * np.maximum(w, floor)) @ v.T


# The filter


def steady(par: Noisy) -> Innovations:
    """Return the filter's steady state."""
    A, B, C, Q, R, m0, P0 = par
    try:
        P = scipy.linalg.solve_discrete_are(A.T, C.T, Q, R)
    except (ValueError, np.linalg.LinAlgError):  # a mode that nothing excites settles slowly
        P = Q
        for _ in range(1000):
            P = A @ (P - P @ C.T @ np.linalg.solve(C @ P @ C.T + R, C @ P)) @ A.T + Q
            P = (P + P.T) / 2
    S = C @ P @ C.T + R
    L = np.linalg.solve(S, C @ P).T
    return Innovations(A, B, B[:, :0], np.zeros(len(A)), C, L, S, m0, P0 - P)


def readable(model: Innovations, data: Sequence[Signals]) -> Innovations:
    """Return the model with the outputs as the first states, and others of unit variance."""
    n, C = len(model.A), model.C
    xi = [model.estimates(y, v, v[..., :0]).reshape(-1, n) for y, v in _batches(data)]
    cov = np.cov(np.concatenate(xi).T, bias=True).reshape(n, n)
    root = np.linalg.cholesky(cov + 1e-12 * np.trace(cov) * np.eye(n))
    _, s, Vh = np.linalg.svd(C @ root)
    hidden = np.linalg.solve(root.T, Vh[int((s > HIDDEN * s[0]).sum()) :].T).T
    hidden *= np.sign(hidden[np.arange(len(hidden)), np.abs(hidden).argmax(1)])[:, None]
    T = np.concatenate((C, hidden))
    model = model.transformed(T, np.linalg.pinv(T), np.zeros(len(T)))
    return model._replace(C=np.eye(len(C), len(T)))
