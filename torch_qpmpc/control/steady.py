"""Steady states (x_s, u_s) of a plant, and the one for a set-point.

The steady states for a disturbance w and known signals d are the affine set

    [x_s; u_s] = Z v + M [w; d; 1],   Z a basis of the null space of [A - I, B].

Among those that are as near to a set-point, the one with the least u_s'R u_s is the target.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from torch_qpmpc.control.disturbance import RANK, Disturbances
from torch_qpmpc.control.state_space import Array, StateSpace
from torch_qpmpc.errors import QPError


@dataclass(frozen=True, eq=False)
class Steady:
    """The steady states of a plant, as linear maps of [w; d; 1].

    Attributes:
        X, U, Y: those of v to x_s, u_s and y_s, ``(n, n_v)``, ``(m, n_v)`` and ``(n_y, n_v)``.
        x, u, y: those of [w; d; 1], with n_w + n_d + 1 columns.
        Q, R: the weights of the target's outputs and inputs; R is the identity in place of zero.
    """

    X: Array
    U: Array
    Y: Array
    x: Array
    u: Array
    y: Array
    Q: Array
    R: Array

    @classmethod
    def of(cls, plant: StateSpace, w: Disturbances, Q: Array, R: Array) -> Steady:
        """Return the steady states of ``plant`` with disturbances ``w`` and the weights Q and R.

        Raises:
            QPError: no input moves a mode at one.
        """
        n, m, _, n_d = plant.sizes
        balance = np.hstack((plant.A - np.eye(n), plant.B))
        sizes = np.linalg.svd(balance, compute_uv=False)
        if sizes[-1] <= RANK * sizes[0]:
            remedy = "Pass a constant of the model as a known signal, by E."
            got = "a mode at 1 that no input moves"
            raise QPError.expected("model", got, "a model with a steady state", remedy)
        Z = scipy.linalg.null_space(balance, rcond=RANK)
        Z = np.where(np.abs(Z) < RANK, 0.0, Z)  # rounding would let a bound hold by a huge v
        loads = np.hstack((w.B, plant.E, plant.offset[:, None]))
        M = -np.linalg.pinv(balance) @ loads
        y = plant.C @ M[:n] + np.hstack((w.C, np.zeros((len(plant.C), n_d + 1))))
        R = R if R.any() else np.eye(m)
        return cls(Z[:n], Z[n:], plant.C @ Z[:n], M[:n], M[n:], y, Q, R)

    @property
    def is_free(self) -> bool:
        """True if several steady states have the same outputs with a weight."""
        sizes = np.linalg.eigvalsh(self.Y.T @ self.Q @ self.Y)
        return bool(sizes[0] <= RANK * max(sizes[-1], RANK))
