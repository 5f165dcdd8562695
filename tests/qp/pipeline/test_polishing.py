from __future__ import annotations

import numpy as np
import pytest
from torch.testing import assert_close

from tests.problems import KnownQP, known_qp, normal, soft_qps
from torch_qpmpc.qp.pipeline.polishing import MAX_STEPS, refine
from torch_qpmpc.qp.solvers import BackendSolution
from torch_qpmpc.qp.solvers.base import SoftQPs

BATCH = 5


def in_numpy(known: KnownQP) -> tuple[SoftQPs, BackendSolution]:
    """Return a backend's input and its exact solution as arrays."""
    qps, exact = soft_qps(known)
    return qps.in_numpy(), exact.like(np.empty(0))


@pytest.mark.parametrize("matrices", [(), (BATCH,)])
@pytest.mark.parametrize("seed", range(3))
def test_a_nearly_right_answer_becomes_exact(seed, matrices):
    qps, exact = in_numpy(known_qp(seed, batch=(BATCH,), matrices=matrices))
    start = exact._replace(
        v=exact.v + 1e-3 * normal(*exact.v.shape, seed=seed).numpy(),
        lam=exact.lam + 1e-3 * normal(*exact.lam.shape, seed=seed + 1).numpy(),
    )
    refined = refine(qps, start, np.arange(BATCH))
    assert_close(refined.v, exact.v, rtol=0, atol=1e-9)
    assert_close(refined.lam, exact.lam, rtol=0, atol=1e-9)
    assert (refined.iterations >= 1).all()
    assert (refined.iterations <= MAX_STEPS).all()


def test_only_the_chosen_answers_are_touched():
    qps, exact = in_numpy(known_qp(3, batch=(BATCH,)))
    start = exact._replace(v=exact.v + 1e-3)
    refined = refine(qps, start, np.array([1, 3]))
    untouched = [0, 2, 4]
    assert_close(refined.v[[1, 3]], exact.v[[1, 3]], rtol=0, atol=1e-9)
    assert_close(refined.v[untouched], start.v[untouched], rtol=0, atol=0)
    assert refined.iterations[untouched].tolist() == [0, 0, 0]
    assert_close(start.v, exact.v + 1e-3, rtol=0, atol=0)  # not in place


def test_a_start_far_off_ends_after_a_bounded_number_of_steps():
    qps, exact = in_numpy(known_qp(4, batch=(BATCH,)))
    start = exact._replace(v=exact.v + 1e3, lam=-exact.lam)
    assert refine(qps, start, np.arange(BATCH)).iterations.max() <= MAX_STEPS
