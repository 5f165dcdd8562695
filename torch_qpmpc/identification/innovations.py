"""A linear state-space model in innovations form: its filter, its predictions and its noise."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from torch_qpmpc.identification.filter import Array, Course, course, filtered, grouped

#: A gain that differs from the steady one by less than this share has settled.
SETTLED = 1e-9
#: A covariance whose entries change by less than this share of the states' variances stays.
STAYS = 1e-14
#: A disturbance keeps the share DECAY of itself in a step, and changes by DRIFT of an innovation's
#: standard deviation. Its filter is steady after SLOW steps.
DECAY, DRIFT, SLOW = 0.99, 0.01, 2000
#: Smaller singular values of the gain of the outputs, relative to the largest, are zero.
WEAK = 1e-3


class Innovations(NamedTuple):
    r"""A linear model with noise, whose state at the time of decision k has seen y_k.

    With innovations e of covariance S, the filter's steady state is

        \xi_{k+1} = A \xi_k + B u_k + E d_k + offset + L e_{k+1},
        y_{k+1} = C (A \xi_k + B u_k + E d_k + offset) + e_{k+1}.

    The first state has the mean x0 before its output, and P0 is the covariance of its error *minus*
    the steady state's, so that ``C P0 C' + S`` is the covariance of y_0. It is negative in
    directions that are better known at the beginning than later.

    Attributes:
        A: ``(n, n)``.
        B: ``(n, n_u)``.
        E: ``(n, n_d)``.
        offset: ``(n,)``.
        C: ``(n_y, n)``; of a fit ``[I 0]``, so that the first states are the filtered outputs.
        L: ``(n, n_y)``.
        S: ``(n_y, n_y)``.
        x0: ``(n,)``.
        P0: ``(n, n)``.
    """

    A: Array
    B: Array
    E: Array
    offset: Array
    C: Array
    L: Array
    S: Array
    x0: Array
    P0: Array

    @property
    def poles(self) -> Array:
        """The eigenvalues of A, the largest first."""
        poles = np.linalg.eigvals(self.A)
        return poles[np.argsort(-np.abs(poles), kind="stable")]

    def course(self, seen: Array, P: Array | None = None) -> Course:
        """Return the filter's matrices for the outputs that are ``seen``, ``(T, n_y)``.

        P is the first covariance, by default P0. In directions without variance the steady gain
        holds.
        """
        A, C, L, S = self.A, self.C, self.L, self.S
        none, N = np.zeros_like(A), L @ S
        P = self.P0 if P is None else P
        parts = (A, C, N @ L.T, N, none, S, L, P)
        return Course(*course(*map(np.ascontiguousarray, (*parts, seen)), STAYS))

    def settling(self, steps: int, settled: float = SETTLED) -> tuple[Array, Array]:
        """Return the gains L_0, L_1, .. from P0 and their outputs' covariances, at most ``steps``.

        They end before the first gain that is equal to L within the part ``settled`` of it.
        """
        run, size = self.course(np.ones((steps, len(self.C)), bool)), np.sqrt(np.diag(self.S))
        off = np.abs((run.K - self.L) * size).max((1, 2))
        same = np.append(off <= settled * np.abs(self.L * size).max(), True)
        return run.K[: same.argmax()], run.V[: same.argmax()]

    def estimates(self, y: Array, u: Array, d: Array) -> Array:
        r"""Return \xi_0, .., \xi_T ``(*batch, T + 1, n)`` of trajectories of equal length.

        Args:
            y: outputs ``(*batch, T + 1, n_y)``, NaN where they are missing.
            u: inputs ``(*batch, T, n_u)``.
            d: known signals ``(*batch, T, n_d)``.
        """
        n, batch = len(self.A), y.shape[:-2]
        y = y.reshape(-1, *y.shape[-2:])
        inputs = self.inputs(u, d).reshape(len(y), y.shape[1] - 1, n)
        seen, xi = ~np.isnan(y), np.empty((*y.shape[:2], n))
        for rows in grouped(one.tobytes() for one in seen):
            run = self.course(seen[rows[0]])
            signals = (np.moveaxis(x[rows], 0, 1) for x in (y, inputs))
            parts = map(np.ascontiguousarray, (self.A, self.C, run.K, run.at, *signals, self.x0))
            xi[rows] = np.moveaxis(filtered(*parts)[1], 0, 1)
        return xi.reshape(*batch, -1, n)

    def inputs(self, u: Array, d: Array) -> Array:
        """Return B u + E d + offset, ``(*batch, n)``."""
        return u @ self.B.T + d @ self.E.T + self.offset

    def errors(self, y: Array, u: Array, d: Array, horizon: int) -> Array:
        """Return y_{k+h} minus its prediction from the estimate at k, in `estimates`' shapes.

        It is NaN after the end of the trajectory: ``(*batch, T, horizon, n_y)``.
        """
        steps, inputs = u.shape[-2], self.inputs(u, d)
        errors = np.full((*u.shape[:-1], horizon, len(self.C)), np.nan)
        x = self.estimates(y, u, d)[..., :-1, :]
        for h in range(min(horizon, steps)):
            x = x[..., : steps - h, :] @ self.A.T + inputs[..., h:, :]
            errors[..., : steps - h, h, :] = y[..., h + 1 :, :] - x @ self.C.T
        return errors

    def disturbed(self) -> Innovations:
        r"""Return the model with slow disturbances w as further states, and its filter.

        Each output that moves has one, unless all are measured exactly. As innovations do, w adds
        \xi_{k+1} = A \xi_k + .. + G w_k, so that the filter follows what the log has not shown.
        C is [I 0].
        """
        A, B, E, offset, C, L, S, x0, P0 = self
        (n, n_y), size = L.shape, np.sqrt(np.diag(S))
        moves = (A[:n_y] != np.eye(n_y, n)).any(1) & (size > 0)
        if not moves.any() or np.allclose(L, np.eye(n, n_y), 0.0, SETTLED):
            return self
        size, G = size[moves], np.eye(n, n_y)[:, moves]
        own, hidden = np.split(L[:, moves] * size, [n_y])
        G[n_y:] = hidden @ np.linalg.pinv(own[moves] / size[:, None], WEAK) / size
        below = (0, len(size)), (0, 0)
        F = np.hstack((np.pad(A, below), np.vstack((G, DECAY * np.eye(len(size))))))
        B, E, L, H = (*(np.pad(x, below) for x in (B, E, L)), np.pad(C, below[::-1]))
        offset, x0 = (np.pad(x, below[0]) for x in (offset, x0))
        drift = np.diag(np.append(np.zeros(n), DRIFT * size) ** 2)
        parts = F, H, L @ S @ L.T, L @ S, drift, S, L, drift, np.ones((SLOW, n_y), bool)
        run = Course(*course(*map(np.ascontiguousarray, parts), STAYS))
        P0 = np.pad(P0, below[:1] * 2) + drift / (1 - DECAY**2) - run.after
        return Innovations(F, B, E, offset, H, run.K[-1], run.V[-1], x0, P0)

    def transformed(self, T: Array, inverse: Array, shift: Array) -> Innovations:
        r"""Return the model of the states T \xi + shift; ``inverse @ T`` is the identity."""
        A = T @ self.A @ inverse
        offset = T @ self.offset + shift - A @ shift
        ends = T @ self.L, self.S, T @ self.x0 + shift, T @ self.P0 @ T.T
        return Innovations(A, T @ self.B, T @ self.E, offset, self.C @ inverse, *ends)
