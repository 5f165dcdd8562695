"""The Kalman filter of a linear model, with gains that vary and outputs that may be missing.

The state of a model with the joint noise of state and outputs is predicted and corrected by

    x_k|k = x_k + K_k (y_k - C x_k),      K_k = (P_k C' + N) V_k^-1,  V_k = C P_k C' + R,
    P_k|k = P_k + W - K_k V_k K_k',       P_{k+1} = A P_k|k A' + Q,

with the rows of C, N and R of the outputs that are there. W and N are zero for white noise Q and R
of state and outputs. For an innovations form, Q is zero, W = L R L' and N = L R, and P is the
covariance of its own state, which knows all earlier outputs, given those that there were.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torch_qpmpc.qp.kernels.linalg import compiled

Array = NDArray[Any]
#: A covariance that changes by less than this share has settled.
SAME = 1e-8
#: Directions of a covariance below this share of its size, in unit variances, have none.
SINGULAR = 1e-12


class Course(NamedTuple):
    """The filter's matrices in each step; those of missing outputs are zero.

    Attributes:
        P: the covariances before the outputs, ``(T, n, n)``.
        K: the gains, ``(T, n, n_y)``.
        V: the covariances of the innovations, ``(T, n_y, n_y)``.
        inverse: their pseudoinverses.
        half: half of the logarithms of their determinants, ``(T,)``.
        after: P_T, before the outputs that follow.
    """

    P: Array
    K: Array
    V: Array
    inverse: Array
    half: Array
    after: Array


class Smoothed(NamedTuple):
    """Means ``(G, T, n)`` given all outputs, their covariances, and neighbours', ``(T - 1, n, n)``.

    ``likelihood`` is its logarithm, up to a constant.
    """

    x: Array
    P: Array
    cross: Array
    likelihood: float


@compiled
def course(A, C, W, N, Q, R, L, P, seen, same):
    """Return the parts of a `Course` for the outputs ``seen`` ``(T, n_y)``; see above.

    L is the gain in directions without variance. A covariance whose entries change by less than the
    share ``same`` of the states' variances between complete rows stays.
    """
    T, n_y = seen.shape
    n = len(A)
    Ps, Ks = np.zeros((T, n, n)), np.zeros((T, n, n_y))
    Vs, inverses, half = np.zeros((T, n_y, n_y)), np.zeros((T, n_y, n_y)), np.zeros(T)
    P, X, Y, size_x = P.copy(), np.zeros((n, n)), np.zeros((n, n)), np.zeros(n)
    places = np.zeros(n_y, np.int64)
    settled = False
    for t in range(T):
        m = 0
        for i in range(n_y):
            if seen[t, i]:
                places[m] = i
                m += 1
        if settled and m == n_y:
            Ps[t], Ks[t], Vs[t] = P, Ks[t - 1], Vs[t - 1]
            inverses[t], half[t] = inverses[t - 1], half[t - 1]
            continue
        G, V = np.zeros((n, m)), np.zeros((m, m))
        for i in range(n):
            for b in range(m):
                total = N[i, places[b]]
                for j in range(n):
                    total += P[i, j] * C[places[b], j]
                G[i, b] = total
        for a in range(m):
            for b in range(m):
                total = R[places[a], places[b]]
                for j in range(n):
                    total += C[places[a], j] * (G[j, b] - N[j, places[b]])
                V[a, b] = total
        size = np.zeros(m)
        for a in range(m):
            size[a] = np.sqrt(max(V[a, a], 0.0))
        scaled = np.zeros((m, m))
        for a in range(m):
            for b in range(m):
                if size[a] > 0 and size[b] > 0:
                    scaled[a, b] = (V[a, b] + V[b, a]) / (2 * size[a] * size[b])
        inverse = np.zeros((m, m))
        if m == 1:
            if size[0] > 0:
                inverse[0, 0] = 1 / V[0, 0]
                half[t] = np.log(size[0])
        elif m > 1:
            w, v = np.linalg.eigh(scaled)
            for k in range(m):
                if w[k] > SINGULAR * w[m - 1]:
                    half[t] += np.log(w[k]) / 2
                    for a in range(m):
                        for b in range(m):
                            if size[a] > 0 and size[b] > 0:
                                inverse[a, b] += v[a, k] * v[b, k] / (w[k] * size[a] * size[b])
            for a in range(m):
                if size[a] > 0:
                    half[t] += np.log(size[a])
        # K = G V^- + L (1 - V V^-)
        for i in range(n):
            for b in range(m):
                total = L[i, places[b]]
                for a in range(m):
                    rest = G[i, a]
                    for c in range(m):
                        rest -= L[i, places[c]] * V[c, a]
                    total += rest * inverse[a, b]
                Ks[t, i, places[b]] = total
        for a in range(m):
            for b in range(m):
                Vs[t, places[a], places[b]] = V[a, b]
                inverses[t, places[a], places[b]] = inverse[a, b]
        Ps[t] = P
        for i in range(n):
            for j in range(n):
                X[i, j] = P[i, j] + W[i, j]
            for b in range(m):
                total = 0.0
                for a in range(m):
                    total += Ks[t, i, places[a]] * V[a, b]
                for j in range(n):
                    X[i, j] -= total * Ks[t, j, places[b]]
        for i in range(n):
            for j in range(n):
                total = 0.0
                for k in range(n):
                    total += A[i, k] * X[k, j]
                Y[i, j] = total
        for i in range(n):
            for j in range(n):
                total = Q[i, j]
                for k in range(n):
                    total += Y[i, k] * A[j, k]
                X[i, j] = total
        settled = m == n_y
        for i in range(n):
            size_x[i] = np.sqrt(max(P[i, i] + W[i, i], 0.0))
        for i in range(n):
            for j in range(n):
                Y[i, j] = (X[i, j] + X[j, i]) / 2
                if abs(Y[i, j] - P[i, j]) > same * size_x[i] * size_x[j]:
                    settled = False
        P[:] = Y
    return Ps, Ks, Vs, inverses, half, P


@compiled
def filtered(A, C, K, y, moved, x):
    """Return the predictions ``(T, G, n)`` of states and the innovations, zero where missing.

    Args:
        A, C: the model.
        K: the gains of each step, ``(T, n, n_y)``.
        y: outputs ``(T, G, n_y)``, NaN where they are missing.
        moved: B u + .. of the steps, ``(T - 1, G, n)``.
        x: the first states' mean ``(n,)``.
    """
    T, G, n_y = y.shape
    n = len(A)
    prior, e, z = np.empty((T, G, n)), np.zeros((T, G, n_y)), np.empty(n)
    for g in range(G):
        prior[0, g] = x
    for t in range(T):
        for g in range(G):
            for a in range(n_y):
                if not np.isnan(y[t, g, a]):
                    e[t, g, a] = y[t, g, a]
                    for i in range(n):
                        e[t, g, a] -= C[a, i] * prior[t, g, i]
            for i in range(n):
                z[i] = prior[t, g, i]
                for a in range(n_y):
                    z[i] += K[t, i, a] * e[t, g, a]
            for i in range(n if t + 1 < T else 0):
                total = moved[t, g, i]
                for j in range(n):
                    total += A[i, j] * z[j]
                prior[t + 1, g, i] = total
    return prior, e


def smoothed(A: Array, C: Array, run: Course, prior: Array, e: Array) -> Smoothed:
    """Return the smoothed states of white noise, by the recursion of Bryson and Frazier."""
    weighted = applied(run.inverse, e)
    likelihood = -run.half.sum() * e.shape[1] - (weighted * e).sum() / 2
    F, CV = A - A @ run.K @ C, C.T @ run.inverse
    back, own = applied(CV, e), CV @ C
    turned = F.swapaxes(-1, -2)
    # r_{t-1} = C' V^-1 e_t + F_t' r_t, from r_{T-1} = 0
    zero = np.zeros_like(back[0])
    r = recursion(turned[::-1].copy(), back[::-1].copy(), zero)[::-1]
    N = spread(turned.copy(), own.copy(), np.zeros_like(own[0]))
    P = run.P - run.P @ N[:-1] @ run.P
    cross = (np.eye(len(A)) - run.P[1:] @ N[1:-1]) @ F[:-1] @ run.P[:-1]
    x = prior + applied(run.P, r[:-1])
    return Smoothed(np.moveaxis(x, 0, 1), P, cross, float(likelihood))


def alike(seen: Array) -> list[list[int]]:
    """Return the places of trajectories ``(G, T, n_y)`` with the same missing outputs together."""
    groups: dict[bytes, list[int]] = {}
    for i, one in enumerate(seen):
        groups.setdefault(one.tobytes(), []).append(i)
    return list(groups.values())


def applied(M: Array, x: Array) -> Array:
    """Return the products of x ``(T, G, n)`` with the matrices of each step ``(T, .., n)``."""
    return np.matmul(x, M.swapaxes(-1, -2))


@compiled
def recursion(M, c, z):
    """Return z_0 = z and z_{t+1} = M_t z_t + c_t, ``(T + 1, G, n)``."""
    T, G, n = c.shape
    out = np.empty((T + 1, G, n))
    out[0] = z
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
    out[T] = last
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
