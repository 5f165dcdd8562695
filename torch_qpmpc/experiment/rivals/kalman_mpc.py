"""A Kalman filter with the true model, and MPC from its estimate."""

from __future__ import annotations

from collections.abc import Callable

import scipy
import torch
from torch import Tensor


class KalmanMPC:
    """A policy of outputs: MPC of the state that a stationary Kalman filter estimates.

        y = C x + e,    x+ = A x + B u + v,    v of covariance V, e of covariance E

    Args:
        mpc: maps states ``(starts, n_x)`` to actions ``(starts, n_u)``.
        A, B, C: the model.
        V, E: covariances ``(n_x, n_x)`` and ``(n_y, n_y)``.
        x_0: mean of the start state, ``(n_x,)``.
    """

    def __init__(
        self,
        mpc: Callable[[Tensor], Tensor],
        A: Tensor,
        B: Tensor,
        C: Tensor,
        V: Tensor,
        E: Tensor,
        x_0: Tensor,
    ) -> None:
        P = scipy.linalg.solve_discrete_are(*(m.numpy() for m in (A.mT, C.mT, V, E)))
        P = torch.as_tensor(P)
        self._gain = torch.linalg.solve(C @ P @ C.mT + E, C @ P).mT
        self._mpc, self._model, self._x_0 = mpc, (A, B, C), x_0
        self._predicted: Tensor | None = None

    def begin(self, plant: object, x: Tensor, w: Tensor) -> None:
        """Forget the last episodes."""
        self._predicted = None

    def __call__(self, p: Tensor) -> Tensor:
        """Return actions; the last n_y entries of p ``(starts, n_p)`` are the new outputs."""
        A, B, C = self._model
        y = p[:, -len(C) :]
        predicted = self._x_0 if self._predicted is None else self._predicted
        x = predicted + (y - predicted @ C.mT) @ self._gain.mT
        u = self._mpc(x)
        self._predicted = x @ A.mT + u @ B.mT
        return u
