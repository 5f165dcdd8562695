"""Identification of a state-space model with its noise: a subspace start and maximum likelihood.

The start is PBSID (Chiuso 2007): an ARX model with p lags, by ridge regression, predicts the
outputs; the singular vectors of its predictions of the next p outputs are the states, and least
squares give their model. Expectation maximisation (Shumway and Stoffer 1982) then raises the
likelihood of

    x_{k+1} = A x_k + B u_k + E d_k + offset + w_k,   y_k = C x_k + v_k,   cov w = Q, cov v = R,

and of the distribution of x_0. Signals are normalised, so that units decide nothing.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg
import torch

from torch_qpmpc.mpc.innovations import Array, Innovations
from torch_qpmpc.mpc.log import Trajectory
from torch_qpmpc.mpc.ridge import ridge

#: Iterations of expectation maximisation, and the gain of the log-likelihood per step that ends it.
ITERATIONS, STALLED = 20, 1e-5
#: The least variances of the noise of normalised states and outputs.
FLOOR_Q, FLOOR_R = 1e-12, 1e-8
#: Directions of the states, of unit variance, that the outputs show less than this are kept as
#: states of their own.
HIDDEN = 1e-2


class Noisy(NamedTuple):
    """The model of the likelihood; B has the columns of u, d and 1."""

    A: Array
    B: Array
    C: Array
    Q: Array
    R: Array
    m0: Array
    P0: Array


class Fit(NamedTuple):
    """An identified model, and how it was chosen.

    Attributes:
        model: the model.
        order, lags: as in `fit_state_space`.
    """

    model: Innovations
    order: int | None
    lags: int


class Signals(NamedTuple):
    """One trajectory of normalised outputs ``(T + 1, n_y)`` and of [u, d, 1] ``(T, n_v)``."""

    y: Array
    v: Array


class Scale(NamedTuple):
    """The means and sizes of outputs and of [u, d]."""

    y: Array
    y_size: Array
    v: Array
    v_size: Array


def fit_state_space(
    trajectories: Sequence[Trajectory], order: int | None = None, lags: int = 10
) -> Fit:
    """Fit an innovations form to a log, whose first states are the outputs.

    Args:
        trajectories: the log; outputs that are NaN were not measured.
        order: states of the likelihood's model; None for the outputs alone, each measured exactly.
        lags: lags of the ARX model of the start.
    """
    y, u, d = ([part.numpy() for part in parts] for parts in zip(*trajectories, strict=True))
    low, high = (np.array([f.reduce(x) for x in y]) for f in (np.fmin, np.fmax))
    still, n_u = np.asarray(~(high > low).any(0)), u[0].shape[1]
    held = np.where(np.isfinite(high), high, np.nanmean(high, 0))[:, still]
    rows = [np.hstack((b, c, np.tile(a, (len(b), 1)))) for a, b, c in zip(held, u, d, strict=True)]
    scale = Scale(*_scale(np.concatenate([x[:, ~still] for x in y])), *_scale(np.concatenate(rows)))
    data = []
    for a, b in zip(y, rows, strict=True):
        v = np.hstack(((b - scale.v) / scale.v_size, np.ones((len(b), 1))))
        data.append(Signals((a[:, ~still] - scale.y) / scale.y_size, v))
    par = None if order is None else start(data, order, lags)
    model = measured(data) if par is None else readable(em(par, data), data)
    return Fit(_with_still(_in_units(model, scale), held, still, n_u), order, lags)


def _scale(x: Array) -> tuple[Array, Array]:
    mean, size = np.nanmean(x, 0), np.nanstd(x, 0)
    return mean, np.where(size > 1e-12 * np.abs(mean), size, 1.0)


def _in_units(model: Innovations, scale: Scale) -> Innovations:
    """Return a model of normalised signals in their units; `E` is [E, offset] before."""
    n_y, n, n_v = len(scale.y), len(model.A), len(scale.v)
    size, shift = np.ones(n), np.zeros(n)
    size[:n_y], shift[:n_y] = scale.y_size, scale.y
    B = model.B[:, :n_v] / scale.v_size
    S = scale.y_size[:, None] * model.S * scale.y_size
    L = model.L / scale.y_size
    offset = model.B[:, n_v] - B @ scale.v
    # The origin of hidden states is free: where they rest without an input if y = 0.
    move, level = np.eye(n) - model.A, shift / size
    shift[n_y:] = np.linalg.lstsq(move[:, n_y:], -offset - move @ level, rcond=1e-9)[0]
    model = model._replace(B=B, offset=offset, S=S, L=L)
    C = scale.y_size[:, None] * model.C
    return model._replace(C=C).transformed(np.diag(size), np.diag(1 / size), shift)


def _with_still(model: Innovations, held: Array, still: Array, n_u: int) -> Innovations:
    """Return the model with outputs that never change in a trajectory, as states that stay."""
    n_y, n, count = len(still), len(model.A), int(still.sum())
    n_d = model.B.shape[1] - n_u - count
    outputs = np.argsort(np.concatenate((np.flatnonzero(~still), np.flatnonzero(still))))
    hidden = np.arange(n_y - count, n)
    states = np.concatenate(
        (np.where(outputs < n_y - count, outputs, outputs + len(hidden)), hidden)
    )
    one, zero = np.eye(count), np.zeros((count, count))

    def joined(M: Array, other: Array) -> Any:
        return scipy.linalg.block_diag(M, other)

    A = joined(model.A, one)
    A[:n, n:] = model.B[:, n_u + n_d :]
    B = np.pad(model.B, ((0, count), (0, 0)))[states]
    spread = np.cov(held.T, bias=True).reshape(count, count)
    return Innovations(
        A[np.ix_(states, states)],
        B[:, :n_u],
        B[:, n_u : n_u + n_d],
        np.pad(model.offset, (0, count))[states],
        np.eye(n_y, n + count),
        joined(model.L, one)[np.ix_(states, outputs)],
        joined(model.S, zero)[np.ix_(outputs, outputs)],
        np.concatenate((model.x0, held.mean(0)))[states],
        joined(model.P0, spread)[np.ix_(states, states)],
    )


# Starts


def measured(data: Sequence[Signals]) -> Innovations:
    """Return the model whose states are the outputs, by ridge regression on single steps."""
    n = data[0].y.shape[1]
    X = np.concatenate([np.hstack((y[:-1], v)) for y, v in data])
    Y = np.concatenate([y[1:] for y, _ in data])
    whole = np.isfinite(X).all(1) & np.isfinite(Y).all(1)
    W = ridge(torch.as_tensor(X[whole]), torch.as_tensor(Y[whole])).numpy().T
    e = Y[whole] - X[whole] @ W.T
    S, one = e.T @ e / len(e), np.eye(n)
    first = np.array([y[0] for y, _ in data])
    first = first[np.isfinite(first).all(1)]
    P0 = np.cov(first.T, bias=True).reshape(n, n) - S
    none = np.zeros((n, 0))
    return Innovations(W[:, :n], W[:, n:], none, np.zeros(n), one, one, S, first.mean(0), P0)


def start(data: Sequence[Signals], order: int, lags: int) -> Noisy:
    """Return a model by PBSID."""
    n_y = data[0].y.shape[1]
    filled = [Signals(_filled(y), v) for y, v in data]
    rows = [np.hstack((y[:-1], v[:, :-1])) for y, v in filled]
    q = rows[0].shape[1]

    def windows(w: Array) -> Array:
        n = len(w) - lags + 1
        return np.stack([w[i : i + n] for i in range(lags)], 1).reshape(n, -1)

    use = [i for i, w in enumerate(rows) if len(w) >= lags]
    Z = [windows(rows[i]) for i in use]
    Zs, F = np.concatenate(Z), np.concatenate([filled[i].y[lags:] for i in use])
    one = np.hstack((Zs, np.ones((len(Zs), 1))))
    W = ridge(torch.as_tensor(one), torch.as_tensor(F)).numpy()[:-1].T
    G = np.zeros((lags * n_y, lags * q))
    for f in range(lags):
        G[f * n_y : (f + 1) * n_y, f * q :] = W[:, : (lags - f) * q]
    _, s, Vh = np.linalg.svd(np.linalg.qr(Zs, mode="r") @ G.T, full_matrices=False)
    T = Vh[:order] / (s[:order, None] / np.sqrt(len(Zs))) @ G
    X = [z @ T.T for z in Z]
    V = np.concatenate(
        [np.hstack((x[:-1], filled[i].v[lags:])) for x, i in zip(X, use, strict=True)]
    )
    X1, X0 = np.concatenate([x[1:] for x in X]), np.concatenate(X)
    AB = np.linalg.lstsq(V, X1, rcond=None)[0].T
    C = np.linalg.lstsq(X0, F, rcond=None)[0].T
    w, r = X1 - V @ AB.T, F - X0 @ C.T
    Q = w.T @ w / len(w) + 1e-6 * np.eye(order)
    R = r.T @ r / len(r) + 1e-9 * np.eye(n_y)
    m0 = np.linalg.pinv(C) @ np.mean([y[0] for y, _ in filled], 0)
    return Noisy(AB[:, :order], AB[:, order:], C, Q, R, m0, np.eye(order))


def _filled(y: Array) -> Array:
    """Return y with missing entries interpolated in time."""
    y, k = y.copy(), np.arange(len(y))
    for column in y.T:
        seen = np.isfinite(column)
        column[~seen] = np.interp(k[~seen], k[seen], column[seen]) if seen.any() else 0.0
    return y


# Maximum likelihood


class _Moments(NamedTuple):
    """Smoothed means ``(G, T + 1, n)``, their covariances and those of neighbours."""

    x: Array
    P: Array
    cross: Array
    likelihood: float


def smooth(par: Noisy, y: Array, v: Array, seen: Array | None) -> _Moments:
    """Smooth trajectories of equal length, y ``(G, T + 1, n_y)``, which share covariances."""
    A, B, C, Q, R, m, P = par
    G, N, n = len(y), y.shape[1], len(A)
    m = np.broadcast_to(m, (G, n))
    prior, post = np.empty((N, G, n)), np.empty((N, G, n))
    before, after = np.empty((N, n, n)), np.empty((N, n, n))
    last, value, inputs = None, 0.0, np.moveaxis(v @ B.T, 0, 1)
    same = np.zeros(N, dtype=bool)
    L = inverse = half = np.zeros(0)
    for t in range(N):
        if t:
            m = post[t - 1] @ A.T + inputs[t - 1]
            P = A @ after[t - 1] @ A.T + Q
        prior[t], before[t] = m, P
        e, Ct = y[:, t] - m @ C.T, C
        if seen is not None:
            e, Ct, last = np.where(seen[t], e, 0.0), C * seen[t][:, None], None
        if last is None or np.abs(P - last).max() > 1e-10 * np.abs(P).max():
            V = Ct @ P @ Ct.T + R
            inverse = np.linalg.inv(V)
            half = np.linalg.slogdet(V)[1]
            L = P @ Ct.T @ inverse
            after[t] = P - L @ V @ L.T
            after[t] = (after[t] + after[t].T) / 2
        else:
            before[t], after[t], same[t] = before[t - 1], after[t - 1], True
        last = before[t]
        post[t] = m + e @ L.T
        value -= (G * half + np.einsum("gi,ij,gj", e, inverse, e)) / 2
    x, Ps, cross = post, after.copy(), np.empty((N - 1, n, n))
    J = np.zeros(0)
    for t in range(N - 2, -1, -1):
        if t == N - 2 or not same[t + 1]:
            J = np.linalg.solve(before[t + 1], A @ after[t]).T
        x[t] += (x[t + 1] - prior[t + 1]) @ J.T
        Ps[t] += J @ (Ps[t + 1] - before[t + 1]) @ J.T
        cross[t] = Ps[t + 1] @ J.T
    return _Moments(np.moveaxis(x, 0, 1), Ps, cross, value)


def em(par: Noisy, data: Sequence[Signals], iterations: int = ITERATIONS) -> Noisy:
    """Raise the likelihood by expectation maximisation."""
    groups: dict[tuple[int, bytes], list[Signals]] = defaultdict(list)
    for y, v in data:
        missing = np.isnan(y)
        groups[len(v), missing.tobytes() if missing.any() else b""].append(Signals(y, v))
    batches = []
    for (_, mark), members in groups.items():
        y = np.stack([y for y, _ in members])
        seen = np.isfinite(y[0]) if mark else None
        batches.append((np.nan_to_num(y), np.stack([v for _, v in members]), seen))
    n, steps, before = len(par.A), sum(len(y) for y, _ in data), -np.inf
    for _ in range(iterations):
        moments = [smooth(par, *batch) for batch in batches]
        value = sum(m.likelihood for m in moments) / steps
        if value - before < STALLED:
            break
        before, par = value, _maximise(par, batches, moments, n)
    return par


def _maximise(par: Noisy, batches: list, moments: list[_Moments], n: int) -> Noisy:
    Szz: Any = 0.0
    Sx1 = S11 = Syx = Sxx = Syy = first = Szz
    N = M = 0
    for (y, v, seen), (x, P, cross, _) in zip(batches, moments, strict=True):
        G = len(y)
        z = np.concatenate((x[:, :-1], v), -1).reshape(-1, n + v.shape[-1])
        x1, all_x, ys = x[:, 1:].reshape(-1, n), x.reshape(-1, n), y.reshape(-1, y.shape[-1])
        zz, xz = z.T @ z, x1.T @ z
        zz[:n, :n] += G * P[:-1].sum(0)
        xz[:, :n] += G * cross.sum(0)
        Szz, Sx1, S11 = Szz + zz, Sx1 + xz, S11 + x1.T @ x1 + G * P[1:].sum(0)
        if seen is not None:  # outputs that are missing have their expected moments
            y = np.where(seen, y, x @ par.C.T)
            ys = y.reshape(-1, y.shape[-1])
            for t in np.flatnonzero(~seen.all(1)):
                gone = ~seen[t]
                CP = par.C @ P[t]
                Syx = Syx + G * gone[:, None] * CP
                Syy = Syy + G * np.outer(gone, gone) * (CP @ par.C.T + par.R)
        Syx, Sxx, Syy = Syx + ys.T @ all_x, Sxx + all_x.T @ all_x + G * P.sum(0), Syy + ys.T @ ys
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


# Coordinates


def readable(par: Noisy, data: Sequence[Signals]) -> Innovations:
    """Return the filter's steady state, with the outputs as the first states."""
    A, B, C, Q, R, m0, P0 = par
    P = scipy.linalg.solve_discrete_are(A.T, C.T, Q, R)
    S = C @ P @ C.T + R
    L = np.linalg.solve(S, C @ P).T
    none, zero = np.zeros((len(A), 0)), np.zeros(len(A))
    model = Innovations(A, B, none, zero, C, L, S, m0, P0 - P)
    xi = np.concatenate([model.estimates(y, v, v[:, :0]) for y, v in data])
    root = np.linalg.cholesky(np.cov(xi.T, bias=True).reshape(len(A), -1) + 1e-12 * np.eye(len(A)))
    _, s, Vh = np.linalg.svd(C @ root)
    shown = int((s > HIDDEN * s[0]).sum())
    hidden = np.linalg.solve(root.T, Vh[shown:].T).T
    hidden *= np.sign(hidden[np.arange(len(hidden)), np.abs(hidden).argmax(1)])[:, None]
    T = np.concatenate((C, hidden))
    inverse = np.linalg.pinv(T)
    model = model.transformed(T, inverse, np.zeros(len(T)))
    return model._replace(C=np.eye(len(C), len(T)))
