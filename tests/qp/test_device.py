"""The path of other devices, on a GPU or, without one, in tensors on the CPU.

It gives what the compiled path gives, and leaves the rest to that.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from unittest import mock

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

import torch_qpmpc as qm
from tests.figures import make_mpc
from tests.problems import BRINK, HARD_ROWS, MIXED, SOFT_ROWS, WEAK, known_qp, normal, random_mpc
from tests.problems import random_states as states
from tests.transitions import make_loss, transitions
from torch_qpmpc.envs import LinearSystemEnv, PointMass
from torch_qpmpc.qp.pipeline import solve
from torch_qpmpc.qp.solution import QPSolution
from torch_qpmpc.qp.solvers import BACKENDS, interior_point

DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")


@contextmanager
def in_tensors() -> Iterator[None]:
    """Let ``solver="torch"`` take the path of other devices on the CPU, too."""
    with mock.patch.object(solve, "accelerator", lambda x: x.device):
        yield


def moved(qp: qm.QuadraticProgram, device: torch.device) -> qm.QuadraticProgram:
    return qm.QuadraticProgram(*(x.to(device) for x in qp.tensors()), check_values=False)


def solution_and_gradients(
    known: Any, device: torch.device, solver: str
) -> tuple[QPSolution, list[Tensor]]:
    """Solve, and differentiate a random function of value, z, chi, lam and xi in all data."""
    data = [x.to(device).requires_grad_() for x in (*known.qp.tensors(), known.fixed)]
    qp = qm.QuadraticProgram(*data[:-1], check_values=False)
    solution = qm.solve_qp(qp, data[-1], solver=solver)
    parts = (solution.value, solution.z, solution.chi, solution.lam, solution.xi)
    weights = (normal(*x.shape, seed=i).to(x) for i, x in enumerate(parts))
    total = torch.stack([(w * x).sum() for w, x in zip(weights, parts, strict=True)]).sum()
    return solution, list(torch.autograd.grad(total, data))


KINDS: dict[str, dict[str, Any]] = {
    "shared": {"batch": (9,)},
    "own matrices": {"batch": (5,), "matrices": (5,)},
    "shared matrices of a larger batch": {"batch": (3, 4), "matrices": (4,)},
    "one": {},
    "empty": {"batch": (0,)},
    "semidefinite": {"batch": (6,), "rank": 10},
    "without C": {"batch": (4,), "n_c": 0},
    "without rows": {"batch": (4,), "soft": (), "hard": ()},
    "nothing fixed": {"batch": (4,), "n_f": 0},
    "weakly active": {"batch": (6,), "soft": (*SOFT_ROWS[:3], *WEAK), "hard": HARD_ROWS[:3]},
    "at the kink": {"batch": (6,), "soft": (*SOFT_ROWS[:3], *BRINK), "hard": HARD_ROWS[:3]},
    "float32": {"batch": (5,), "dtype": torch.float32},
}


@pytest.mark.parametrize("kind", KINDS)
def test_solutions_and_gradients_are_those_of_the_compiled_path(kind):
    known = known_qp(3, **KINDS[kind])
    expected, gradients = solution_and_gradients(known, torch.device("cpu"), "daqp")
    with in_tensors():
        solution, others = solution_and_gradients(known, DEVICE, "torch")
    error = 1e-4 if known.z.dtype == torch.float32 else 1e-5

    def assert_near(actual: Tensor, expected: Tensor) -> None:
        assert_close(actual.cpu(), expected, rtol=error, atol=error)

    assert solution.solved.all()
    assert solution.value.device.type == DEVICE.type
    assert_near(solution.value, known.value)
    assert_near(solution.z, expected.z)
    for gradient, other in zip(gradients, others, strict=True):
        assert other.device.type == DEVICE.type
        assert_near(other, gradient)


def test_units_and_own_thetas():
    """QPs of tiny and huge units, in one batch."""
    known = known_qp(5, batch=(4,), matrices=(4,))
    size = torch.tensor([1e-9, 1.0, 1e6, 1e9], dtype=torch.float64)
    H, q, c, C, b, G, lb, ub, w = known.qp.tensors()
    scaled = (H * size[:, None, None], q * size[:, None], c * size, C, b, G, lb, ub)
    qp = qm.QuadraticProgram(*scaled, w * size[:, None])
    with in_tensors():
        fixed = known.fixed.to(DEVICE)
        solution = qm.solve_qp(moved(qp, DEVICE), fixed, solver="torch")
    assert solution.solved.all()
    assert_close(solution.value.cpu() / size, known.value, rtol=1e-5, atol=1e-5)


def test_statuses():
    """One solvable, one infeasible, one unbounded and one invalid QP of one batch."""
    one, inf = torch.ones(4, 1, dtype=torch.float64), torch.inf
    H = torch.tensor([1.0, 1.0, 0.0, 1.0]).double().reshape(4, 1, 1)
    lb = torch.tensor([[-1.0, -inf], [2.0, -inf], [-inf, -inf], [-1.0, -inf]]).double()
    ub = torch.tensor([[1.0, 5.0], [3.0, 1.0], [inf, 5.0], [1.0, 5.0]]).double()
    q = torch.tensor([-2.0, 0.0, 1.0, torch.nan]).double().unsqueeze(-1)
    qp = qm.QuadraticProgram(H, q, G=one[:2], lb=lb, ub=ub, check_values=False)
    with in_tensors():
        solution = qm.solve_qp(moved(qp, DEVICE), solver="torch", on_failure="mask")
    expected = ["SOLVED", "INFEASIBLE", "UNBOUNDED", "INVALID_DATA"]
    assert [qm.Status(int(x)).name for x in solution.status] == expected
    assert_close(solution.z[0].cpu(), one[0])


@pytest.mark.parametrize("structure", ["free", "tied"])
def test_a_qpmpc(structure):
    """V, Q, the policy, and their gradients in theta, cold and warm."""
    mpc = random_mpc(structure=structure, solver="torch", **MIXED)
    there = random_mpc(structure=structure, solver="torch", **MIXED).to(DEVICE)
    s, a = states(40), states(40, 1, size=0.4)

    def results(mpc: qm.QPMPC, s: Tensor, a: Tensor) -> list[Tensor]:
        V, pi = mpc.value(s), mpc.policy(s)
        first = mpc.solve(s, a)
        Q = mpc.solve(s, a, warm_start=first.active).value
        total = V.sum() + Q.square().sum() + (pi * torch.arange(len(pi)).to(pi)[:, None]).sum()
        return [V, Q, pi, *torch.autograd.grad(total, list(mpc.parameters()))]

    expected = results(mpc, s, a)
    with in_tensors():
        actual = results(there, s.to(DEVICE), a.to(DEVICE))
    for x, y in zip(actual, expected, strict=True):
        assert_close(x.cpu(), y, rtol=1e-6, atol=1e-7)


def test_transforms():
    """The derivative under `torch.func`, over a vmapped batch."""
    mpc, there = random_mpc(solver="torch"), random_mpc(solver="torch").to(DEVICE)
    s = states(6)
    expected = torch.func.vmap(torch.func.grad(mpc.value))(s)
    with in_tensors():
        actual = torch.func.vmap(torch.func.grad(there.value))(s.to(DEVICE))
    assert_close(actual.cpu(), expected, rtol=1e-6, atol=1e-7)


def learned(device: torch.device) -> tuple[Tensor, list[Tensor]]:
    """Return a loss and theta after a `GaussNewton` step on fixed transitions."""
    mpc = random_mpc(solver="torch").to(device)
    operator = qm.QPActorValueOperator(mpc, active_set_key="active_set")
    loss_module = make_loss(operator=operator)
    batch = transitions(30)
    with torch.no_grad():
        cost = mpc.action_value(batch["observation"].to(device), batch["action"].to(device)).cpu()
    batch.set(("next", "reward"), 0.1 * states(30, 1, seed=4) - cost.unsqueeze(-1))
    batch = batch.to(device)
    loss = loss_module(batch)["loss_value"]
    loss.backward()
    target = -loss_module.target(batch).reshape(-1)
    report = qm.GaussNewton(mpc, damping=100.0).step(batch["observation"], batch["action"], target)
    assert report.accepted
    return loss.detach(), [x.detach() for x in mpc.parameters()]


def test_learning():
    loss, theta = learned(torch.device("cpu"))
    with in_tensors():
        there, others = learned(DEVICE)
    assert_close(there.cpu(), loss, rtol=1e-6, atol=1e-7)
    for x, y in zip(others, theta, strict=True):
        assert x.device.type == DEVICE.type
        assert_close(x.cpu(), y, rtol=1e-5, atol=1e-6)


def test_a_rollout():
    """Plant, policy and active sets are on the device, and actions are those of the policy."""
    mpc = make_mpc().to(DEVICE)
    mpc.solver = "torch"
    actor = qm.QPActorValueOperator(mpc).get_policy_operator("policy_active_set")
    env = LinearSystemEnv(PointMass(), seed=0, device=DEVICE)
    with in_tensors(), torch.no_grad():
        rollout = env.rollout(4, actor)
        expected = mpc.policy(rollout["observation"])
    assert rollout.device is None or rollout.device.type == DEVICE.type
    assert_close(rollout["action"], expected, rtol=1e-6, atol=1e-7)


def test_what_a_device_leaves_takes_the_ordinary_steps(monkeypatch):
    """Its method fails on half of the batch, and then on all of it."""
    mpc, s = random_mpc(solver="torch"), states(8)
    expected, whole = mpc.solve(s), interior_point.solve
    for wrong in (slice(None, None, 2), slice(None)):

        def spoilt(qps: Any, wrong: slice = wrong, **options: Any) -> Any:
            answer = whole(qps, **options)
            answer.v[wrong] = np.nan
            return answer

        monkeypatch.setattr(interior_point, "solve", spoilt)
        monkeypatch.setitem(BACKENDS, "torch", BACKENDS["daqp"])
        with in_tensors():
            solution = mpc.to(DEVICE).solve(s.to(DEVICE))
        assert_close(solution.value.cpu(), expected.value, rtol=1e-9, atol=1e-9)
