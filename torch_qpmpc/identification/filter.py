"""The Kalman filter of a linear model, with gains that vary and outputs that may be missing.

The state of a model with the joint noise of state and outputs is predicted and corrected by

    x_k|k = x_k + K_k (y_k - C x_k),      K_k = (P_k C' + N) V_k^-1,  V_k = C P_k C' + R,
    P_k|k = P_k + W - K_k V_k K_k',       P_{k+1} = A P_k|k A' + Q,

with the rows of C, N and R of the outputs that are there. W and N are zero for white noise Q and R
of state and outputs. For an innovations form, Q is zero, W = L R L' and N = L R, and P is the
covariance of its own state, which knows all earlier outputs, given those that there were.
"""

from collections.abc import Hashable, Iterable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torch_qpmpc.qp.kernels.linalg import add_product, compiled, dot

Array = NDArray[Any]
#: A covariance that changes by less than this share has settled.
SAME = 1e-8
#: Directions of a covariance below this share of its size, in unit variances, have none.
SINGULAR = 1e-12


class Course(NamedTuple):
    """The filter's matrices, as often as they change; those of missing outputs are zero."""

    P: Array  # the covariances before the outputs, ``(D, n, n)``
    K: Array  # the gains, ``(D, n, n_y)``
    V: Array  # the covariances of the innovations, ``(D, n_y, n_y)``
    inverse: Array  # their pseudoinverses
    half: Array  # half of the logarithms of their determinants, ``(D,)``
    at: Array  # the place of each step's matrices among these, ``(T,)``
    after: Array  # P_T, before the outputs that follow


class Smoothed(NamedTuple):
    """States given all outputs."""

    x: Array  # means ``(G, T, n)``
    P: Array  # covariances ``(D, n, n)``, as often as they change
    at: Array  # the place of each step's covariance among these, ``(T,)``
    cross: Array  # the sum of neighbours' covariances, ``(n, n)``
    likelihood: float  # its logarithm, up to a constant

    def total(self, steps: Any) -> Array:
        """Return the sum of the covariances of ``steps``, an index of ``(T,)``."""
        return np.tensordot(np.bincount(self.at[steps], minlength=len(self.P)), self.P, 1)


@compiled
def product(out, X, Y):
    """Put X Y into ``out``."""
    for i in range(X.shape[0]):
        for j in range(Y.shape[1]):
            total = 0.0
            for k in range(X.shape[1]):
                total += X[i, k] * Y[k, j]
            out[i, j] = total


@compiled
def near(X, Y, size, share):
    """True if entries differ by at most the ``share`` of what a covariance ``size`` allows."""
    for i in range(len(X)):
        for j in range(len(X)):
            if abs(X[i, j] - Y[i, j]) > share * np.sqrt(max(size[i, i] * size[j, j], 0.0)):
                return False
    return True


@compiled
def course(A, C, W, N, Q, R, L, P, seen, same):
    """Return the parts of a `Course` for the outputs ``seen`` ``(T, n_y)``; see above.

    L is the gain in directions without variance. A covariance whose entries change by less than the
    share ``same`` of the states' variances stays until other outputs are seen.
    """
    (T, n_y), n, d, settled = seen.shape, len(A), -1, False
    Ps, Ks, at = np.empty((T + 1, n, n)), np.empty((T, n, n_y)), np.empty(T, np.int64)
    Vs, inverses, half = np.empty((T, n_y, n_y)), np.zeros((T, n_y, n_y)), np.zeros(T)
    AT, CT, X, Y = A.T.copy(), C.T.copy(), np.empty((n, n)), np.empty((n, n))
    G, H, now, size = np.empty((n, n_y)), np.empty((n, n_y)), np.empty((n, n)), np.empty(n_y)
    w, v, scaled = np.ones(n_y), np.eye(n_y), np.eye(n_y)
    Ps[0] = P
    for t in range(T):
        for a in range(n_y):
            settled &= seen[t, a] == seen[t - 1, a]
        if settled:
            at[t] = d
            continue
        d += 1
        at[t], K, V, inverse = d, Ks[d], Vs[d], inverses[d]
        product(G, Ps[d], CT)
        product(V, C, G)
        for a in range(n_y):
            for b in range(a + 1):
                V[a, b] = (V[a, b] + V[b, a] + R[a, b] + R[b, a]) / 2 * seen[t, a] * seen[t, b]
                V[b, a] = V[a, b]
            size[a] = np.sqrt(V[a, a]) if V[a, a] > 0 else np.inf
            half[d] += np.log(size[a]) if V[a, a] > 0 else 0.0
            for b in range(a):
                part = V[a, b] / (size[a] * size[b])
                scaled[a, b] = scaled[b, a] = part if abs(part) < 2 else 0.0  # NaN
        if n_y > 1:
            w, v = np.linalg.eigh(scaled)
        for k in range(n_y):
            if w[k] > SINGULAR * w[-1]:
                half[d] += np.log(w[k]) / 2
                for a in range(n_y):
                    for b in range(n_y):
                        inverse[a, b] += v[a, k] * v[b, k] / (w[k] * size[a] * size[b])
        # K = (P C' + N) V^- + L (1 - V V^-)
        H[:] = L * seen[t]
        product(K, H, V)
        G += N - K
        product(K, G, inverse)
        K += H
        # A (P + W - K V K') A' + Q
        product(H, K, V)
        product(X, H, K.T.copy())
        now[:] = Ps[d] + W
        product(Y, A, now - X)
        product(X, Y, AT)
        X += Q
        Ps[d + 1] = (X + X.T) / 2
        settled = near(Ps[d + 1], Ps[d], now, same)
    return Ps[: d + 1], Ks[: d + 1], Vs[: d + 1], inverses[: d + 1], half[: d + 1], at, Ps[d + 1]


@compiled
def filtered(A, C, K, at, y, moved, x):
    """Return the states before and after the outputs ``(T, G, n)`` and the innovations.

    These are zero where outputs are missing.

    Args:
        A, C: the model.
        K, at: the gains, and the place of each step's among them.
        y: outputs ``(T, G, n_y)``, NaN where they are missing.
        moved: B u + .. of the steps, ``(T - 1, G, n)``.
        x: the first states' mean ``(n,)``.
    """
    (T, G, n_y), n = y.shape, len(A)
    prior, after, e = np.empty((T, G, n)), np.zeros((T, G, n)), np.zeros((T, G, n_y))
    for t in range(T):
        for g in range(G):
            before, now, L = prior[t, g], after[t, g], K[at[t]]
            for i in range(n):
                before[i] = dot(A[i], after[t - 1, g]) + moved[t - 1, g, i] if t else x[i]
            for a in range(n_y):
                if not np.isnan(y[t, g, a]):
                    e[t, g, a] = y[t, g, a] - dot(C[a], before)
            for i in range(n):
                now[i] = before[i] + dot(L[i], e[t, g])
    return prior, after, e


def smoothed(A: Array, C: Array, run: Course, prior: Array, e: Array) -> Smoothed:
    """Return the smoothed states of white noise, by the recursion of Bryson and Frazier."""
    at, F = run.at, A - A @ run.K @ C
    x, size = smoothed_means(run.P, F, C, run.inverse, at, prior, e)
    N, back = spread(F, C.T @ run.inverse @ C, at, SAME)
    first, place = changes(at, back[:-1])
    P, N_first = run.P[at[first]], N[back[first]]
    P = P - P @ N_first @ P
    k, steps = changes(at[:-1], at[1:], back[1:-1])
    cross = run.P[at[k + 1]] @ N[back[k + 1]]
    cross = (np.eye(len(A)) - cross) @ F[at[k]] @ run.P[at[k]]
    likelihood = -run.half[at].sum() * e.shape[1] - size / 2
    return Smoothed(x, P, place, np.tensordot(np.bincount(steps), cross, 1), float(likelihood))


def changes(*places: Array) -> tuple[Array, Array]:
    """Return the steps at which places change, and the number of changes before each step."""
    new = np.any([np.diff(x, prepend=-1) != 0 for x in places], 0)
    return np.flatnonzero(new), np.cumsum(new) - 1


@compiled
def smoothed_means(P, F, C, inverse, at, prior, e):
    """Return x_t = prior_t + P_t r_t ``(G, T, n)`` and the sum of e' V^-1 e.

    r_t = C' V^-1 e_t + F_t' r_{t+1}, from zero after the end.
    """
    T, G, n = prior.shape
    x, r, w, total = np.empty((G, T, n)), np.zeros((G, n)), np.empty(e.shape[2]), 0.0
    for t in range(T - 1, -1, -1):
        for g in range(G):
            z = x[g, t]
            w[:] = z[:] = 0.0
            add_product(w, e[t, g], inverse[at[t]])
            add_product(z, w, C)
            add_product(z, r[g], F[at[t]])
            total += dot(w, e[t, g])
            r[g], z[:] = z, prior[t, g]
            add_product(z, r[g], P[at[t]])
    return x, total


@compiled
def spread(F, own, at, same):
    """Return N_t = own_t + F_t' N_{t+1} F_t from zero, as often as it changes, and places.

    One that changes by less than the share ``same`` between steps of equal matrices stays.
    """
    T, (_, n, _) = len(at), own.shape
    N, back, half = np.zeros((T + 1, n, n)), np.zeros(T + 1, np.int64), np.empty((n, n))
    d, settled = 0, False
    for t in range(T - 1, -1, -1):
        if not settled or at[t] != at[t + 1]:
            k, d = at[t], d + 1
            product(half, F[k].T.copy(), N[d - 1])
            product(N[d], half, F[k])
            N[d] += own[k]
            settled = near(N[d], N[d - 1], N[d], same)
        back[t] = d
    return N[: d + 1], back


def grouped(keys: Iterable[Hashable]) -> list[list[int]]:
    """Return the places of equal keys together, in the order of the first ones."""
    groups: dict[Hashable, list[int]] = {}
    for i, key in enumerate(keys):
        groups.setdefault(key, []).append(i)
    return list(groups.values())
