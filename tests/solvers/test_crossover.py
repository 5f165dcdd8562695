from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tests.problems import KnownQP, known_qp, programs_of
from torch_qpmpc.condense import SoftQPs, condense
from torch_qpmpc.solvers import Answer
from torch_qpmpc.solvers.crossover import MAX_STEPS, refine

BATCH = 5


def condensed(known: KnownQP) -> tuple[SoftQPs, Answer]:
    """What a backend is asked, and the exact answer to it."""
    programs = programs_of(known)
    form = condense(programs.H, programs.C, programs.G, known.fixed.shape[-1])
    qps, rows = form.soft_qps(programs)
    v = form.free_part(programs, known.z).numpy()
    return qps, Answer(v, known.lam[:, rows].numpy(), np.zeros(BATCH, dtype=np.int64))


@pytest.mark.parametrize("matrices", [(), (BATCH,)])
@pytest.mark.parametrize("seed", range(3))
def test_a_nearly_right_answer_becomes_exact(seed, matrices):
    qps, exact = condensed(known_qp(seed, batch=(BATCH,), matrices=matrices))
    noise = np.random.default_rng(seed)
    start = replace(
        exact,
        v=exact.v + 1e-3 * noise.standard_normal(exact.v.shape),
        lam=exact.lam + 1e-3 * noise.standard_normal(exact.lam.shape),
    )
    refined = refine(qps, start, np.arange(BATCH))
    assert_allclose(refined.v, exact.v, atol=1e-9)
    assert_allclose(refined.lam, exact.lam, atol=1e-9)
    assert (refined.iterations >= 1).all()
    assert (refined.iterations <= MAX_STEPS).all()


def test_only_the_chosen_answers_are_touched():
    qps, exact = condensed(known_qp(3, batch=(BATCH,)))
    start = replace(exact, v=exact.v + 1e-3)
    refined = refine(qps, start, np.array([1, 3]))
    untouched = [0, 2, 4]
    assert_allclose(refined.v[[1, 3]], exact.v[[1, 3]], atol=1e-9)
    assert_allclose(refined.v[untouched], start.v[untouched], rtol=0, atol=0)
    assert refined.iterations[untouched].tolist() == [0, 0, 0]
    assert_allclose(start.v, exact.v + 1e-3, rtol=0, atol=0)  # not in place


def test_a_start_far_off_ends_after_a_bounded_number_of_steps():
    qps, exact = condensed(known_qp(4, batch=(BATCH,)))
    start = replace(exact, v=exact.v + 1e3, lam=-exact.lam)
    assert refine(qps, start, np.arange(BATCH)).iterations.max() <= MAX_STEPS
