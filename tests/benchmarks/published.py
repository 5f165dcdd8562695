"""Verified controllers of others, proved again: evanqp's examples.

    python -m tests.benchmarks.published --write

Models, weights, bounds, the learned QP's numbers and the answers are those of the examples and
their printed outputs in github.com/PREDICT-EPFL/evanqp (commit 4b983ae; Schwan, Jones and Kuhn,
"Stability verification of neural network controllers using mixed-integer programming", IEEE TAC 68,
2023), which are solved by Gurobi. Here they follow from the explicit law of each MPC: gains of all
regions, and the largest difference of two piecewise affine laws, at a vertex of a piece.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import solve_discrete_are

from tests.benchmarks.rows import main
from torch_qpmpc import QPMPC
from torch_qpmpc.proofs import ExplicitLaw, Polytope, explicit_law
from torch_qpmpc.proofs.polytope import facets

Array = np.ndarray
TITLES = ("example", "question", "published", "here", "regions", "CPU, s")


class Example(NamedTuple):
    """An MPC with hard bounds (lower, upper) of x and u."""

    A: Any
    B: Any
    Q: list[float]
    R: list[float]
    x: Array
    u: Array

    def law(self, *, terminal: bool) -> ExplicitLaw:
        """Return the law for N = 10, with the LQR's cost and set at the end or with neither."""
        A, B, options = np.array(self.A), np.array(self.B), {}
        P = np.zeros_like(A)
        if terminal:
            Q, R = np.diag(self.Q), np.diag(self.R)
            P = solve_discrete_are(A, B, Q, R)
            K = -np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
            F, f = self._invariant(A + B @ K, K)
            options["terminal_constraints"] = F, np.full(len(f), -np.inf), f
        mpc = QPMPC.from_model(
            A, B, 10, stage_weight=self.Q + self.R, terminal_weight=P, hessian="block", gamma=1.0,
            state_bounds=self.x, state_slack=np.inf, action_bounds=self.u, constraint_slack=np.inf,
            solver="daqp", **options,
        )  # fmt: skip
        return explicit_law(mpc, Polytope.box(*self.x))

    def _invariant(self, A: Array, K: Array) -> tuple[Array, Array]:
        """Return the largest set within the bounds that ``x+ = A x``, u = K x, does not leave."""
        eye = np.eye(len(A))
        F = np.concatenate((eye, -eye, K, -K))
        f = np.concatenate((self.x[1], -self.x[0], self.u[1], -self.u[0]))
        while True:
            body = facets(np.concatenate((F, F @ A)), np.tile(f, 2))
            assert body is not None
            if len(f) == len(body.b) and (f == body.b).all():
                return F, f
            F, f = body.A, body.b


INTEGRATOR = Example(
    [[1.0, 1.0], [0.0, 1.0]], [[0.0], [1.0]], [1.0, 1.0], [0.1],
    np.array([[-10.0, -10.0], [10.0, 10.0]]), np.array([[-1.0], [1.0]]),
)  # fmt: skip
TWO_INPUTS = Example(
    [[1.0, 1.0], [0.0, 1.0]], [[0.42, 0.9], [0.38, 0.67]], [1.0, 1.0], [30.0, 30.0],
    np.array([[-40.0, -10.0], [40.0, 10.0]]), np.array([[-0.1, -0.1], [0.1, 0.1]]),
)  # fmt: skip
#: The converter's x and u are relative to the steady state with an output of 5 V.
A_CONVERTER = np.array(
    [[0.971356387900839, -0.009766890567613], [1.731870774203751, 0.970462385352837]]
)
B_CONVERTER = np.array([[0.148778899882612], [0.180827260808426]])
REST = np.array([0.0, 5.0])
REST[0], U_REST = np.linalg.solve(
    np.column_stack((A_CONVERTER - np.eye(2), B_CONVERTER))[:, [0, 2]],
    (np.eye(2) - A_CONVERTER) @ REST,
)
CONVERTER = Example(
    A_CONVERTER, B_CONVERTER, [90.0, 1.0], [1.0],
    np.array([[0.0, 0.0], [0.2, 7.0]]) - REST, np.array([[0.0], [1.0]]) - U_REST,
)  # fmt: skip
#: The learned policy, dc_dc_converter_qp.pt: z >= 0 minimises |H z + W x + b|^2 + 1e-4 |z|^2, and u
#: is v'z + v_0, saturated.
H = np.array([
    [0.6496267914772034, -1.5076310634613037, 0.3543345332145691],
    [-0.8244829177856445, -0.1497376412153244, -0.6313226819038391],
    [-1.240620732307434, -0.14753465354442596, 0.016560956835746765],
])  # fmt: skip
W = np.array([
    [-2.6239750385284424, 0.03882429003715515],
    [-2.0675950050354004, -0.16177278757095337],
    [-0.4188579022884369, -0.30610391497612],
])  # fmt: skip
b = np.array([0.6079915761947632, 1.0884612798690796, 1.022040605545044])
v = np.array([-0.004916152451187372, 0.710325300693512, 1.1860136985778809])
v_0 = -0.15184944868087769


def pieces() -> Iterator[tuple[Array, Array, Array, float]]:
    """Return A, b, g and g_0 of the learned policy's pieces: u = g'x + g_0 where A x <= b."""
    G, L, l_0 = H.T @ H + 1e-4 * np.eye(3), H.T @ W, H.T @ b
    for free in itertools.product((False, True), repeat=3):
        on, off = np.flatnonzero(free), np.flatnonzero(~np.array(free))
        Z, z = np.zeros((3, 2)), np.zeros(3)
        solved = -np.linalg.solve(G[np.ix_(on, on)], np.column_stack((L, l_0))[on])
        Z[on], z[on] = solved[:, :-1], solved[:, -1]
        A = np.concatenate((-Z[on], -(G @ Z + L)[off]))
        right = np.concatenate((z[on], (G @ z + l_0)[off]))
        g, g_0 = v @ Z, float(v @ z + v_0)
        yield np.vstack((A, g)), np.append(right, -g_0), 0 * g, 0.0
        yield np.vstack((A, g, -g)), np.append(right, (1 - g_0, g_0)), g, g_0
        yield np.vstack((A, -g)), np.append(right, g_0 - 1), 0 * g, 1.0


def difference(law: ExplicitLaw) -> float:
    """Return the largest difference of the converter's MPC and the learned policy."""
    worst = -np.inf
    for region, (A, right, g, g_0) in itertools.product(law.regions, list(pieces())):
        rows = np.concatenate((region.set.A, A))
        limits = np.append(region.set.b, right - A @ REST)
        varies = np.abs(rows).max(1) > 1e-12
        body = None if (limits[~varies] < 0).any() else facets(rows[varies], limits[varies])
        if body is not None:
            x = body.vertices
            u = (x @ region.K.T + region.k)[:, 0] + U_REST
            worst = max(worst, float(abs(u - (x + REST) @ g - g_0).max()))
    return worst


def largest_gain(law: ExplicitLaw, axis: int) -> float:
    """Return the largest sum of |du_i/dx_j| over the inputs (0) or the states (1)."""
    return max(float(abs(x.K).sum(axis).max()) for x in law.regions)


#: The example, a terminal set or none, the question, its function and the printed answer.
QUESTIONS = {
    "double integrator": (
        *(INTEGRATOR, True, "Lipschitz constant, sum over u"),
        *(lambda law: largest_gain(law, 0), 1.5456270370495675),
    ),
    "two inputs": (
        *(TWO_INPUTS, False, "Lipschitz constant, sum over u"),
        *(lambda law: largest_gain(law, 0), 1.537461401237088),
    ),
    "two inputs, again": (
        *(TWO_INPUTS, False, "Lipschitz constant, sum over x"),
        *(lambda law: largest_gain(law, 1), 1.7739314159656487),
    ),
    "DC-DC converter": (
        *(CONVERTER, True, "largest difference from a learned QP"),
        *(difference, 0.24280925844578716),
    ),
}


def measured(name: str) -> list[str]:
    """Measure one row of the table."""
    example, terminal, question, answer, published = QUESTIONS[name]
    began = time.process_time()
    law = example.law(terminal=terminal)
    here = answer(law)
    seconds = time.process_time() - began
    assert abs(here - published) < 1e-6 * published, (here, law.covered, law.volume)
    assert law.covered == 1
    numbers = f"{published:.9f}", f"{here:.9f}", str(len(law.regions)), f"{seconds:.1f}"
    return [name.split(",")[0], question, *numbers]


if __name__ == "__main__":
    main("published", "published", TITLES, QUESTIONS, measured)
