import time
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from tests.problems import HARD_ROWS, SOFT_ROWS, known_qp, programs_of
from torch_qpmpc import QPMPC, QuadraticProgram, SolverError, Status, solve_qp
from torch_qpmpc.qp.pipeline import solve
from torch_qpmpc.qp.pipeline.batch import Programs
from torch_qpmpc.qp.pipeline.diagnosis import diagnose

pytestmark = pytest.mark.filterwarnings("ignore:Clarabel.rs terminated with status")

INF = torch.inf


def program(H, q, G=(), lb=(), ub=(), w=(), *, C=(), b=()) -> QuadraticProgram:
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
def test_unsolvable_qps_are_diagnosed_quickly(solver, name, qp, status):
    # In processor time, so that other load does not matter.
    began = time.process_time()
    solution = solve_qp(qp, solver=solver, on_failure="mask")
    assert time.process_time() - began < 2
    assert Status(int(solution.status)) == status
    assert solution.value == torch.inf


def test_many_infeasible_qps_are_diagnosed_before_other_eliminations(solver, monkeypatch):
    def slow(*_: Any) -> Any:
        raise AssertionError

    monkeypatch.setattr(solve, "OTHER_ELIMINATIONS", (slow,))
    options: dict[str, Any] = {"stage_weight": [1.0, 0.1], "state_bounds": ([-1.0], [1.0])}
    options |= {"state_slack": INF, "action_bounds": ([-1.0], [1.0]), "solver": solver}
    mpc = QPMPC.from_model([[1.5]], [[1.0]], 3, on_failure="mask", **options)
    s = torch.linspace(5, 6, 2 * solve.FEW)[:, None]
    assert (mpc.solve(s).status == Status.INFEASIBLE).all()


ROWS, EQUALITY = (UNIT, [-1, -1], [1, 1], [INF, 5]), {"C": [[1, 0]], "b": [1]}


@pytest.mark.parametrize(
    ("qp", "fixed", "status"),
    [
        (program(UNIT, [1, 1], *ROWS), [2.0], Status.INFEASIBLE),
        (program(UNIT, [1, 1], *ROWS), [2.0, 1.0], Status.INFEASIBLE),
        (program(UNIT, [1, 1], **EQUALITY), [1.0], Status.SOLVED),
        (program(UNIT, [1, 1], **EQUALITY), [2.0], Status.INFEASIBLE),
    ],
)
def test_fixed_entries_beyond_a_hard_row_or_off_an_equality_are_infeasible(qp, fixed, status):
    assert solve_qp(qp, doubles(fixed), solver="daqp", on_failure="mask").status == status


def test_a_cost_that_is_only_convex_in_the_rest_of_z_is_unbounded_where_fixed_entries_tilt_it():
    qp = QuadraticProgram(doubles([[0.0, 1.0], [1.0, 0.0]]), doubles([0.0, 1.0]), n_known=1)
    solution = solve_qp(qp, doubles([[1.0], [-1.0]]), solver="daqp", on_failure="mask")
    assert solution.status.tolist() == [Status.UNBOUNDED, Status.SOLVED]


def doubles(entries) -> Tensor:
    return torch.tensor(entries, dtype=torch.float64)


@pytest.mark.parametrize("rank", [None, 3, 0])
@pytest.mark.parametrize("weight", [1e-2, 5.0, 1e4])
def test_solvable_programs_are_neither_infeasible_nor_unbounded(rank, weight):
    options = {"rank": rank, "weight": weight, "soft": SOFT_ROWS, "hard": HARD_ROWS}
    status = diagnose(programs_of(known_qp(1, batch=(4,), **options)))
    assert (status == Status.NOT_CONVERGED).all()


def far_away(far: float) -> QuadraticProgram:
    return program(UNIT, [0, 0], UNIT, [far, far], [2 * far, 2 * far], [INF, INF])


def nearly_flat(curvature: float) -> QuadraticProgram:
    return program([[1, 0], [0, curvature]], [0, 1], UNIT, [-1e9, -1e9], [1e9, 1e9], [1, 1])


def meeting(slope: float) -> QuadraticProgram:
    """Make x >= 1 and y <= 0 with x <= y (1 - slope) + .., which meet where y is -1 / slope."""
    return program(UNIT, [0, 0], [[1, -1], [1, slope - 1]], [-INF, 1], [0, INF], [INF, INF])


@pytest.mark.parametrize(
    "qp",
    [
        *map(far_away, (1.0, 1e2, 1e4, 1e6)),
        *map(nearly_flat, (1e-4, 1e-8)),
        *map(meeting, (1e-7, 1e-9, 1e-11)),
    ],
)
def test_solutions_that_are_far_away_are_no_proof(qp):
    programs, _ = Programs.of(*qp.tensors(), torch.zeros(0).double())
    assert diagnose(programs).tolist() == [Status.NOT_CONVERGED]


#: Settings with soft states and hard action bounds, feasible and bounded for every state.
BOUNDED: dict[str, Any] = {
    "stage_weight": [1.0, 0.1, 0.01],
    "terminal_weight": [1.0, 1.0],
    "state_bounds": ([-2, -10], [2, 10]),
    "action_bounds": ([-1.0], [1.0]),
}


def growing(radius: float, horizon: int, **options: Any) -> QPMPC:
    A = [[radius, 0.1], [0.0, radius]]
    return QPMPC.from_model(A, [[0.0], [0.1]], horizon, **(BOUNDED | options))


@pytest.mark.parametrize(
    ("radius", "horizon", "value"),
    # Computed by two solvers and two eliminations, which agree to the digits given.
    [(1.5, 30, 741101226.75), (1.5, 50, 3.557525499e14), (2.0, 50, 2.65969067e27)],
)
def test_states_that_no_action_holds_are_solved(solver, radius, horizon, value):
    mpc = growing(radius, horizon, solver=solver)
    assert_close(mpc.value(doubles([[1.0, 0.0]])), doubles([value]), rtol=1e-6, atol=0)


@pytest.mark.parametrize("horizon", [10, 30, 50])
def test_an_unstable_plant_that_the_actions_hold_is_solved(solver, horizon):
    mpc = growing(1.5, horizon, solver=solver)
    s = doubles([[0.01, 0.01], [0.0, 0.05]])
    held = mpc.solve(s)
    states, _ = mpc.predicted(held.z)
    assert states.abs().max() < 1
    assert_close(held.value, doubles([0.0111, 0.0048]), rtol=0.05, atol=0)


@pytest.mark.parametrize(
    ("solver", "A", "horizon"),
    [
        # At the edge of what |u| <= 1 holds.
        *((solver, [[2.0, 0.1], [0.0, 2.0]], 40) for solver in ("daqp", "proxqp")),
        # A norm of 1,000, and states of 1e90.
        *((solver, [[800.0, 600.0], [-600.0, 800.0]], 30) for solver in ("daqp", "torch")),
        ("qpsolvers:clarabel", [[1.0, 1e3], [1e3, 1.0]], 20),
    ],
)
def test_qps_beyond_float64_are_not_infeasible(solver, A, horizon):
    mpc = QPMPC.from_model(A, [[0.0], [0.1]], horizon, solver=solver, on_failure="mask", **BOUNDED)
    status = mpc.solve(doubles([[0.0, 0.05], [1.0, 0.0], [-1.5, 3.0]])).status
    assert not ((status == Status.INFEASIBLE) | (status == Status.UNBOUNDED)).any()


def test_not_converged_names_conditioning_and_the_remedy():
    mpc = growing(2.0, 40, solver="daqp")
    message = "1 NOT_CONVERGED.*unstable model over a long horizon: shorten the horizon"
    with pytest.raises(SolverError, match=message):
        mpc.value(doubles([[0.0, 0.05]]))


def test_an_unstable_plant_that_is_infeasible_has_its_proof(solver):
    options = {"state_slack": torch.inf, "on_failure": "mask", "solver": solver}
    mpc = growing(1.5, 30, **options)
    s = doubles([[1.9, 9.9], [-1.9, 0.0]])
    assert (mpc.solve(s).status == Status.INFEASIBLE).all()


def test_multipliers_that_decay_over_a_long_horizon_are_a_proof():
    A, B = [[1.05, 0.1, 0.0], [0.98, 1.05, 0.0], [0.0, 0.0, 1.0]], [[0.005], [0.1], [0.0]]
    rows = [[0, 1.0, 0, 0], [1.0, 0, 0, 0], [0, 0, 1.0, 1.0]], [-0.5, -1, -14], [1.2, 0.9, 14]
    weights = {"stage_weight": [1.0, 0.0, 0.0, 0.01], "terminal_weight": [1.0, 0.0, 0.0]}
    options = {"constraints": rows, "constraint_slack": INF, "solver": "daqp", **weights}
    mpc = QPMPC.from_model(A, B, 30, structure="tied", on_failure="mask", **options)
    s = [[-0.086, 1.173, 29.602], [0.731, 0.995, 23.436], [-0.8, 0.678, -28.512]]
    s += [[-0.284, 0.639, -29.973], [0.07, 0.551, 27.451], [0.079, -0.223, 26.718]]
    assert (mpc.solve(doubles(s)).status == Status.INFEASIBLE).all()


def test_noise_beside_large_numbers_spoils_no_proof(solver):
    flat = QPMPC.from_model(
        [[1.0]],
        [[1.0, 1.0]],
        1,
        stage_weight=[1.0, 0.1, 0.0],
        terminal_weight=[0.0],
        learn=("q",),
        solver=solver,
        on_failure="mask",
    )
    with torch.no_grad():
        flat.q[2] = 1.0
    assert flat.solve(doubles([0.0])).status == Status.UNBOUNDED
    options = {"state_bounds": ([-2, -2], [2, 2]), "state_slack": torch.inf}
    options["stage_weight"] = [1.0, 1.0, 0.0]
    A, B = [[1.5, 0.1], [0.0, 1.2]], [[0.0], [1.0]]
    mpc = QPMPC.from_model(A, B, 3, solver=solver, on_failure="mask", **options)
    assert mpc.solve(doubles([1.9, 0.0])).status == Status.INFEASIBLE
