"""A linear state-space model in innovations form: its filter, its predictions and its noise."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
#: A gain that differs from the steady one by less than this share has settled.
SETTLED = 1e-9
#: Directions of a covariance below this share of its size, in unit variances, have none.
SINGULAR = 1e-12


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

    def gain(self, P: Array) -> tuple[Array, Array, Array]:
        """Return L_k, the covariance of e_k and P_{k+1} from P_k ``(n, n)``."""
        C, L, S = self.C, self.L, self.S
        V = C @ P @ C.T + S
        inverse = _inverse(V)
        # In directions without variance the steady gain holds.
        gain = (P @ C.T + L @ S) @ inverse + L @ (np.eye(len(C)) - V @ inverse)
        P = self.A @ (P + L @ S @ L.T - gain @ V @ gain.T) @ self.A.T
        return gain, V, (P + P.T) / 2

    def settling(self, steps: int, settled: float = SETTLED) -> Iterator[tuple[Array, Array]]:
        """Yield the gains L_0, L_1, .. from P0 and their outputs' covariances, at most ``steps``.

        They end before the first gain that is equal to L within the part ``settled`` of it.
        """
        P, size = self.P0, np.sqrt(np.maximum(np.diag(self.S), 0))
        for _ in range(steps):
            gain, V, P = self.gain(P)
            if np.abs((gain - self.L) * size).max() <= settled * np.abs(self.L * size).max():
                return
            yield gain, V

    def gains(self, steps: int, settled: float = SETTLED) -> Array:
        """Return the gains of `settling` ``(steps', n, n_y)``."""
        gains = [gain for gain, _ in self.settling(steps, settled)]
        return np.array(gains).reshape(-1, *self.L.shape)

    def estimates(self, y: Array, u: Array, d: Array) -> Array:
        r"""Return \xi_0, .., \xi_T ``(*batch, T + 1, n)`` of trajectories of equal length.

        Args:
            y: outputs ``(*batch, T + 1, n_y)``.
            u: inputs ``(*batch, T, n_u)``.
            d: known signals ``(*batch, T, n_d)``.
        """
        inputs, gains = self.inputs(u, d), self.gains(y.shape[-2])
        xi, x = np.empty((*y.shape[:-1], len(self.A))), self.x0
        for k in range(y.shape[-2]):
            e = y[..., k, :] - x @ self.C.T
            xi[..., k, :] = x + e @ (gains[k] if k < len(gains) else self.L).T
            if k < inputs.shape[-2]:
                x = xi[..., k, :] @ self.A.T + inputs[..., k, :]
        return xi

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

    def remembering(self, pole: float | None) -> Innovations:
        r"""Return the model with m_{k+1} = pole m_k + (1 - pole) [C \xi_k; u_k] as further states.

        m_0 is [C x0; 0]. None adds none.
        """
        if pole is None:
            return self
        (n, n_u), n_y = self.B.shape, len(self.C)
        T = np.eye(n + n_y + n_u, n)
        model = self.transformed(T, T.T, np.zeros(len(T)))
        model.A[n:, n:] = pole * np.eye(n_y + n_u)
        model.A[n : n + n_y, :n] = (1 - pole) * self.C
        model.B[n + n_y :] = (1 - pole) * np.eye(n_u)
        model.x0[n : n + n_y] = self.C @ self.x0
        return model

    def transformed(self, T: Array, inverse: Array, shift: Array) -> Innovations:
        r"""Return the model of the states T \xi + shift; ``inverse @ T`` is the identity."""
        A = T @ self.A @ inverse
        offset = T @ self.offset + shift - A @ shift
        ends = T @ self.L, self.S, T @ self.x0 + shift, T @ self.P0 @ T.T
        return Innovations(A, T @ self.B, T @ self.E, offset, self.C @ inverse, *ends)


def _inverse(V: Array) -> Array:
    """Return the pseudoinverse of a covariance, in unit variances."""
    size = np.sqrt(np.maximum(np.diagonal(V), 0))
    scale = np.divide(1, size, out=np.zeros_like(size), where=size > 0)
    scale = scale[:, None] * scale
    return scale * np.linalg.pinv(scale * V, SINGULAR, True)
