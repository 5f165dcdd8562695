"""Maximum likelihood of a linear model with noise, by expectation maximisation."""

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy  # imports its parts at their first use: a fifth of a second

from torch_qpmpc.identification.filter import (
    SAME,
    Array,
    Course,
    Smoothed,
    course,
    filtered,
    grouped,
    smoothed,
)
from torch_qpmpc.identification.innovations import Innovations

#: The gain of the log-likelihood per step that ends expectation maximisation.
STALLED = 1e-4
#: A mode, or a pair, this near to one may be a drift, which forgets at least the share FORGETS a
#: step. A pair as near as TWINS may be one and an integrator.
SLOW, FORGETS, TWINS = 0.2, 1e-3, 0.05
#: The level of the test that inputs move a mode, and the coefficients that the place of a `lasting`
#: one counts for: its ratios are larger (Dickey and Fuller 1981); extrapolations of its fits, and
#: the gain per step that ends them.
LEVEL, ROOT, CYCLES, LEFT = 0.01, 2, 100, 1e-6
#: The least variances of the noise of normalised states and outputs.
FLOOR_Q, FLOOR_R = 1e-12, 1e-8


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


class Group(NamedTuple):
    """Trajectories ``(G, T + 1, ..)`` with the same missing outputs.

    ``kinds`` are the rows ``(K, n_y)`` of outputs that are seen together, ``kind`` ``(T + 1,)``
    the one of each step.
    """

    y: Array
    v: Array
    kinds: Array
    kind: Array


def groups_of(data: Sequence[Signals]) -> list[Group]:
    groups = []
    for rows in grouped(np.isnan(one.y).tobytes() for one in data):
        y, v = map(np.stack, zip(*(data[i] for i in rows), strict=True))
        seen = ~np.isnan(y[0])
        codes = seen @ 2.0 ** np.arange(y.shape[-1])
        _, first, kind = np.unique(codes, return_index=True, return_inverse=True)
        groups.append(Group(y, v, seen[first], kind))
    return groups


def smooth(par: Noisy, group: Group) -> Smoothed:
    """Smooth trajectories."""
    A, B, C, Q, R, m, P = par
    none, zero = np.zeros_like(A), np.zeros_like(C.T)
    parts = map(np.ascontiguousarray, (A, C, none, zero, Q, R, zero, P))
    run = Course(*course(*parts, group.kinds[group.kind], SAME))
    signals = (np.moveaxis(x, 0, 1) for x in (group.y, group.v @ B.T))
    prior, _, e = filtered(*map(np.ascontiguousarray, (A, C, run.K, run.at, *signals, m)))
    return smoothed(A, C, run, prior, e)


@np.errstate(over="ignore", invalid="ignore")  # of leaps that diverge
def em(
    par: Noisy, data: Sequence[Signals], iterations: int, growth: float = 1.0, gain: float = 0.0
) -> Noisy:
    """Raise the likelihood by expectation maximisation; ``par`` if a row gains less than ``gain``.

    With a ``growth`` above 1, steps are lengthened by a factor that grows so in each (Salakhutdinov
    and Roweis 2003); from one that lowers the likelihood it returns, and the factor is 1 again.
    """
    groups, steps = groups_of(data), sum(len(y) for y, _ in data)
    before, least, first, last, plain, factor = -np.inf, -np.inf, par, par, par, 1.0
    for _ in range(iterations):
        moments = [smooth(par, group) for group in groups]
        value = sum(m.likelihood for m in moments) / steps
        least = value + gain if par is first else least
        if par is not plain and not value >= before + STALLED:
            par, factor = plain, 1.0
            continue
        if not value - before >= STALLED:
            plain = plain if np.isfinite(value) else last
            break
        try:
            before, last, plain = value, par, _maximise(groups, moments)
        except np.linalg.LinAlgError:  # the states of an unstable model have no finite squares
            break
        factor, par = factor * growth, plain
        if factor > 1:
            par = _possible(x + factor * (z - x) for x, z in zip(last, plain, strict=True))
    return plain if before >= least else first


def _possible(parts: Iterable[Array]) -> Noisy:
    """Return a model of these parts, with covariances of at least the floors."""
    far = Noisy(*parts)
    least = {"Q": FLOOR_Q, "R": FLOOR_R, "P0": FLOOR_Q}
    return far._replace(**{k: _positive(getattr(far, k), w) for k, w in least.items()})


@np.errstate(over="ignore", invalid="ignore", divide="ignore")  # of leaps that diverge
def likeliest(
    par: Noisy, data: Sequence[Signals], drifts: int = 0, goal: float = -np.inf
) -> tuple[float, Noisy]:
    """Return a maximum of the likelihood, and its model.

    Two iterations of expectation maximisation tell how far to go on in their direction (SQUAREM,
    Varadhan and Roland 2008). It ends where the ``goal`` is out of reach at the pace of the last
    gain. Only noise of their own moves the last ``drifts`` states.
    """
    groups, least = groups_of(data), LEFT * sum(len(y) for y, _ in data)

    def step(parts: Iterable[Array]) -> tuple[float, Noisy]:
        try:
            moments = [smooth(_possible(parts), group) for group in groups]
            if np.isfinite(value := sum(m.likelihood for m in moments)):
                return value, _maximise(groups, moments, drifts)
        except np.linalg.LinAlgError:  # of numbers that overflowed
            pass
        return -np.inf, par

    one, longest, (value, two) = par, 1.0, step(par)
    for _ in range(CYCLES):
        between, three = step(two)
        first = [y - x for x, y in zip(one, two, strict=True)]
        bend = [z - y - x for x, y, z in zip(first, two, three, strict=True)]
        length = np.sqrt(sum((x**2).sum() for x in first) / sum((x**2).sum() for x in bend))
        length = max(1.0, min(length, longest))
        parts = zip(one, first, bend, strict=True)
        far = [x + 2 * length * y + length**2 * z for x, y, z in parts]
        found, longest = step(far), longest * (4.0 if length == longest else 1.0)
        if not found[0] >= between:
            far, found, longest = three, step(three), max(longest / 4.0, 1.0)
        if not found[0] - value >= max(least, (goal - found[0]) / CYCLES):
            break
        one, (value, two) = far, found
    return value, two


@np.errstate(over="ignore", invalid="ignore")  # of an unstable model
def with_drifts(par: Noisy, data: Sequence[Signals]) -> tuple[Noisy, int]:
    """Make drifts of slow modes that the inputs are not shown to move; return model and number.

    A slow mode turns an effect of chance into a large steady gain, of either sign. The likelihood
    ratio decides for a mode, or a pair, at a time. Drifts, no more than outputs, are the last
    states, which noise alone moves.
    """
    drifts, n_y = 0, len(par.C)
    most, full = likeliest(par, data)
    while drifts < n_y:
        own, place, found = len(par.A) - drifts, ROOT * lasting(full.A), []
        for modes in _slow_modes(full.A[:own, :own], full.B[:own]):
            if (count := drifts + len(modes)) <= n_y:
                lost = scipy.stats.chi2.isf(LEVEL, len(modes) * par.B.shape[1] + place) / 2
                value, one = likeliest(_with_drifts(full, modes), data, count, most - lost)
                found.append((value + lost, value, count, one))
        shown, value, count, one = max(found, default=(-np.inf, 0.0, 0, par), key=lambda x: x[0])
        if not shown >= most:
            break
        most, drifts = value, count
        par = full = one
    return par, drifts


def lasting(A: Array) -> bool:
    """Return True if a mode grows, or forgets less than a drift."""
    return bool(np.abs(np.linalg.eigvals(A)).max() > 1 - FORGETS)


def _slow_modes(A: Array, B: Array) -> list[Array]:
    """Return bases ``(1 or 2, n)`` of the left eigenvectors of a mode, or of a pair, near one.

    Of a pair, which a drift and an integrator may seem, there is the direction, too, that inputs
    move least.
    """
    values, left = scipy.linalg.eig(A, left=True, right=False)
    found = []
    for i in np.flatnonzero((np.abs(values - 1) < SLOW) & (values.imag >= 0)):
        x = left[:, i]
        found.append(np.stack((x.real, x.imag) if values[i].imag else (x.real,)))
        if values[i].imag and abs(values[i] - 1) < TWINS:
            pair = np.linalg.qr(found[-1].T)[0].T
            found.append(np.linalg.svd(pair @ B[:, :-1])[0][:, -1:].T @ pair)
    return found


def _with_drifts(par: Noisy, modes: Array) -> Noisy:
    """Return the model with ``modes`` of the first states as drifts, before those that it has.

    The noise of a drift is its own: what it shares with a state moves this through it.
    """
    n, (count, m) = len(par.A), modes.shape
    own, Q = np.arange(m - count, m), par.Q[:m, :m]
    T = np.eye(n)
    T[:m, : m - count] = np.linalg.qr(modes.T, mode="complete")[0][:, count:]
    T[:m, own] = np.linalg.solve(modes @ Q @ modes.T, modes @ Q).T  # modes @ it is one
    back = np.linalg.inv(T)
    A, B, Q = back @ par.A @ T, back @ par.B, back @ par.Q @ back.T
    kept = np.minimum(A[own, own], 1 - FORGETS)
    A[own], B[own] = 0.0, 0.0
    A[own, own] = kept
    return Noisy(A, B, par.C @ T, Q, par.R, back @ par.m0, back @ par.P0 @ back.T)


def _maximise(groups: list[Group], moments: list[Smoothed], drifts: int = 0) -> Noisy:
    """Return the likeliest parameters given the moments of the states.

    An output's row of C is fitted to the steps in which it is seen, and an entry of R to those in
    which both outputs are. To the first states one more is added, anywhere in the log. The last
    ``drifts`` states are moved by noise of their own alone.
    """
    n, n_y = moments[0].x.shape[-1], groups[0].y.shape[-1]
    Szz: Any = 0.0
    N = Sx1 = S11 = Szz
    Sxx, Syx = np.zeros((n_y, n, n)), np.zeros((n_y, n))
    for (y, v, kinds, kind), one in zip(groups, moments, strict=True):
        x, G = one.x, len(y)
        z = np.concatenate((x[:, :-1], v), -1).reshape(-1, n + v.shape[-1])
        x1 = x[:, 1:].reshape(-1, n)
        zz, xz = z.T @ z, x1.T @ z
        zz[:n, :n] += G * one.total(slice(-1))
        xz[:, :n] += G * one.cross
        Szz, Sx1, S11 = Szz + zz, Sx1 + xz, S11 + x1.T @ x1 + G * one.total(slice(1, None))
        for i, seen in enumerate(kinds):
            xs, ys = x[:, kind == i].reshape(-1, n), y[:, kind == i].reshape(-1, n_y)
            xx = xs.T @ xs + G * one.total(kind == i)
            Sxx[seen] += xx
            Syx[seen] += ys[:, seen].T @ xs
        N = N + len(x1)
    AB = np.linalg.solve(_lifted(Szz), Sx1.T).T
    C = np.stack([np.linalg.solve(_lifted(xx), yx) for xx, yx in zip(Sxx, Syx, strict=True)])
    RR, M = np.zeros((n_y, n_y)), np.zeros((n_y, n_y))
    for (y, _, kinds, kind), one in zip(groups, moments, strict=True):
        e = np.where(np.isnan(y), 0.0, y - one.x @ C.T)
        for i, seen in enumerate(kinds):
            both, rows = np.outer(seen, seen), e[:, kind == i].reshape(-1, n_y)
            RR += both * (rows.T @ rows + len(y) * C @ one.total(kind == i) @ C.T)
            M += both * len(rows)
    S = S11 - AB @ Sx1.T
    if drifts:
        own = np.arange(n - drifts, n)
        AB[own] = 0.0
        AB[own, own] = np.minimum(Sx1[own, own] / Szz[own, own], 1 - FORGETS)
        S = S11 - AB @ Sx1.T - Sx1 @ AB.T + AB @ Szz @ AB.T
        S[own, : n - drifts], S[: n - drifts, own] = 0.0, 0.0
    Q = _positive(S / N, FLOOR_Q)
    R = _positive(RR / np.maximum(M, 1), FLOOR_R)
    starts = np.concatenate([m.x[:, 0] for m in moments])
    every = np.concatenate([m.x.reshape(-1, n) for m in moments])
    m0, P0 = starting(starts, every, sum(len(m.x) * m.P[0] for m in moments))
    return Noisy(AB[:, :n], AB[:, n:], C, Q, R, m0, _positive(P0, FLOOR_Q))


def _lifted(S: Array) -> Array:
    return S + 1e-9 * np.trace(S) / len(S) * np.eye(len(S))


def _positive(M: Array, floor: float) -> Array:
    w, v = np.linalg.eigh((M + M.T) / 2)
    return (v * np.maximum(w, floor)) @ v.T


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


def starting(first: Array, every: Array, more: Array | float = 0.0) -> tuple[Array, Array]:
    """Return mean and covariance of the states of a start, and of one more, anywhere in the log.

    ``first`` are the means of the states at G starts, ``more`` the sum of their own covariances.
    The further one weighs 2^-G: a start elsewhere is the less likely the more the log has.
    """
    one = 0.5 ** len(first)
    count = len(first) + one
    mean = (first.sum(0) + one * every.mean(0)) / count
    first, every = first - mean, every - mean
    return mean, (first.T @ first + more + one * every.T @ every / len(every)) / count
