"""Critical regions of a double integrator's MPC by enumeration of its active sets."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
from scipy.optimize import linprog

from torch_qpmpc import QPMPC

A, B = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[0.5], [1.0]])
#: A region with a smaller ball inside is flat.
FLAT = 1e-7


def double_integrator(horizon: int, **options: Any) -> QPMPC:
    """Return the MPC with ``|x| <= 5``, ``|u| <= 1``, Q = I and R = 1; x is hard."""
    bounds = ([-5.0, -5.0], [5.0, 5.0]), ([-1.0], [1.0])
    arguments = {"state_bounds": bounds[0], "state_slack": np.inf, "action_bounds": bounds[1]}
    arguments |= {"stage_weight": [1.0, 1.0, 1.0], "gamma": 1.0, "solver": "daqp"}
    return QPMPC.from_model(A, B, horizon, **arguments | options)


def enumerated(horizon: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return K and k of each region with an interior, without anything of the package.

    The plan is u_0, .., u_{N-1}; rows M u <= m + E x_0 are held in all combinations of at most N.
    """
    N, n = horizon, 2
    powers = [np.linalg.matrix_power(A, k) for k in range(N + 1)]
    S = np.concatenate([powers[k] for k in range(1, N + 1)])
    T = np.zeros((n * N, N))
    for k in range(1, N + 1):
        for j in range(k):
            T[n * (k - 1) : n * k, j : j + 1] = powers[k - 1 - j] @ B
    H, F = np.eye(N) + T.T @ T, T.T @ S
    M = np.concatenate((np.eye(N), -np.eye(N), T, -T))
    m = np.concatenate((np.ones(2 * N), 5 * np.ones(2 * n * N)))
    E = np.concatenate((np.zeros((2 * N, n)), -S, S))
    laws = []
    for size in range(N + 1):
        for held in itertools.combinations(range(len(M)), size):
            law = _law(H, F, M, m, E, list(held))
            if law is not None:
                laws.append((law[0][:1], law[1][:1]))
    return laws


def _law(H, F, M, m, E, held) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the plan ``K x + k`` of an active set, None without states of which it is optimal."""
    N, a = len(H), len(held)
    system = np.block([[H, M[held].T], [M[held], np.zeros((a, a))]])
    if np.linalg.matrix_rank(system) < N + a:
        return None
    right = np.block([[-F, np.zeros((N, 1))], [E[held], m[held][:, None]]])
    solved = np.linalg.solve(system, right)
    K, k, L, l_0 = solved[:N, :-1], solved[:N, -1], solved[N:, :-1], solved[N:, -1]
    free = np.setdiff1d(np.arange(len(M)), held)
    rows = np.concatenate((M[free] @ K - E[free], -L, np.eye(2), -np.eye(2)))
    limits = np.concatenate((m[free] - M[free] @ k, l_0, 5 * np.ones(4)))
    length = np.linalg.norm(rows, axis=1)
    if (limits[length < 1e-9] < 0).any():
        return None
    ball = linprog(
        [0, 0, -1],
        np.column_stack((rows, length)),
        limits,
        bounds=[(None, None)] * 2 + [(0, None)],
        method="highs",
    )
    return (K, k) if ball.status == 0 and ball.x[-1] > FLAT else None
