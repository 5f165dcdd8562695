"""Steady states (x_s, u_s) of a plant, and the one for a set-point.

The steady states for a disturbance w and known signals d are the affine set

    [x_s; u_s] = Z v + M [w; d; 1],   Z a basis of the null space of [A - I, B].

Among those that are as near to a set-point, the one with the least u_s'R u_s is the target. Where
several have the same outputs with a weight, v = [a; f]: a determines these outputs, and f is the
distance from the one with the least u_s'R u_s, small multiples of x_s and u_s added.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from torch_qpmpc.control.disturbance import RANK, Disturbances, null_direction
from torch_qpmpc.control.state_space import Array, StateSpace
from torch_qpmpc.errors import QPError

#: The weight of v among steady states with the same outputs, relative to that of the inputs.
REGULARISATION = 1e-3


@dataclass(frozen=True, eq=False)
class Steady:
    """The steady states of a plant, as linear maps of [w; d; 1].

    Attributes:
        X, U, Y: those of v to x_s, u_s and y_s, ``(n, n_v)``, ``(m, n_v)`` and ``(n_y, n_v)``.
        x, u, y: those of [w; d; 1], with n_w + n_d + 1 columns.
        Q, R: the weights of the target's outputs and inputs; R is the identity in place of zero.
        W: the weight of f, ``(n_f, n_f)``.
    """

    X: Array
    U: Array
    Y: Array
    x: Array
    u: Array
    y: Array
    Q: Array
    R: Array
    W: Array

    @classmethod
    def of(cls, plant: StateSpace, w: Disturbances, Q: Array, R: Array) -> Steady:
        """Return the steady states of ``plant`` with disturbances ``w`` and the weights Q and R.

        Raises:
            QPError: no input moves a mode at one.
        """
        n, m, _, n_d = plant.sizes
        balance = np.hstack((plant.A - np.eye(n), plant.B))
        if null_direction(plant.A.T - np.eye(n), plant.B.T) is not None:
            remedy = "Pass a constant of the model as a known signal, by E."
            got = "a mode at 1 that no input moves"
            raise QPError.expected("model", got, "a model with a steady state", remedy)
        Z = scipy.linalg.null_space(balance, rcond=RANK)
        Z = np.where(np.abs(Z) < RANK, 0.0, Z)  # rounding would let a bound hold by a huge v
        loads = np.hstack((w.B, plant.E, plant.offset[:, None]))
        M = -np.linalg.pinv(balance) @ loads
        y = plant.C @ M[:n] + np.hstack((w.C, np.zeros((len(plant.C), n_d + 1))))
        R = R if R.any() else np.eye(m)
        X, U, Y, x, u = Z[:n], Z[n:], plant.C @ Z[:n], M[:n], M[n:]
        sizes, V = np.linalg.eigh(Y.T @ Q @ Y)
        free = sizes <= RANK * max(sizes[-1], RANK)
        W = np.zeros((0, 0))
        if free.any():
            F = V[:, free]
            W = F.T @ U.T @ R @ U @ F + REGULARISATION * np.trace(R) * np.eye(F.shape[1])
            least = -np.linalg.solve(W, F.T @ U.T @ R)  # f of the least u'R u, for u without it
            T = np.hstack((V[:, ~free] + F @ least @ U @ V[:, ~free], F))
            x, y, u = (of + basis @ F @ least @ u for of, basis in ((x, X), (y, Y), (u, U)))
            X, U, Y = X @ T, U @ T, Y @ T
        return cls(X, U, Y, x, u, y, Q, R, W)

    @property
    def n_a(self) -> int:
        """The number of entries of a, which determine the outputs with a weight."""
        return self.Y.shape[1] - len(self.W)
