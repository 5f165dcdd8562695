"""Steady states of closed loops of random plants, beside an independent search for the nearest.

The slow tests draw 8 plants, in Python and in C, and 200 with
``PLANTS=200 pytest -m slow tests/control/test_offset.py``.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import qpsolvers
import scipy.linalg

import torch_qpmpc as qm
from tests.control.test_exporting import load

#: The inputs for outputs and set-points.
Step = Callable[[np.ndarray, np.ndarray], Any]
PLANTS = int(os.environ.get("PLANTS", "8"))
#: The loop has settled when no state moves by more; it is cut off after so many steps.
STILL, STEPS = 1e-11, 3000
OFFSET = 1e-6
#: Smallest singular values of plants with a steady state that outputs show and inputs move.
SOUND = 0.02


class Plant(NamedTuple):
    """x+ = A x + B (u + load), y = C x + bias, for bounded u; the loop has Q and a set-point r."""

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    load: np.ndarray
    bias: np.ndarray
    bounds: tuple[np.ndarray, np.ndarray]
    Q: np.ndarray
    r: np.ndarray

    def steady(self) -> tuple[np.ndarray, ...]:
        """Return bases of (u, y) of the steady states, and one of these states."""
        n = len(self.A)
        balance = np.hstack((self.A - np.eye(n), self.B))
        Z = scipy.linalg.null_space(balance)
        one = np.linalg.lstsq(balance, -self.B @ self.load, rcond=None)[0]
        U = np.where(np.abs(Z[n:]) < 1e-12, 0.0, Z[n:])
        return U, self.C @ Z[:n], one[n:], self.C @ one[:n] + self.bias

    def nearest(self) -> np.ndarray | None:
        """Return the steady outputs nearest to r, None if no input within the bounds rests."""
        U, Y, u, y = self.steady()
        lower, upper = self.bounds
        v = qpsolvers.solve_qp(
            2 * Y.T @ self.Q @ Y + 1e-13 * np.eye(Y.shape[1]),
            2 * Y.T @ self.Q @ (y - self.r),
            np.vstack((U, -U)),
            np.concatenate((upper - u, u - lower)),
            solver="quadprog",
        )
        return None if v is None else y + Y @ v


def drawn(seed: int) -> Plant:
    """Draw a plant with up to three inputs and outputs, six states, integrators and delays."""
    rng = np.random.default_rng(seed)
    while True:
        A, B, C = matrices(rng)
        n, (n_y, m) = len(A), (len(C), B.shape[1])
        balance = np.hstack((A - np.eye(n), B))
        gain = C @ scipy.linalg.null_space(balance)[:n]
        checks = (balance, np.vstack((A - np.eye(n), C)), gain)
        if min(np.linalg.svd(x, compute_uv=False)[-1] for x in checks) > SOUND:
            break
    plant = Plant(
        A,
        B,
        C,
        load=rng.uniform(-0.3, 0.3, m),
        bias=rng.uniform(-0.5, 0.5, n_y),
        bounds=(-rng.uniform(0.5, 2, m), rng.uniform(0.5, 2, m)),
        Q=np.diag(rng.uniform(0.5, 2, n_y)),
        r=np.zeros(n_y),
    )
    _, Y, _, y = plant.steady()
    r = y + Y @ rng.normal(scale=rng.choice([0.3, 3.0]), size=Y.shape[1])
    if rng.random() < 0.3:  # with more outputs than inputs, out of reach without bounds, too
        r = r + rng.normal(size=n_y)
    return plant._replace(r=r)


def matrices(rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """Draw A, B and C, of which some have integrators, and some delays of the inputs."""
    n, m, n_y = (int(x) for x in rng.integers(1, [7, 4, 4]))
    integrators = int(rng.integers(0, min(n, m, n_y) + 1)) if rng.random() < 0.4 else 0
    poles = [1.0] * integrators + [*rng.uniform(-0.5, 0.95, n - integrators)]
    basis = np.linalg.qr(rng.normal(size=(n, n)))[0]
    A, B, C = basis * poles @ basis.T, rng.normal(size=(n, m)), rng.normal(size=(n_y, n))
    if (delay := int(rng.integers(0, 4))) == 0 or rng.random() < 0.6:
        return A, B, C
    lags = m * delay
    A = np.block(
        [[A, np.pad(B, ((0, 0), (0, lags - m)))], [np.zeros((lags, n)), np.eye(lags, k=m)]]
    )
    return A, np.vstack((np.zeros((n + lags - m, m)), np.eye(m))), np.pad(C, ((0, 0), (0, lags)))


def designed(plant: Plant, seed: int, window: bool = False) -> qm.Controller:
    """Return a controller of the plant."""
    rng = np.random.default_rng([seed, 1])
    m = plant.B.shape[1]
    mpc = qm.LinearMPC(
        plant[:3],
        int(rng.integers(10, 31)),
        Q=plant.Q,
        R=rng.uniform(0, 0.5, m),
        dR=rng.uniform(0.05, 1, m),
        u_bounds=plant.bounds,
    )
    return qm.Controller(mpc, window=window)


def compiled(controller: qm.Controller, folder: Path) -> Step:
    """Return the step of the controller in C."""
    twin = load(controller.export_c(folder).files, controller)

    def step(y: np.ndarray, r: np.ndarray) -> np.ndarray:
        u, code = twin.step(y, r)
        assert code == 0
        return u

    return step


def settled(plant: Plant, step: Step) -> np.ndarray:
    """Return the outputs where the closed loop of the plant settles."""
    x = np.zeros(len(plant.A))
    for k in range(STEPS):
        u = step(plant.C @ x + plant.bias, plant.r)
        before, x = x, plant.A @ x + plant.B @ (u + plant.load)
        if k > 50 and np.abs(x - before).max() < STILL:
            break
    return plant.C @ x + plant.bias


def check(seed: int, folder: Path | None = None, window: bool = False) -> None:
    """Compare the outputs where a loop settles; that of C if there is a folder for it."""
    plant = drawn(seed)
    try:
        nearest, controller = plant.nearest(), designed(plant, seed, window)
    except qm.QPError as error:
        if not str(error).startswith("window: got"):
            raise
        pytest.skip("the outputs of no whole number of steps determine the state")
    assert nearest is not None, "the loads are smaller than the bounds"
    outputs = settled(plant, compiled(controller, folder) if folder else controller.step)
    assert np.abs(outputs - nearest).max() < OFFSET * max(1.0, np.abs(plant.r).max()), seed


@pytest.mark.parametrize("seed", range(5))
def test_the_loop_settles_at_the_set_point_or_the_nearest_outputs(seed):
    check(seed)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5, PLANTS))
def test_the_loops_of_many_plants_settle_there(seed):
    check(seed)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(PLANTS))
def test_the_loops_with_a_window_settle_there(seed):
    check(seed, window=True)


@pytest.mark.slow
@pytest.mark.parametrize("window", [False, True])
@pytest.mark.parametrize("seed", range(PLANTS))
def test_the_loops_in_c_settle_there(seed, window, tmp_path):
    check(seed, tmp_path, window)
