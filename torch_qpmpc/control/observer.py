"""Estimates of a plant's state x and disturbance w, side by side as e, by a Kalman filter."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import scipy.linalg
from scipy.linalg import block_diag

from torch_qpmpc.control.design import Design, largest
from torch_qpmpc.control.disturbance import check_observable
from torch_qpmpc.control.state_space import Array
from torch_qpmpc.errors import QPError
from torch_qpmpc.identification.innovations import Innovations
from torch_qpmpc.mpc.validation import read_numbers

#: Default standard deviations, relative to half of the bounds' distance.
SMALL = 0.1
#: The noise of an identified output, relative to its usual deviation, at least.
LEAST = 1e-3
#: A filter's mode this near to the unit circle counts as on it.
ON_CIRCLE = 1e-9
#: A smaller singular value, relative to the largest, determines no estimate at rest.
REST = 1e-12
#: A gain that differs from the steady one by a smaller part of it is steady, ..
SETTLED = 1e-2
#: .. and so is each after so many.
MOST_GAINS = 100
#: Where outputs were missing, the gain is the steady one again within this part of it.
STEADY = 1e-9
#: Signals above this multiple of a usual size are errors: estimates would lose their digits.
ABSURD = 1e8


class Observer(NamedTuple):
    """e = [x; w] is predicted by ``F e + G u + E d + offset``, and corrected by ``L_k (y - H e)``.

    P is the covariance of e given the outputs that there were, around the e that knows all of them:
    zero once all were seen for long.
    """

    #: The model of e, and its outputs.
    F: Array
    G: Array
    E: Array
    offset: Array
    H: Array
    S: Array  # the covariance of y - H e in the steady state, ``(n_y, n_y)``
    P: Array  # the first P, zero without a log, ``(n_e, n_e)``
    gains: Array  # L_0, .., L_T, ``(T + 1, n_e, n_y)``: the steady one at last, alone without a log
    start: Array  # the mean of e in the log, where a controller starts
    #: The map of [-G u - E d - offset; y] to the e that rests with u, d and y, where it starts
    #: without a log.
    rest: Array

    @property
    def L(self) -> Array:
        """The steady gain."""
        return self.gains[-1]

    def predicted(self, e: Array, u: Array, d: Array) -> Array:
        """Return the e after e with the input u and the known signals d."""
        return self.F @ e + self.G @ u + self.E @ d + self.offset

    @property
    def model(self) -> Innovations:
        """The model of e in innovations form, without inputs."""
        none, mean = np.zeros((len(self.F), 0)), self.start
        return Innovations(self.F, none, none, mean, self.H, self.L, self.S, mean, self.P)

    def with_gain(self, gain: Any) -> Observer:
        """Return the observer with another L, or with the one that ``gain(F, H)`` returns.

        Raises:
            QPError: its shape is wrong, or errors of the estimates do not decay with it.
        """
        L = read_numbers("gain", gain(self.F, self.H) if callable(gain) else gain).numpy().copy()
        if L.shape != (shape := self.L.shape) or not np.isfinite(L).all():
            raise QPError.expected("gain", f"shape {L.shape}, or NaN", f"finite numbers of {shape}")
        radius = np.abs(np.linalg.eigvals(self.F - self.F @ L @ self.H)).max()
        if radius >= 1 - ON_CIRCLE:
            got = f"errors of {radius:.4g} times the last step's"
            raise QPError.expected("gain", got, "F - F L H with eigenvalues within the unit circle")
        return self._replace(gains=L[None], P=np.zeros_like(self.P))

    def spread(self, k: int) -> Array:
        """Return P after k steps with all outputs."""
        if k == len(self.gains) - 1:
            return np.zeros_like(self.F)
        return self.model.course(np.ones((k, len(self.H)), bool)).after

    def corrected(self, P: Array, seen: Array) -> tuple[Array, Array | None]:
        """Return the gain for the outputs that are ``seen`` and the next P, None once steady."""
        run, size = self.model.course(seen[None], P), np.sqrt(np.diag(self.S))
        off, gain = np.abs(run.K[0] - self.L) * size, np.abs(self.L) * size
        steady = seen.all() and (off.max(1) <= STEADY * gain.max(1)).all()
        return run.K[0], None if steady else run.after

    def at_rest(self, u: Array, d: Array, y: Array) -> Array:
        """Return the e that rests with u, d and y."""
        return self.rest @ np.concatenate((-self.predicted(np.zeros(len(self.F)), u, d), y))


def kalman(design: Design, noise: Array, drift: Array) -> Observer:
    """Return the Kalman filter of a design's model, with its gains until it is steady.

    ``noise`` ``(n_y,)`` and ``drift`` ``(n_w,)`` are standard deviations of the outputs' noise and
    of the disturbances' changes. The state's noise is the identification's, else that of inputs
    with `SMALL` of their half ranges. The first state is one of the identification's log, with
    disturbances that move the outputs by `SMALL` of their usual deviations.

    Raises:
        QPError: the model has a mode that the outputs do not show, or that no input moves.
    """
    model, (of_y, _, of_x, _) = design.plant, design.scaling
    of_w = design.of_w(of_y)
    plant, w, n_w = design.normal.plant, design.normal.disturbances, len(of_w)
    noise, drift, of_e = noise / of_y, drift / of_w, np.concatenate((of_x, of_w))
    n, _, n_y, _ = plant.sizes
    check_observable(plant)
    F = np.block([[plant.A, w.B], [np.zeros((n_w, n)), np.eye(n_w)]])
    H = np.hstack((plant.C, w.C))
    V, process, G = np.diag(noise**2), SMALL**4 * plant.B @ plant.B.T, np.zeros((n + n_w, n_y))
    if plant.noise is not None:  # x+ = A x + B u + G e and y = H [x; w] + e before its correction
        S = floored(plant.noise[1], design.usual / of_y)
        size = noise / np.sqrt(np.diag(S))
        V = size[:, None] * S * size
        G[:n] = plant.noise[0] / size
        process = (F @ G @ V @ G.T @ F.T)[:n, :n]
    try:
        process = block_diag(process, np.diag(drift**2))
        P = scipy.linalg.solve_discrete_are(F.T, H.T, process, V, s=F @ G @ V)
        L = np.linalg.solve(H @ P @ H.T + V, H @ P + V @ G.T).T
        stable = np.abs(np.linalg.eigvals(F - F @ L @ H)).max() < 1 - ON_CIRCLE
    except (ValueError, np.linalg.LinAlgError):
        P, L, stable = np.zeros((n + n_w, n + n_w)), np.zeros((n + n_w, n_y)), False
    if not stable:
        got = "a model whose Kalman filter does not converge"
        remedy = "It has a mode on the unit circle that no input moves: remove it."
        raise QPError.expected("model", got, "a model with a steady-state filter", remedy)
    start, gains, S, first = np.zeros(n + n_w), L[None], H @ P @ H.T + V, np.zeros_like(P)
    if plant.visited is not None:
        start[:n] = plant.visited[0]
        loads = np.diag((moving(design, SMALL * design.usual) / of_w) ** 2)
        none = np.zeros((n + n_w, 0))
        first = np.asarray(block_diag(plant.visited[1], loads)) - P
        filtered = Innovations(F, none, none, start, H, L, S, start, first)
        gains = np.concatenate((filtered.settling(MOST_GAINS, SETTLED)[0], gains))
    rest = np.linalg.pinv(np.vstack((F - np.eye(n + n_w), H)), rcond=REST)
    below, own = ((0, n_w), (0, 0)), design.disturbances
    return Observer(
        np.block([[model.A, own.B], [F[n:]]]),
        np.pad(model.B, below),
        np.pad(model.E, below),
        np.pad(model.offset, (0, n_w)),
        np.hstack((model.C, own.C)),
        of_y[:, None] * S * of_y,
        of_e[:, None] * first * of_e,
        of_e[:, None] * gains / of_y,
        of_e * start,
        of_e[:, None] * rest / np.concatenate((of_e, of_y)),
    )


def moving(design: Design, sizes: Array) -> Array:
    """Return the disturbances that move an output by its size within the horizon, ``(n_w,)``.

    An input's is at most `SMALL` of its range.
    """
    plant, w = design.plant, design.disturbances
    x, moved = np.zeros(w.B.shape), np.abs(w.C)
    for _ in range(design.horizon):
        x = plant.A @ x + w.B
        moved = np.maximum(moved, np.abs(plant.C @ x + w.C))
    with np.errstate(divide="ignore"):
        by_output = (sizes[:, None] / moved).min(0, initial=np.inf)
    return np.minimum(by_output, SMALL * design.of_w(np.full(len(sizes), np.inf)))


def floored(S: Array, usual: Array) -> Array:
    """Return a covariance of outputs with `LEAST` of their usual deviations at least."""
    return S + np.diag((LEAST * usual) ** 2)


def max_plausible(design: Design, noise: Array) -> tuple[Array, Array]:
    """Return the largest plausible sizes of outputs, ``(n_y,)``, and known signals, ``(n_d,)``.

    They are `ABSURD` times a usual size. An output's is the largest of its bounds, its usual
    deviation, ``noise`` over `SMALL`, and its response to a step of the inputs within the horizon.
    Known signals that move no state are not limited.
    """
    sizes_y = np.maximum(largest(design.y_bounds), design.usual)
    plant, sizes_u = design.plant, np.maximum(largest(design.u_bounds), design.scaling.u)
    usual, x = np.maximum(sizes_y, noise / SMALL), plant.B * sizes_u
    for _ in range(design.horizon):
        usual, x = np.maximum(usual, np.abs(plant.C @ x).max(1)), plant.A @ x
    return ABSURD * usual, np.where(plant.E.any(0), ABSURD * design.scaling.d, np.finfo(float).max)
