"""The steady-state Kalman filter of a plant's state x and disturbance w, side by side as e."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.linalg
from scipy.linalg import block_diag

from torch_qpmpc.control.design import Design, half_range
from torch_qpmpc.control.disturbance import check_observable
from torch_qpmpc.control.state_space import Array
from torch_qpmpc.errors import QPError

#: Default standard deviations, relative to half of the bounds' distance.
SMALL = 0.1


class Observer(NamedTuple):
    """e = [x; w] is predicted by ``F e + G u + E d + offset``, and corrected by ``L (y - H e)``.

    Attributes:
        F, G, E, offset: the model of e.
        H: the outputs of e.
        L: the gain.
        rest: the map of [-G u - E d - offset; y] to the e that rests with u, d and y.
    """

    F: Array
    G: Array
    E: Array
    offset: Array
    H: Array
    L: Array
    rest: Array


def kalman(design: Design, noise: Array, drift: Array) -> Observer:
    """Return the steady-state Kalman filter of a design's model.

    Its noises are white: of each input, with a small part of the input's range as standard
    deviation; of each output; and of the change of each disturbance in a step.

    Args:
        design: the design.
        noise: standard deviations of the outputs' noise, ``(n_y,)``.
        drift: those of the disturbances' changes, ``(n_w,)``.

    Raises:
        QPError: the model has a mode that the outputs do not show, or that no input moves.
    """
    plant, w = design.plant, design.disturbances
    n, _, n_y, _ = plant.sizes
    n_w = len(w.names)
    check_observable(plant)
    F = np.block([[plant.A, w.B], [np.zeros((n_w, n)), np.eye(n_w)]])
    H = np.hstack((plant.C, w.C))
    inputs = plant.B * (SMALL**2 * half_range(design.u_bounds))
    process = block_diag(inputs @ inputs.T, np.diag(drift**2))
    try:
        P = scipy.linalg.solve_discrete_are(F.T, H.T, process, np.diag(noise**2))
        L = np.linalg.solve(H @ P @ H.T + np.diag(noise**2), H @ P).T
        stable = np.abs(np.linalg.eigvals(F - F @ L @ H)).max() < 1 - 1e-9
    except (ValueError, np.linalg.LinAlgError):
        L, stable = np.zeros((n + n_w, n_y)), False
    if not stable:
        got = "a model whose Kalman filter does not converge"
        remedy = "It has a mode on the unit circle that no input moves: remove it."
        raise QPError.expected("model", got, "a model with a steady-state filter", remedy)
    below = ((0, n_w), (0, 0))
    return Observer(
        F,
        np.pad(plant.B, below),
        np.pad(plant.E, below),
        np.pad(plant.offset, (0, n_w)),
        H,
        L,
        np.linalg.pinv(np.vstack((F - np.eye(n + n_w), H)), rcond=1e-12),
    )
