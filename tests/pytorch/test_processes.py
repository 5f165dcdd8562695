"""Solving in threads and processes with every solver, after and during other solves."""

import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.func import grad, jacrev, vmap
from torch.testing import assert_close

from tests.problems import drawn_mpc, random_mpc, random_states
from tests.runs import ended
from torch_qpmpc import QPMPC
from torch_qpmpc.qp.solvers import BACKENDS

METHODS = [x for x in ("fork", "spawn") if x in torch.multiprocessing.get_all_start_methods()]
#: Seconds after which a hanging child is killed.
WATCHDOG = 120


def loss(mpc: QPMPC, s: Tensor, a: Tensor) -> Tensor:
    target = 1.0 + 0.9 * mpc.value(-s).detach()
    return (mpc.action_value(s, a) - target).square().mean()


FEATURES: dict[str, Callable[[QPMPC, Tensor, Tensor], Tensor]] = {
    "value": lambda mpc, s, a: mpc.value(s),
    "action value": lambda mpc, s, a: mpc.action_value(s, a),
    "policy": lambda mpc, s, a: mpc.policy(s),
    "loss": loss,
    "loss in theta": lambda mpc, s, a: torch.autograd.grad(loss(mpc, s, a), mpc.C)[0],
    "dV/ds": lambda mpc, s, a: vmap(grad(mpc.value))(s),
    "Hessian in s": lambda mpc, s, a: vmap(jacrev(jacrev(mpc.value)))(s),
}


def answers(mpc: QPMPC) -> dict[str, Tensor]:
    s, a = random_states(8), random_states(8, 1, size=0.4)
    return {name: feature(mpc, s, a).detach() for name, feature in FEATURES.items()}


def compare(expected: dict[str, Tensor], found: dict[str, Tensor]) -> None:
    for name in FEATURES:
        assert_close(found[name], expected[name], rtol=1e-9, atol=1e-9, msg=name)


def check(mpcs: list[QPMPC], expected: list[dict[str, Tensor]], threads: int | None = None) -> None:
    threads = torch.get_num_threads() if threads is None else threads
    assert torch.get_num_threads() == threads
    for mpc, known in zip(mpcs, expected, strict=True):
        compare(known, answers(mpc))
        assert torch.get_num_threads() == threads
    large = drawn_mpc(6, 3, 40)  # of a size at which torch takes several threads
    large.policy(random_states(2, 6))
    assert torch.get_num_threads() == threads


def scenario(method: str, *solvers: str) -> None:
    """Solve with two threads, in a child, and again, with shared modules."""
    torch.set_num_threads(2)
    torch.ones(2_000_000).exp().sum()  # OpenMP's threads exist when the child is forked
    mpcs = [random_mpc(0, solver=name).share_memory() for name in solvers or BACKENDS]
    expected = [answers(mpc) for mpc in mpcs]
    context: Any = torch.multiprocessing.get_context(method)
    threads = 1 if method == "fork" else None
    child = context.Process(target=check, args=(mpcs, expected, threads), daemon=True)
    child.start()
    child.join(WATCHDOG)
    code = child.exitcode
    child.kill()
    assert code == 0, "it hung" if code is None else "it failed"
    check(mpcs, expected)
    assert torch.get_num_threads() == 2


@pytest.mark.skipif("fork" not in METHODS, reason="not on this platform")
def test_a_fork_has_the_answers_of_its_parent():
    scenario("fork", "daqp")


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_a_child_has_the_answers_of_its_parent(method):
    """With each solver."""
    code = f"from tests.pytorch.test_processes import scenario; scenario({method!r})"
    ended(sys.executable, "-c", code)


def test_threads_that_solve_at_once_get_the_same_answers(solver):
    mpcs = [random_mpc(seed, solver=solver) for seed in range(4)]
    expected = [answers(mpc) for mpc in mpcs]
    with ThreadPoolExecutor(4) as pool:
        for known, found in zip(expected, pool.map(answers, mpcs), strict=True):
            compare(known, found)


def test_shared_memory_shows_an_update_of_theta():
    mpc, s = random_mpc(0).share_memory(), random_states(4)
    assert all(part.is_shared() for part in (*mpc.parameters(), *mpc.buffers()))
    before = mpc.value(s).detach()
    with torch.no_grad():
        mpc.C[:, 0].add_(0.1)  # a multiple of C would be the same QP
    assert (mpc.value(s) - before).abs().max() > 1e-6
