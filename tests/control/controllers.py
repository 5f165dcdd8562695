"""Controllers of the tests, of random plants too, and their functions in C."""

import functools
import tempfile
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import qpsolvers
import scipy.linalg
import torch

import torch_qpmpc as qm
from torch_qpmpc.control.exporting import CompiledController
from torch_qpmpc.control.state_space import read_model

A = np.array([[1.0, 0.1], [0.0, 0.8]])
B, C, E = np.array([[0.0], [1.0]]), np.array([[1.0, 0.0]]), np.array([[0.0], [0.1]])
#: Smallest singular values of plants with a steady state that outputs show and inputs move.
SOUND = 0.02


def learned(references: str = "held", rate: float = 1e-3, **options) -> qm.LinearMPC:
    """Make a LinearMPC with bounds, prices and names of which every part has been learned."""
    names: Any = {"inputs": ["valve"], "outputs": ["level"], "known": ["rain", "price"]}
    plant = read_model((A, B, C), np.hstack((E, 0 * E)), **names)
    mpc = qm.LinearMPC(
        replace(plant, units={"level": "m"}, dt=0.5),
        4,
        Q={"level": 1.0},
        dR=0.1,
        y_bounds={"level": (None, 2.0)},
        u_bounds=(-1.0, 1.0),
        du_bounds=(-0.3, 0.3),
        linear={"valve": "price"},
        references=references,
        learn=("H", "q", "c", "C", "b", "lb", "ub", "w"),
        **options,
    )
    optimizer = torch.optim.SGD(mpc.plan.parameters(), lr=rate)
    mpc.plan.value(torch.linspace(-0.5, 0.5, mpc.plan.n_p)).backward()
    optimizer.step()
    return mpc


def load(
    files: Iterable[Path], controller: qm.Controller, name: str = "policy", dtype: str = "float64"
) -> CompiledController:
    texts = {x.name: x.read_text() for x in files if x.suffix in (".c", ".h")}
    return CompiledController(texts, name, dtype, len(controller.u))


def exported(
    make: Callable[..., qm.Controller], missing: bool = False, **options
) -> tuple[qm.Controller, CompiledController]:
    """Return a new controller, and its functions in C, which are exported once for each design."""
    twin = _exported(make, missing, (*sorted(options.items()),))
    twin.reset()
    return make(**options), twin


@functools.cache
def _exported(
    make: Callable[..., qm.Controller], missing: bool, options: tuple
) -> CompiledController:
    controller = make(**dict(options))
    with tempfile.TemporaryDirectory() as folder:
        return load(controller.export_c(folder, missing=missing).files, controller)


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


def designed(plant: Plant, seed: int, **options: Any) -> qm.Controller:
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
    return qm.Controller(mpc, **options)
