"""Estimates of a plant's state x and disturbance w, side by side as e: by filter or by window."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.linalg
from scipy.linalg import block_diag

from torch_qpmpc.control.design import Design, half_range
from torch_qpmpc.control.disturbance import RANK, check_observable
from torch_qpmpc.control.state_space import Array
from torch_qpmpc.errors import QPError

#: Default standard deviations, relative to half of the bounds' distance.
SMALL = 0.1
#: A filter's mode this near to the unit circle is on it but for rounding.
ON_CIRCLE = 1e-9
#: Signals above so many times a usual size are no measurements: estimates would lose their digits.
ABSURD = 1e8


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
        stable = np.abs(np.linalg.eigvals(F - F @ L @ H)).max() < 1 - ON_CIRCLE
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


def most(design: Design, noise: Array) -> tuple[Array, Array]:
    """Return the largest sizes of outputs and of known signals that are believed.

    They are `ABSURD` times a usual size. That of an output is the largest of its bounds, of half
    their distance or one, of ``noise`` over `SMALL`, and of what the inputs of a step move it by
    within the horizon; that of a known signal is one, or what moves the state as much as the inputs
    do if that is more. Known signals that move no state are not limited.
    """
    plant, x = design.plant, design.plant.B * _largest(design.u_bounds)
    usual, moved = np.maximum(_largest(design.y_bounds), noise / SMALL), np.linalg.norm(x)
    for _ in range(design.horizon):
        usual = np.maximum(usual, np.abs(plant.C @ x).max(1))
        x = plant.A @ x
    effects = np.linalg.norm(plant.E, axis=0)
    with np.errstate(divide="ignore"):
        known = np.where(effects > 0, np.maximum(1.0, moved / effects), np.inf)
    return ABSURD * usual, ABSURD * known


def _largest(bounds: tuple[Array, Array]) -> Array:
    """Return the largest size of finite bounds, and their half range if that is more."""
    sizes = np.where(np.isfinite(bounds), np.abs(bounds), 0.0).max(0)
    return np.maximum(sizes, half_range(bounds))


def windowed(observer: Observer) -> Observer:
    """Return the observer whose estimate is the one that the last outputs and inputs determine.

    Of q steps: those that have as many outputs as e has entries, L + 1 with a disturbance for each
    output of an identification with L lags. Its gain is F^{q-1} O^{-1} [0; ..; I] with O = [H; H F;
    ..; H F^{q-1}], which makes F - F L H nilpotent.

    Raises:
        QPError: outputs of so many steps do not determine e.
    """
    F, H = observer.F, observer.H
    n_y, steps = len(H), len(F) // len(H)
    powers = [np.linalg.matrix_power(F, k) for k in range(max(steps, 1))]
    O = np.vstack([H @ power for power in powers])  # noqa: E741
    sizes = np.linalg.svd(O, compute_uv=False)
    if len(F) % n_y or sizes[-1] <= RANK * sizes[0]:
        got = f"{len(F)} states and disturbances, which no whole number of {n_y} outputs determines"
        remedy = "Take a model from qm.identify, or leave window out."
        raise QPError.expected("window", got, "a model whose outputs do", remedy)
    last = np.eye(len(F))[:, -n_y:]
    return observer._replace(L=powers[-1] @ np.linalg.solve(O, last))
