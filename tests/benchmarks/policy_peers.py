"""The bounded LQRs of the policy's benchmark by other packages: solution and gradient.

    minimise over x_0 .. x_N, u_0 .. u_(N-1):  sum x_k'x_k / 2 + u_k'u_k / 2
    subject to  x_(k+1) = A x_k + B u_k + b,  |u_k| <= u_max

with the gradient of u_0's sum in A, B and b.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from contextlib import chdir
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from tempfile import mkdtemp
from typing import Any

import numpy as np
import torch
from torch import Tensor

HORIZON = 20


def lqr() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return A, B, the offset b and 128 initial states, as in the benchmark of acados."""
    n_x, n_u, random = 8, 4, np.random.RandomState(42)
    A, B = np.eye(n_x) + 0.2 * random.randn(n_x, n_x), random.randn(n_x, n_u)
    return A, B, random.randn(n_x), random.randn(128, n_x)


@dataclass(frozen=True)
class Peer:
    """``solution`` returns u_0 ``(128, n_u)``; ``gradient`` solves and differentiates."""

    solution: Callable[[], np.ndarray]
    gradient: Callable[[], object]


def mpc_pytorch(u_max: float) -> Peer:
    """Make mpc.pytorch, with at most ten iterations and its analytic gradient."""
    mpc = import_module("mpc.mpc")
    A, B, offset, states = map(torch.from_numpy, lqr())
    n_x, n_u = B.shape
    T, count, n = HORIZON + 1, len(states), n_x + n_u
    F, f = torch.cat((A, B), dim=1).requires_grad_(), offset.requires_grad_()
    H, q = torch.eye(n).double(), torch.zeros(n).double()
    cost = mpc.QuadCost(H.expand(T, count, n, n), q.expand(T, count, n))
    options = {"lqr_iter": 10, "verbose": -1, "exit_unconverged": False}
    solver = mpc.MPC(n_x, n_u, T, -u_max, u_max, grad_method=mpc.GradMethods.ANALYTIC, **options)

    def solution() -> Tensor:
        F_s, f_s = F.expand(HORIZON, count, -1, -1), f.expand(HORIZON, count, -1)
        return solver(states, cost, mpc.LinDx(F_s, f_s))[1][0]

    return Peer(lambda: solution().numpy(force=True), lambda: solution().sum().backward())


def problem(u_max: float) -> tuple[Any, dict[str, Any], Any, Any]:
    """Return the problem in CVXPY, its parameters by name, and the variables x and u."""
    import cvxpy as cp

    n_x, n_u = lqr()[1].shape
    x, u = cp.Variable((HORIZON + 1, n_x), name="x"), cp.Variable((HORIZON, n_u), name="u")
    shapes = {"x_0": (n_x,), "A": (n_x, n_x), "B": (n_x, n_u), "b": (n_x,)}
    parameters = {name: cp.Parameter(shape, name=name) for name, shape in shapes.items()}
    x_0, A, B, b = parameters.values()
    constraints = [x[0] == x_0, u <= u_max, u >= -u_max]
    constraints += [x[k + 1] == A @ x[k] + B @ u[k] + b for k in range(HORIZON)]
    cost = 0.5 * cp.sum_squares(x) + 0.5 * cp.sum_squares(u)
    return cp.Problem(cp.Minimize(cost), constraints), parameters, x, u


def cvxpylayers(u_max: float) -> Peer:
    layers = import_module("cvxpylayers.torch")
    of, parameters, _, u = problem(u_max)
    options = {"solve_method": "CLARABEL"}
    layer = layers.CvxpyLayer(of, [*parameters.values()], [u], solver_args=options)
    A, B, offset, states = map(torch.from_numpy, lqr())
    theta = [tensor.requires_grad_() for tensor in (A, B, offset)]

    def solution() -> Tensor:
        return layer(states, *theta)[0][:, 0]

    return Peer(lambda: solution().numpy(force=True), lambda: solution().sum().backward())


def cvxpygen(u_max: float) -> Peer:
    """Generate CVXPYgen's C with OSQP at its default tolerance; its gradient, state by state."""
    generator = import_module("cvxpygen.cpg")
    of, parameters, x, u = problem(u_max)
    A, B, offset, states = lqr()
    values = dict(zip(parameters, (states[0], A, B, offset), strict=True))
    for name, parameter in parameters.items():
        parameter.value = values[name]
    folder, code = mkdtemp(), f"lqr_{u_max:g}".replace("+", "")
    sys.path.insert(0, folder)
    with chdir(folder):
        options = {"prefix": code, "solver": "OSQP", "gradient": True}  # the prefix names its types
        generator.generate_code(of, code_dir=code, **options)
    generated = import_module(f"{code}.cpg_solver")

    def solved() -> list[Any]:
        states_of_gradient, actions = [], []
        for i, state in enumerate(states):
            parameters["x_0"].value = state
            changed = ["x_0"] if i else [*parameters]
            states_of_gradient.append(generated.forward(of, changed)[1])
            actions.append(u.value[0])
        return [np.array(actions), states_of_gradient]

    def gradient() -> None:
        x.gradient, u.gradient = np.zeros(x.shape), np.zeros(u.shape)
        u.gradient[0] = 1
        for state in solved()[1]:
            generated.backward(of, state)

    return Peer(lambda: solved()[0], gradient)


#: How to make each package's solver, by its name.
PEERS = {"mpc.pytorch": mpc_pytorch, "cvxpylayers": cvxpylayers, "cvxpygen": cvxpygen}
MODULES = {"mpc.pytorch": "mpc"}
#: Packages that are installed.
AVAILABLE = [name for name in PEERS if find_spec(MODULES.get(name, name))]
