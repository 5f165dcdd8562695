"""One decision at a time: `predict` and `Controller.step` beside raw solvers of the same QPs.

    pip install osqp clarabel casadi && python -m tests.benchmarks.one_state --write

CPU time of each step of a closed loop with noise and kicks, in blocks in which the contenders take
turns, `PASSES` times over: the median, the largest of the steps' least times, which no interruption
of the machine explains, and the largest. "Default threads" are torch's own number. A package that
is not installed is left out. Clarabel, which sets each QP up again, and CasADi get `FEW` steps.
"""

import argparse
import os
import sys
import time
from collections.abc import Callable
from importlib import import_module
from importlib.metadata import version
from importlib.util import find_spec
from typing import Any

import daqp
import numpy as np
import scipy.sparse as sp
import torch

import torch_qpmpc as qm
from tests.benchmarks.full_space import FullSpace
from tests.benchmarks.peers import clarabel_step, osqp_step
from tests.benchmarks.table import publish, significant, table
from torch_qpmpc.qp.pipeline.batch import Programs
from torch_qpmpc.qp.solvers.daqp import NO_BOUND, RECIPROCAL_RHO, SOFT

STEPS, FEW, BLOCK, KICK, PASSES = 10_000, 200, 200, 50, 3
SIZES = {"N = 10, 2 states": (10, 2, 1), "N = 50, 8 states": (50, 8, 2)}

Step = Callable[[int], Any]


def policy(N: int, n_x: int, n_u: int) -> qm.QPMPC:
    """Return the MPC of a random plant with soft bounds of its states and hard ones of inputs."""
    rng = np.random.default_rng(0)
    A = np.eye(n_x) + 0.1 * rng.standard_normal((n_x, n_x))
    A, B = 0.98 * A / np.abs(np.linalg.eigvals(A)).max(), 0.3 * rng.standard_normal((n_x, n_u))
    bounds = {"state_bounds": ([-2.0] * n_x, [2.0] * n_x)}
    bounds["action_bounds"] = ([-1.0] * n_u, [1.0] * n_u)
    cost = [1.0] * n_x + [0.1] * n_u
    return qm.QPMPC.from_model(A, B, N, stage_weight=cost, solver="daqp", **bounds)


def visited(mpc: qm.QPMPC) -> np.ndarray:
    """Return the states of a closed loop of its model, kicked every `KICK` steps."""
    rng, A, B = np.random.default_rng(1), mpc.scheme.model.A.numpy(), mpc.scheme.model.B.numpy()
    states = np.empty((STEPS, mpc.n_x))
    for k in range(STEPS):
        if k % KICK == 0:
            states[k] = rng.uniform(-1.5, 1.5, mpc.n_x)
        else:
            noise = 0.02 * rng.standard_normal(mpc.n_x)
            states[k] = A @ states[k - 1] + B @ mpc.predict(states[k - 1]) + noise
    return states


def casadi_step(full: FullSpace) -> Step:
    """Make CasADi's own sparse active-set method, QRQP, warm-started."""
    casadi = import_module("casadi")
    p, b, lower, upper = (v.detach().numpy() for v in (full.p, full.b, full.l, full.u))
    Q = casadi.DM(sp.csc_matrix(full.Q.detach().numpy()))
    A = casadi.DM(sp.csc_matrix(torch.cat((full.A, full.G)).detach().numpy()))
    quiet = {"print_iter": False, "print_header": False, "print_info": False}
    solver = casadi.conic("step", "qrqp", {"h": Q.sparsity(), "a": A.sparsity()}, quiet)
    start: dict[str, Any] = {}

    def step(k: int) -> np.ndarray:
        bounds = {"lba": np.hstack((b[k], lower[k])), "uba": np.hstack((b[k], upper[k]))}
        found = solver(h=Q, g=p[k], a=A, **bounds, **start)
        start.update(x0=found["x"], lam_a0=found["lam_a"])
        return np.array(found["x"])

    return step


def daqp_step(mpc: qm.QPMPC, states: np.ndarray) -> Step:
    """Make DAQP on our condensed QPs, warm-started, without the certificate."""
    operands = *mpc.quadratic_program().tensors(), torch.from_numpy(states)
    H, G, _, g, lower, upper, w = Programs.of(*operands, n_kept=mpc.n_p)[0].reduced_qps()
    upper, lower = np.minimum(upper, NO_BOUND), np.maximum(lower, -NO_BOUND)
    hard = np.isinf(w[0])
    rho, weight = np.full(len(hard), RECIPROCAL_RHO), np.where(hard, 0.0, w[0])
    model = daqp.Model()
    model.setup(H[0], g[0], G[0], upper[0], lower[0], np.where(hard, 0, SOFT).astype(np.int32))
    model.soft_weights(rho_l=rho, rho_u=rho, w_l=weight, w_u=weight)

    def step(k: int) -> np.ndarray:
        model.update(f=g[k], bupper=upper[k], blower=lower[k])
        return model.solve()[0]

    return step


def measured(steps: dict[str, Step], default: int) -> dict[str, np.ndarray]:
    """Return the CPU seconds of each contender's steps, ``(PASSES, steps)``."""
    seconds: dict[str, list[float]] = {name: [] for name in steps}
    for step in steps.values():
        step(0)
    for start in PASSES * tuple(range(0, STEPS, BLOCK)):
        for name, step in steps.items():
            if start >= FEW and name in ("Clarabel", "CasADi (QRQP)"):
                continue
            torch.set_num_threads(default if "default" in name else 1)
            # Idle workers of the others' threads spin for a while, which is time of the process.
            clock = time.process_time if "default" in name else time.thread_time
            step(max(start - 1, 0))  # the others' turns have filled the caches
            for k in range(start, start + BLOCK):
                began = clock()
                step(k)
                seconds[name].append(clock() - began)
    return {name: np.reshape(times, (PASSES, -1)) for name, times in seconds.items()}


@torch.no_grad()
def of_policy(N: int, n_x: int, n_u: int, default: int) -> dict[str, np.ndarray]:
    mpc = policy(N, n_x, n_u)
    states = visited(mpc)
    full = FullSpace.of(mpc.quadratic_program(), torch.from_numpy(states))
    steps: dict[str, Step] = dict.fromkeys(
        ("`predict`", "`predict`, default threads"), lambda k: mpc.predict(states[k])
    )
    steps["raw DAQP, no certificate"] = daqp_step(mpc, states)
    if find_spec("osqp"):
        steps["OSQP"] = osqp_step(full)
    if find_spec("casadi") and N == 10:  # at 50 it ends without a solution
        steps["CasADi (QRQP)"] = casadi_step(full)
    if find_spec("clarabel"):
        steps["Clarabel"] = clarabel_step(full)
    compiled = qm.CompiledPolicy(mpc)
    steps["our C, called from Python"] = lambda k: compiled(torch.from_numpy(states[k]))
    return measured(steps, default)


def of_controller(default: int) -> dict[str, np.ndarray]:
    """Time a controller of a plant with two states, one of them measured, and moving set-points."""
    A, B, C = np.array([[1.0, 0.1], [0.0, 0.9]]), np.array([[0.0], [0.1]]), np.array([[1.0, 0.0]])
    mpc = qm.LinearMPC((A, B, C), 10, Q=1.0, dR=0.1, u_bounds=(-1.0, 1.0))
    rng, names = (
        np.random.default_rng(2),
        ("`Controller.step`", "`Controller.step`, default threads"),
    )

    def loop() -> Step:
        controller, x = qm.Controller(mpc), np.zeros(2)

        def step(k: int) -> None:
            nonlocal x
            u = controller.step(C @ x + noise[k], [0.5 if k % 100 < KICK else -0.5])
            x = A @ x + B @ u

        return step

    noise = 0.01 * rng.standard_normal((STEPS, 1))
    return measured({name: loop() for name in names}, default)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m tests.benchmarks.one_state", description=__doc__
    )
    parser.add_argument("--write", action="store_true", help="write the table into the docs")
    options = parser.parse_args(arguments)
    default = torch.get_num_threads()
    columns: dict[str, dict[str, np.ndarray]] = {}
    for caption, size in SIZES.items():
        columns[caption] = of_policy(*size, default)
    columns["two-state plant"] = of_controller(default)
    lines = []
    for name in dict.fromkeys(name for column in columns.values() for name in column):
        cells = []
        for column in columns.values():
            times = 1e3 * column[name] if name in column else None
            cells.append("" if times is None else " / ".join(map(significant, spread(times))))
        lines.append([name, *cells])
    packages = ("torch", "daqp", "osqp", "clarabel", "casadi")
    versions = ", ".join(f"{name} {version(name)}" for name in packages if find_spec(name))
    text = (
        f"CPU milliseconds of a step: median / largest over steps of the fastest of {PASSES} "
        f"passes / largest, over {STEPS:,} steps (Clarabel, CasADi: {FEW}), with {versions}; one "
        f"thread unless a row says default threads, here {default} on {os.cpu_count()} cores."
        f"\n\n{table(['', *columns], lines)}"
    )
    publish(text, "one state", options.write)
    return 0


def spread(times: np.ndarray) -> tuple[float, float, float]:
    """Return the median, the largest of the passes' least, and the largest time of all."""
    return max(float(np.median(times)), 1e-4), float(times.min(0).max()), float(times.max())


if __name__ == "__main__":
    sys.exit(main())
