"""One MPC problem in several packages: ``python -m tests.benchmarks.toolboxes [--write]``.

A mass with bounds and x_N = 0, as ampyc's ``MPC`` has it, in a closed loop of 40 steps from rest at
0.8: its cost, the largest difference of an input from this package's, and the times of the start
and, in the median, of a step. The other packages are optional, and a missing one is named:

    pip install do-mpc gekko ampyc

The table goes into docs/results/conventions.md.
"""

import argparse
import time
from collections.abc import Callable
from importlib.metadata import version
from types import SimpleNamespace
from typing import Any

import numpy as np

import torch_qpmpc as qm
from tests.benchmarks.table import DOCS, publish, table

A, B = np.array([[1.0, 0.1], [0.0, 1.0]]), np.array([[0.005], [0.1]])
Q, R, N = np.eye(2), 0.1 * np.eye(1), 30
LIMITS, STEPS = np.array([1.0, 0.6]), 40
Policy = Callable[[np.ndarray], Any]


def ours() -> Policy:
    end = (np.eye(2), np.zeros(2), np.zeros(2))
    mpc = qm.QPMPC.from_model(
        A,
        B,
        N,
        stage_weight=2 * np.array([*np.diag(Q), *np.diag(R)]),
        terminal_weight=[0.0, 0.0],
        state_bounds=(-LIMITS, LIMITS),
        action_bounds=([-1.0], [1.0]),
        state_slack=np.inf,
        terminal_constraints=end,
        constraint_slack=np.inf,
        gamma=1.0,
        solver="daqp",
        learn=(),
    )
    return lambda x: mpc.predict(x)[0]


def do_mpc() -> Policy:
    import casadi  # pyright: ignore[reportMissingImports]
    import do_mpc  # pyright: ignore[reportMissingImports]

    model = do_mpc.model.Model("discrete")
    x, u = model.set_variable("_x", "x", shape=(2, 1)), model.set_variable("_u", "u")
    model.set_rhs("x", casadi.DM(A) @ x + casadi.DM(B) @ u)
    model.setup()
    mpc = do_mpc.controller.MPC(model)
    mpc.set_param(n_horizon=N, t_step=0.1, state_discretization="discrete")
    mpc.settings.supress_ipopt_output()
    mpc.set_objective(mterm=casadi.DM(0), lterm=x.T @ casadi.DM(Q) @ x + R.item() * u**2)
    mpc.set_rterm(u=0.0)
    for side, sign in (("lower", -1), ("upper", 1)):
        mpc.bounds[side, "_x", "x"], mpc.bounds[side, "_u", "u"] = sign * LIMITS, float(sign)
        mpc.terminal_bounds[side, "x"] = np.zeros(2)
    mpc.setup()
    mpc.x0 = np.array([0.8, 0.0])
    mpc.set_initial_guess()
    return lambda x: mpc.make_step(x[:, None]).ravel()


def gekko() -> Policy:
    from gekko import GEKKO  # pyright: ignore[reportMissingImports]

    m = GEKKO(remote=False)
    start = [m.Param(0.0) for _ in range(2)]
    u = [m.Var(0.0, lb=-1, ub=1) for _ in range(N)]
    states = [start]
    for k in range(N):
        bounded = [m.Var(0.0, lb=-limit, ub=limit) for limit in LIMITS]
        for i, x in enumerate(bounded):
            m.Equation(x == A[i, 0] * states[k][0] + A[i, 1] * states[k][1] + B[i, 0] * u[k])
        states.append(bounded)
    for x in states[-1]:
        m.Equation(x == 0)
    m.Minimize(
        sum(x[0] ** 2 + x[1] ** 2 + R.item() * v**2 for x, v in zip(states, u, strict=False))
    )

    def policy(x: np.ndarray) -> Any:
        for parameter, value in zip(start, x, strict=True):
            parameter.value = float(value)
        m.solve(disp=False)
        return np.array([u[0].value[0]])

    return policy


def ampyc() -> Policy:
    from ampyc.controllers import MPC  # pyright: ignore[reportMissingImports]
    from ampyc.noise import ZeroNoise  # pyright: ignore[reportMissingImports]
    from ampyc.systems import LinearSystem  # pyright: ignore[reportMissingImports]

    rows, both = np.vstack((np.eye(2), -np.eye(2))), np.array([[1.0], [-1.0]])
    plant = {"n": 2, "m": 1, "A": A, "B": B, "C": np.eye(2), "D": np.zeros((2, 1))}
    plant |= {"A_x": rows, "b_x": np.tile(LIMITS, 2)[:, None], "A_u": both, "b_u": np.ones((2, 1))}
    plant |= {"A_w": None, "b_w": None, "noise_generator": ZeroNoise(dim=2), "dt": 0.1}
    settings = SimpleNamespace(name="mpc", N=N, Q=Q, R=R)
    controller = MPC(LinearSystem(SimpleNamespace(**plant)), settings)
    return lambda x: controller.solve(x)[0][:, 0]


PACKAGES = {"torch-qpmpc": ours, "do-mpc": do_mpc, "gekko": gekko, "ampyc": ampyc}


class Loop:
    """A closed loop with a package's policy.

    Attributes:
        inputs, times: of its steps.
        start: the time that making the policy takes.
        cost: the loop's cost.
    """

    def __init__(self, make: Callable[[], Policy]) -> None:
        began = time.perf_counter()
        self._policy, self._x = make(), np.array([0.8, 0.0])
        self.start, self.cost = time.perf_counter() - began, 0.0
        self.inputs: list[np.ndarray] = []
        self.times: list[float] = []

    def step(self) -> None:
        began = time.perf_counter()
        u = np.ravel(self._policy(self._x))
        self.times.append(time.perf_counter() - began)
        self.inputs.append(u)
        self.cost += float(self._x @ Q @ self._x + u @ R @ u)
        self._x = A @ self._x + B @ u


def main(write: bool) -> None:
    """Print the table of loops that take their steps in turn, and write it into its page."""
    loops, rows = {}, []
    Loop(ours).step()  # compiles
    for name, make in PACKAGES.items():
        try:
            loops[name] = Loop(make)
        except ImportError as error:
            print(f"{name} is not installed: {error}")
    for _ in range(STEPS):
        for loop in loops.values():
            loop.step()
    own = next(iter(loops.values()))
    for name, loop in loops.items():
        off = np.abs(np.subtract(loop.inputs, own.inputs)).max()
        first, step = loop.start + loop.times[0], float(np.median(loop.times[1:]))
        ratio = step / float(np.median(own.times[1:]))
        number = "" if loop is own else version(name)
        cells = f"{loop.cost:.5f}", f"{off:.0e}" if off else "", f"{first:.2f}", f"{ratio:.3g}"
        rows.append([f"{name} {number}".strip(), *cells, f"{1e3 * step:.3g}"])
    head = ["package", "cost", "inputs off by", "start and first step, s", "a step", "in ms"]
    publish(table(head, rows), "toolboxes", write, DOCS / "results" / "conventions.md")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--write", action="store_true")
    main(parser.parse_args().write)
