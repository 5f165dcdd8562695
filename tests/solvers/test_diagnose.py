from __future__ import annotations

import time

import pytest
import torch
from torch import Tensor

from tests.campaign.families import FAMILIES, Draw
from tests.campaign.tally import alone
from tests.problems import HARD_ROWS, SOFT_ROWS, known_qp, random_mpc, soft_qps
from torch_qpmpc import QuadraticProgram, Status, solve_qp
from torch_qpmpc.condense import condensed_for
from torch_qpmpc.programs import FlatPrograms, SoftQPs
from torch_qpmpc.solvers.diagnose import diagnose

pytestmark = pytest.mark.filterwarnings("ignore:Clarabel.rs terminated with status")

INF = torch.inf


def program(H, q, G=(), lb=(), ub=(), w=(), *, C=(), b=()) -> QuadraticProgram:
    """A QP in two variables, from lists."""

    def matrix(rows) -> Tensor:
        return torch.tensor(rows, dtype=torch.float64).reshape(-1, 2)

    def vector(entries) -> Tensor:
        return torch.tensor(entries, dtype=torch.float64)

    return QuadraticProgram(
        matrix(H),
        vector(q),
        vector(0.0),
        matrix(C),
        vector(b),
        matrix(G),
        vector(lb),
        vector(ub),
        vector(w),
        check_values=False,
    )


UNIT, FLAT, NONE = [[1, 0], [0, 1]], [[1, 0], [0, 0]], [[0, 0], [0, 0]]
TWICE = [[1, 1], [1, 1]]
INFEASIBLE = {
    "two rows": program(UNIT, [1, 1], TWICE, [-INF, 2], [1, INF], [INF, INF]),
    "by a little": program(UNIT, [1, 1], TWICE, [-INF, 1.001], [1, INF], [INF, INF]),
    "far away": program(UNIT, [1, 1], TWICE, [-INF, 2e6], [1e6, INF], [INF, INF]),
    "badly scaled": program(
        UNIT, [1, 1], [[1e4, 1e4], [1e-4, 1e-4]], [-INF, 2e-4], [1e4, INF], [INF, INF]
    ),
    "beside a soft row": program(
        UNIT, [1, 1], [*TWICE, [1, 0]], [-INF, 2, 5], [1, INF, 6], [INF, INF, 1e6]
    ),
    "no variable": program(UNIT, [1, 1], [[0, 0]], [1], [2], [INF]),
    "unbounded too": program(NONE, [0, 1], [[1, 0], [1, 0]], [-INF, 2], [1, INF], [INF, INF]),
    "equalities": program(UNIT, [1, 1], C=[[1, 1], [1, 1]], b=[1, 2]),
    "equality and row": program(UNIT, [1, 1], [[1, 1]], [2], [3], [INF], C=[[1, 1]], b=[1]),
}
UNBOUNDED = {
    "no rows": program(NONE, [1, 1]),
    "flat direction": program(FLAT, [1, 1], [[1, 0]], [-1], [1], [INF]),
    "one side open": program(FLAT, [1, 1], [[0, 1]], [-INF], [1], [INF]),
    "weak slack": program(FLAT, [1, 10], [[0, 1]], [-1], [1], [2]),
    "free slack": program(FLAT, [1, 10], [[0, 1]], [-1], [1], [0]),
    "small slope": program(FLAT, [1, 1e-2], [[1, 0]], [-1], [1], [INF]),
    "large cost": program([[1e6, 0], [0, 0]], [1e6, 1e6], [[1, 0]], [-1], [1], [INF]),
}
INVALID = {
    "NaN in q": program(UNIT, [1, torch.nan]),
    "NaN in H": program([[torch.nan, 0], [0, 1]], [1, 1]),
    "NaN in ub": program(UNIT, [1, 1], [[1, 0]], [0], [torch.nan], [1]),
    "infinite G": program(UNIT, [1, 1], [[INF, 0]], [0], [1], [1]),
    "crossed bounds": program(UNIT, [1, 1], [[1, 0]], [1], [0], [1]),
    "empty interval": program(UNIT, [1, 1], [[1, 0]], [INF], [INF], [1]),
    "negative weight": program(UNIT, [1, 1], [[1, 0]], [0], [1], [-1]),
}
CASES = [
    *((name, qp, Status.INFEASIBLE) for name, qp in INFEASIBLE.items()),
    *((name, qp, Status.UNBOUNDED) for name, qp in UNBOUNDED.items()),
    *((name, qp, Status.INVALID_DATA) for name, qp in INVALID.items()),
]


@pytest.mark.parametrize(
    ("name", "qp", "status"), CASES, ids=[f"{s.name} {n}" for n, _, s in CASES]
)
def test_what_cannot_be_solved_is_named_and_soon(solver, name, qp, status):
    # Of this process's own time: a busy machine is not slow.
    began = time.process_time()
    solution = solve_qp(qp, solver=solver, on_failure="mask")
    assert time.process_time() - began < 2
    assert Status(int(solution.status)) == status
    assert solution.value == torch.inf


def test_an_infeasible_mpc_batch_is_named_and_soon(solver):
    options = {"horizon": 20, "state_slack": torch.inf, "action_slack": 1.0, "on_failure": "mask"}
    mpc = random_mpc(0, free=0.0, solver=solver, **options)
    began = time.process_time()
    solution = mpc.solve(torch.tensor([[2.0, 2.0], [5.0, 5.0], [-5.0, 5.0]]))
    assert time.process_time() - began < 2
    assert (solution.status == Status.INFEASIBLE).all()


@pytest.mark.parametrize("fixed", [[2.0], [2.0, 1.0]])
def test_fixed_entries_beyond_a_hard_row_are_infeasible(fixed):
    qp = program(UNIT, [1, 1], UNIT, [-1, -1], [1, 1], [INF, 5])
    solution = solve_qp(qp, torch.tensor(fixed).double(), solver="daqp", on_failure="mask")
    assert solution.status == Status.INFEASIBLE


def test_fixed_entries_that_break_an_equality_are_infeasible():
    qp = program(UNIT, [1, 1], C=[[1, 0]], b=[1])
    for s, status in ((1.0, Status.SOLVED), (2.0, Status.INFEASIBLE)):
        solution = solve_qp(qp, torch.tensor([s]).double(), solver="daqp", on_failure="mask")
        assert solution.status == status


def only(qp: QuadraticProgram) -> SoftQPs:
    """One QP without fixed entries, condensed."""
    programs, _ = FlatPrograms.of(*qp.tensors(), torch.zeros(0).double())
    return condensed_for(programs, 0).reduced(programs).at(programs)


def doubles(entries) -> Tensor:
    return torch.tensor(entries, dtype=torch.float64)


@pytest.mark.parametrize("rank", [None, 3, 0])
@pytest.mark.parametrize("weight", [1e-2, 5.0, 1e4])
def test_solvable_programs_are_neither_infeasible_nor_unbounded(rank, weight):
    options = {"rank": rank, "weight": weight, "soft": SOFT_ROWS, "hard": HARD_ROWS}
    status = diagnose(soft_qps(known_qp(1, batch=(4,), **options))[0])
    assert (status == Status.NOT_CONVERGED).all()


def test_each_element_of_a_batch_has_its_own_diagnosis():
    qps = SoftQPs(
        H=torch.zeros(1, 2, 2).double(),
        G=doubles([[[1.0, 0.0], [1.0, 0.0], [0.0, 1.0]]]),
        group=torch.zeros(3, dtype=torch.int64),
        g=doubles([[0.0, 0.0], [0.0, 0.0], [0.0, 5.0]]),
        l=doubles([[-1.0, -1.0, -1.0], [-1.0, 3.0, -1.0], [-1.0, -1.0, -1.0]]),
        u=doubles([[1.0, 1.0, 1.0], [1.0, 4.0, 1.0], [1.0, 1.0, 1.0]]),
        w=doubles([[INF, INF, 1.0]] * 3),
    )
    assert diagnose(qps).tolist() == [Status.NOT_CONVERGED, Status.INFEASIBLE, Status.UNBOUNDED]


def test_matrices_of_its_own_for_each_element():
    qps = SoftQPs(
        H=torch.stack([torch.eye(2), torch.zeros(2, 2)]).double(),
        G=doubles([[[1.0, 1.0], [1.0, 1.0]], [[1.0, 0.0], [2.0, 0.0]]]),
        group=torch.tensor([1, 0, 1]),
        g=doubles([[1.0, 1.0], [1.0, 1.0], [1.0, 0.0]]),
        l=doubles([[-1.0, -1.0], [-1.0, 3.0], [-1.0, -1.0]]),
        u=doubles([[1.0, 1.0], [1.0, 4.0], [1.0, 1.0]]),
        w=torch.full((3, 2), INF).double(),
    )
    assert diagnose(qps).tolist() == [Status.UNBOUNDED, Status.INFEASIBLE, Status.NOT_CONVERGED]


@pytest.mark.parametrize("curvature", [1e-4, 1e-8])
def test_little_curvature_is_not_called_unbounded(curvature):
    far = [1e9, 1e9]
    qp = program([[1, 0], [0, curvature]], [0, 1], [[1, 0], [0, 1]], [-1e9, -1e9], far, [1, 1])
    assert diagnose(only(qp)).tolist() == [Status.NOT_CONVERGED]


@pytest.mark.parametrize(
    ("family", "count", "seed", "index"),
    [
        ("infeasible", 128, 6, 70),  # rows that contradict each other by 1e-4
        ("infeasible", 16, 4, 2),
        ("infeasible", 16, 153, 0),  # ... and lead far away to another
        ("unbounded", 16, 42, 5),  # a slope of 1 on curvatures of 1 and 0
        ("unbounded", 16, 74, 6),
        ("scaled mixed", 16, 108, 4),
    ],
)
def test_what_was_once_called_not_converged_has_its_proof(family, count, seed, index):
    case = FAMILIES[family](Draw(seed), count)
    qp, fixed = alone(case, index)
    solution = solve_qp(qp, fixed, solver="daqp", on_failure="mask")
    assert solution.status == case.expected[index]


@pytest.mark.parametrize("far", [1.0, 1e2, 1e4, 1e6])
def test_hard_rows_that_hold_only_far_away_are_not_called_infeasible(far):
    rows = [[1, 0], [0, 1]]
    qp = program(rows, [0, 0], rows, [far, far], [2 * far, 2 * far], [INF, INF])
    assert diagnose(only(qp)).tolist() == [Status.NOT_CONVERGED]
