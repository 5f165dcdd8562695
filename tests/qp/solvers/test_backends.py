from dataclasses import replace

import pytest
import torch
from torch.testing import assert_close

from tests import problems
from tests.references import by_cvxpy, by_quadprog
from tests.refused import refused
from torch_qpmpc import SolveLog, solve_qp
from torch_qpmpc.qp.solvers import BACKENDS, backend

BATCHES = [((), ()), ((1,), ()), ((6,), ()), ((6,), (6,)), ((3, 4), (3, 1)), ((3, 4), (4,))]


def assert_solves(
    known: problems.KnownQP, solver: str, *, only_value: bool = False, scale: float = 1.0
) -> None:
    """Solve without another solver's help, and compare with the known solution."""
    with SolveLog() as log:
        solution = solve_qp(known.qp, known.fixed, solver=solver)
    assert log.fallback == 0
    assert solution.residual.max() < 1e-6
    for name, expected in problems.solution_of(known).items():
        if name == "value" or not only_value:
            tolerance = 1e-6 if name == "value" else 1e-4
            actual = getattr(solution, name)
            atol = scale * tolerance
            assert_close(
                actual, expected, rtol=tolerance, atol=atol, msg=lambda m, n=name: f"{n} {m}"
            )


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("batch", "matrices"), BATCHES)
def test_known_solutions_are_found(solver, batch, matrices, seed):
    assert_solves(problems.known_qp(seed, batch=batch, matrices=matrices), solver)


@pytest.mark.parametrize("batch", [(0,), (2, 0)])
def test_an_empty_batch_is_solved(solver, batch):
    known = problems.known_qp(0, batch=batch)
    solution = solve_qp(known.qp, known.fixed, solver=solver)
    assert solution.value.shape == batch
    again = solve_qp(known.qp, known.fixed, solver=solver, warm_start=solution)
    assert again.value.shape == batch


@pytest.mark.parametrize(
    "options",
    [
        {"hard": ()},
        {"soft": ()},
        {"soft": (), "hard": ()},
        {"soft": ("free",), "hard": ()},
        {"soft": ("no_upper",), "hard": ("no_upper",)},
        {"n_c": 0},
        {"n_f": 0},
        {"n_c": 0, "n_f": 0},
        {"n_f": 9, "soft": ("inside", "above", "below"), "hard": ("inside",)},  # no free variable
        {"n_f": 12, "n_c": 0, "soft": ("inside", "above", "below"), "hard": ("inside",)},
        {"n_z": 30, "n_c": 12, "n_f": 4},
    ],
    ids=str,
)
def test_parts_of_a_program_may_be_missing(solver, options):
    assert_solves(problems.known_qp(1, batch=(4,), **options), solver)


@pytest.mark.parametrize("seed", range(3))
def test_soft_rows_with_one_bound(solver, seed):
    assert_solves(problems.one_sided(seed), solver)


@pytest.mark.parametrize("weight", [1e-2, 1.0, 1e2, 1e4])
def test_slack_weights_of_any_size(solver, weight):
    assert_solves(problems.known_qp(2, batch=(6,), weight=weight), solver, scale=max(weight, 1.0))


@pytest.mark.parametrize("rank", [0, 1, 5])
def test_costs_without_curvature(solver, rank):
    assert_solves(problems.known_qp(3, batch=(6,), rank=rank), solver, only_value=True)


def test_the_answer_does_not_depend_on_what_was_solved_before(solver):
    known, other = problems.known_qp(5, batch=(3,)), problems.known_qp(6, batch=(3,))
    first = solve_qp(known.qp, known.fixed, solver=solver)
    solve_qp(other.qp, other.fixed, solver=solver)
    again = solve_qp(known.qp, known.fixed, solver=solver)
    assert_close(again.z, first.z, rtol=0, atol=0)
    assert_close(again.chi, first.chi, rtol=0, atol=0)


@pytest.mark.usefixtures("two_threads")
def test_solving_in_parallel_changes_nothing_but_the_time(solver):
    known = problems.known_qp(7, batch=(16,))
    assert_solves(known, solver)
    assert torch.get_num_threads() == 2


# Against other solvers, on programs not made from a solution


@pytest.fixture(scope="module", params=["V", "Q"])
def mpc_case(request):
    """Make a QP with dense C, states (and actions), and reference values and solutions."""
    learn = ("H", "H_f", "q", "c", "C", "b")
    mpc = problems.random_mpc(1, free=0.2, learn=learn)
    s, a = problems.random_states(8), problems.random_states(8, 1, size=0.5)
    fixed = torch.cat((s, a), -1) if request.param == "Q" else s
    qp = mpc.quadratic_program()
    return qp, fixed, [(by_cvxpy(qp, one), by_quadprog(qp, one)) for one in fixed]


def test_two_other_solvers_of_the_printed_program_agree(solver, mpc_case):
    qp, fixed, references = mpc_case
    with SolveLog() as log:
        solution = solve_qp(qp, fixed, solver=solver)
    assert log.fallback == 0
    for i, both in enumerate(references):
        for value, z in both:
            assert_close(solution.value[i].item(), value, rtol=1e-6, atol=1e-6)
            assert_close(solution.z[i].detach(), z, rtol=1e-4, atol=1e-4)


# Warm starts


@pytest.mark.parametrize("name", BACKENDS)
def test_a_warm_start_from_the_solution_saves_iterations(name):
    mpc, s = problems.random_mpc(13, solver=name, horizon=8), problems.random_states(12, size=0.7)
    cold = mpc.solve(s)
    warm = mpc.solve(s, warm_start=cold.active)
    assert warm.iterations.sum() < 0.7 * cold.iterations.sum()


# The table of backends


@refused(
    ("daq", r"solver: got 'daq', expected one of proxqp, daqp, .* Did you mean 'daqp'\?"),
    ("simplex", r"solver: got 'simplex', expected one of proxqp, daqp, .*qpsolvers:NAME\.$"),
    (None, r"solver: got None, expected one of proxqp, daqp"),
    ("qpsolvers:nothing", r"solver: got 'qpsolvers:nothing', expected one of \[.*'clarabel'"),
    ("qpsolvers:", r"solver: got 'qpsolvers:', .* pip install qpsolvers\[\]"),
)
def test_an_unknown_backend_is_named(name):
    backend(name)


def test_rows_that_are_hard_in_some_of_a_batch_only(solver):
    """A backend's model must not be reused across patterns of soft rows."""
    known = problems.known_qp(5, batch=(24,))
    w = known.qp.w.expand(24, -1).clone()
    inside = (known.sigma == 0) & w.isfinite()
    harden = inside & (torch.arange(24) % 3 == 0).unsqueeze(-1)
    mixed = replace(known.qp, w=torch.where(harden, torch.inf, w))
    for _ in range(3):
        solution = solve_qp(mixed, known.fixed, solver=solver)
    assert harden.any()
    assert_close(solution.value, known.value)
