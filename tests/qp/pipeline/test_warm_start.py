import numpy as np
import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from tests.problems import known_qp, normal, programs_of, random_mpc, random_states
from torch_qpmpc import SolveLog, solve_qp
from torch_qpmpc.qp.program import UNKNOWN

BATCH = 6


def true_set(seed: int, matrices: tuple[int, ...] = ()):
    """Return QPs with their exact solution, and its active set."""
    known = known_qp(seed, batch=(BATCH,), matrices=matrices)
    solution = solve_qp(known.qp, known.fixed, solver="torch")
    return programs_of(known), known, solution.active.numpy()


def test_codes_describe_each_rows_state():
    known = known_qp(4, batch=(BATCH,))
    active = solve_qp(known.qp, known.fixed, solver="torch").active
    assert active.dtype == torch.int8
    assert torch.equal(active.sign(), known.lam.sign().to(torch.int8))
    saturated = known.sigma > 0
    assert saturated.any()
    assert torch.equal(active.abs() == 2, saturated)


@pytest.mark.parametrize("change", [(1, 0), (-1, 0), (1, -1)])
def test_a_row_in_a_wrong_state_is_corrected(change):
    mpc, s = random_mpc(4, horizon=6), random_states(48, size=0.7)
    solution = mpc.solve(s)
    active, count = solution.active, 0
    for codes in active:
        where = (codes[2:] == change[0]).nonzero()
        if len(where):
            codes[2 + where[len(where) // 2]], count = change[1], count + 1
    assert count > 4
    mpc.solver = "torch"
    with SolveLog() as log:
        again = mpc.solve(s, warm_start=active)
    assert_close(again.value, solution.value)
    assert log.recalled >= 48 - count // 3
    assert again.iterations.max() > 1


def test_the_active_sets_given_are_not_changed():
    p, _, active = true_set(6)
    wrong = -active
    before = wrong.copy()
    p.recalled(wrong)
    assert (wrong == before).all()


def test_an_unknown_active_set_is_tried_as_a_similar_ones_and_the_first_as_empty():
    p, _, active = true_set(5)
    empty, unknown = active.copy(), active.copy()
    empty[[0, 1, 2, 4]] = 0
    unknown[:3, 4] = UNKNOWN
    unknown[4, 0] = -128
    answer, of_empty = p.recalled(unknown), p.recalled(empty)
    assert not answer.status.any()
    np.testing.assert_allclose(answer.z, of_empty.z, rtol=1e-9, atol=1e-9)
    assert answer.iterations[0] == of_empty.iterations[0] > 1
    assert answer.iterations[3] == of_empty.iterations[3] == 1


@pytest.mark.parametrize("rank", [0, 1])
def test_a_cost_without_curvature_is_left_to_the_solver(rank):
    known = known_qp(7, batch=(BATCH,), rank=rank)
    active = solve_qp(known.qp, known.fixed, solver="daqp").active
    solution = solve_qp(known.qp, known.fixed, solver="torch", warm_start=active)
    assert_close(solution.value, known.value)


def test_nonsense_does_no_harm(solver):
    known = known_qp(8, batch=(BATCH,))
    codes = (5 * normal(BATCH, 13)).clamp(-100, 100).to(torch.int8)
    solution = solve_qp(known.qp, known.fixed, solver=solver, warm_start=codes)
    assert_close(solution.value, known.value)


def moved(solver: str, size: float) -> tuple[Tensor, Tensor, SolveLog]:
    """Solve cold and from the active sets of another theta; return both values and the warm log."""
    mpc, s = random_mpc(9, solver=solver, horizon=8), random_states(64, size=0.7)
    active = mpc.solve(s).active
    with torch.no_grad():
        mpc.C += size * normal(*mpc.C.shape)
    with SolveLog() as log:
        warm = mpc.solve(s, warm_start=active)
    return mpc.value(s), warm.value, log


@pytest.mark.parametrize("size", [1e-4, 1e-2, 0.3])
def test_active_sets_of_another_theta_lead_to_the_same_values(solver, size):
    cold, warm, log = moved(solver, size)
    assert_close(warm, cold, rtol=1e-6, atol=1e-6)
    assert log.fallback == 0
    if size < 1e-3:
        assert log.recalled > 0.9 * log.solves
