"""LinearMPC.jl's cart-pendulum, in C, beside a sparse QP: ``python -m tests.benchmarks.pendulum``.

The plant, the weights and the closed loop are those of the package's own benchmark
(https://github.com/darnstrom/lmpc-codegen-benchmark); a violated bound of an output has a linear
price here. The table goes into docs/results/conventions.md.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy as np
import qpsolvers
import scipy.linalg
import scipy.signal
import torch
from scipy import sparse

import torch_qpmpc as qm
from tests.benchmarks.export import compiled
from tests.benchmarks.table import DOCS, significant
from torch_qpmpc.export.tables import make_tables
from torch_qpmpc.export.writer import Settings, state_bytes, table_bytes
from torch_qpmpc.study.markdown import replaced, table

PAGE = DOCS / "results" / "conventions.md"
HORIZONS = (50, 75, 100, 125)
BLOCKS = [1, 1, 2, 4, 8]
DT, STEPS, PASSES = 0.01, 500, 5
#: Every this many steps of the loop is compared.
EVERY = 10
Q, DR, BOUND, BAND, PRICE = np.array([1.44, 1.0]), 0.01, 2.0, np.array([10.0, 0.3]), 1e3
PLANT = scipy.signal.StateSpace(
    [[0, 1, 0, 0], [0, -10, 9.81, 0], [0, 0, 0, 1], [0, -20, 39.24, 0]],
    [[0], [100], [0], [200]],
    [[1, 0, 0, 0], [0, 0, 1, 0]],
    [[0], [0]],
)


class Loop(NamedTuple):
    """The p ``(steps, n_p)`` of a loop, its x, u_last, r and u."""

    p: np.ndarray
    x: np.ndarray
    u_last: np.ndarray
    r: np.ndarray
    u: np.ndarray


def designed(horizon: int, blocks: list[int]) -> qm.LinearMPC:
    """Return the MPC of the benchmark."""
    band = (-BAND, BAND)
    weights = {"Q": Q, "dR": DR, "y_bounds": band, "y_slack": PRICE, "blocks": blocks}
    return qm.LinearMPC(PLANT, horizon, dt=DT, u_bounds=(-BOUND, BOUND), **weights)


@torch.no_grad()
def closed(mpc: qm.LinearMPC) -> Loop:
    """Run the loop from a tilted pendulum; the cart goes to 1 and then to -0.5."""
    plant, qp, active = mpc.design.plant, mpc.quadratic_program(), None
    targets = {r: mpc.target([r, 0.0]) for r in (1.0, -0.5)}
    x, u, rows = np.array([0.0, 0.0, 0.2, 0.0]), np.zeros(1), []
    for k in range(STEPS):
        r = 1.0 if k < STEPS // 2 else -0.5
        p = mpc.arrange(x, targets[r], u_last=u)
        du, active = mpc.policy_and_active_set(p, active, qp)
        last, u = u, (targets[r].u + du).numpy()
        rows.append((p.numpy(), x, last, [r, 0.0], u))
        x = plant.A @ x + plant.B @ u
    return Loop(*map(np.array, zip(*rows, strict=True)))


class Sparse:
    """The same problem as one QP in states, inputs and violations of bounds, written by hand."""

    def __init__(self, mpc: qm.LinearMPC) -> None:
        plant, N = mpc.design.plant, mpc.horizon
        A, B, C = plant.A, plant.B, plant.C
        blocks = mpc.design.blocks or (1,) * N
        hold, stages = np.repeat(np.eye(len(blocks)), blocks, axis=0), np.eye(N + 1)
        self.moves = (np.eye(N) - np.eye(N, k=-1)) @ hold
        self.x, self.v, rows = 4 * (N + 1), len(blocks), 2 * (N + 1)
        weight = scipy.linalg.block_diag(C.T @ np.diag(Q) @ C, DR)
        pair = scipy.linalg.block_diag(A, 0.0), np.vstack((B, 1.0))
        cross = np.append(np.zeros(4), -DR)[:, None]
        P = scipy.linalg.solve_discrete_are(*pair, weight, DR, s=cross)  # of x_N and u_{N-1}
        self.W = np.kron(np.diag(np.append(np.ones(N), 0)), weight[:4, :4])
        self.W[-4:, -4:] = P[:4, :4]
        H = scipy.linalg.block_diag(self.W, DR * self.moves.T @ self.moves, np.zeros((rows, rows)))
        last = self.x + self.v - 1
        H[last, last] += P[4, 4]
        H[self.x - 4 : self.x, last] = H[last, self.x - 4 : self.x] = self.P = P[:4, 4]
        y, unit = np.kron(stages, C), np.eye(rows)
        free = np.zeros((rows, self.v))
        steps = np.kron(stages, np.eye(4)) - np.kron(np.eye(N + 1, k=-1), A)
        forced = np.vstack((np.zeros((4, self.v)), -np.kron(hold, B)))
        self.matrices = [
            sparse.csc_matrix(x)
            for x in (
                2 * H,
                np.block([[y, free, -unit], [-y, free, -unit]]),
                np.hstack((steps, forced, np.zeros((self.x, rows)))),
            )
        ]

    def solve(self, x: np.ndarray, u_last: np.ndarray, r: np.ndarray) -> float:
        """Return u_0."""
        (H, G, A), rows = self.matrices, self.x // 2
        aim = np.array([r[0], 0, r[1], 0])
        states, inputs = -2 * self.W @ np.tile(aim, self.x // 4), -2 * DR * self.moves[0] * u_last
        inputs[-1] -= 2 * self.P @ aim
        ends = np.full(self.x, np.inf), np.full(self.v, BOUND), np.full(rows, np.inf)
        solution = qpsolvers.solve_qp(
            H,
            np.concatenate((states, inputs, np.full(rows, PRICE))),
            G,
            np.tile(BAND, rows),
            A,
            np.append(x, np.zeros(self.x - 4)),
            lb=np.concatenate((-ends[0], -ends[1], np.zeros(rows))),
            ub=np.concatenate(ends),
            solver="clarabel",
            tol_gap_abs=1e-11,
            tol_gap_rel=1e-11,
            tol_feas=1e-11,
        )
        assert solution is not None
        return solution[self.x]


def row(horizon: int, blocks: list[int]) -> list[str]:
    """Measure one MPC: sizes, microseconds of a step in C, and its distance from the sparse QP."""
    mpc = designed(horizon, blocks)
    loop, other, tables = closed(mpc), Sparse(mpc), make_tables(mpc)
    with tempfile.TemporaryDirectory() as folder:
        run = compiled(mpc, Path(folder), "fast")
        passes = [run(loop.p, False) for _ in range(PASSES)]
    p50, p99 = np.percentile(np.min([x.steps for x in passes], 0), [50, 99])
    u = passes[0].u
    assert u is not None  # about the target's input, which is zero
    some = range(0, STEPS, EVERY)
    expected = [other.solve(loop.x[k], loop.u_last[k], loop.r[k]) for k in some]
    settings = Settings("policy", "float64", "fast", 1)
    memory = (table_bytes(tables, settings) + state_bytes(tables, settings)) / 1024
    name = f"N = {horizon}" + (f", {len(blocks)} blocks" if blocks else "")
    sizes = [str(tables.R.shape[1]), str(len(tables.rows))]
    difference = np.abs(u[some, 0] - expected).max()
    return [name, *sizes, significant(p50), significant(p99), f"{memory:,.0f}", f"{difference:.0e}"]


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m tests.benchmarks.pendulum", description="Write the table of the pendulum."
    )
    parser.add_argument("--page", type=Path, default=PAGE, help="the file that gets the table")
    parser.add_argument("--horizons", type=int, nargs="+", default=HORIZONS)
    options = parser.parse_args(arguments)
    text = options.page.read_text(encoding="utf-8")
    replaced(text, "", "pendulum")  # fail before the runs
    torch.set_num_threads(1)
    head = ["", "variables", "rows", "us, median", "us, 99 %", "KiB", "largest difference"]
    pairs = [(N, b) for N in options.horizons for b in ([], [*BLOCKS, N - sum(BLOCKS)])]
    text = replaced(text, table(head, [row(*pair) for pair in pairs]), "pendulum")
    options.page.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
