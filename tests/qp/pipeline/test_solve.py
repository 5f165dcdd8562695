import itertools
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import pytest
import torch
from torch.testing import assert_close

import torch_qpmpc
import torch_qpmpc as qm
from tests.problems import KnownQP, certified, known_qp, normal
from torch_qpmpc.envs import PointMass
from torch_qpmpc.qp.pipeline import refinement
from torch_qpmpc.qp.pipeline.arrays import BatchSolution, SoftQPs
from torch_qpmpc.qp.pipeline.batch import Programs
from torch_qpmpc.qp.pipeline.solve import FEW, AtRest
from torch_qpmpc.qp.program import UNKNOWN
from torch_qpmpc.qp.solution import QPSolution
from torch_qpmpc.qp.solvers import BACKENDS, Backend, BackendSolution, daqp, interior_point

ROOT = str(Path(torch_qpmpc.__file__).parent)
BATCH = 6


def doctored(change: Callable[[BackendSolution], BackendSolution]) -> Backend:
    def solve(qps: SoftQPs) -> BackendSolution:
        return change(daqp.solve(qps))

    return solve


LIES = {
    "zeros": lambda answer: answer._replace(v=0 * answer.v, lam=0 * answer.lam),
    "NaN": lambda answer: answer._replace(v=np.nan * answer.v),
    "v off": lambda answer: answer._replace(v=answer.v + 1.0),
    "lam off": lambda answer: answer._replace(lam=answer.lam + 1.0),
    "lam's sign": lambda answer: answer._replace(lam=-answer.lam),
    "one's answer for all": lambda answer: answer._replace(v=answer.v[:1] + 0 * answer.v),
}

INACCURACIES = {
    "v off": lambda answer: answer._replace(v=answer.v + 1e-5),
    "lam off": lambda answer: answer._replace(lam=answer.lam + 1e-4),
}


@pytest.fixture
def liar(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> str:
    monkeypatch.setitem(BACKENDS, "liar", doctored(LIES[request.param]))
    return "liar"


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[SoftQPs]:
    """Record the QPs that the backend "recorder", a DAQP, gets."""
    batches = []

    def recording(qps: SoftQPs) -> BackendSolution:
        batches.append(qps)
        return daqp.solve(qps)

    monkeypatch.setitem(BACKENDS, "recorder", recording)
    return batches


def counts(asked: list[SoftQPs]) -> list[int]:
    return [len(qps.g) for qps in asked]


def solve(known: KnownQP, **options) -> QPSolution:
    return qm.solve_qp(known.qp, known.fixed, **options)


def assert_right(solution: QPSolution, known: KnownQP) -> None:
    assert (solution.status == qm.Status.SOLVED).all()
    assert_close(solution.value, known.value)
    assert_close(solution.z, known.z, rtol=1e-4, atol=1e-4)


# A cost of zero, at bounds that hold all variables


@pytest.mark.parametrize(
    ("off", "ub", "w", "refined"),
    [
        (1e-13, 15.0, torch.inf, False),
        (1e-13, 15.0, 10.0, True),  # without hard bounds nothing says how large a cost can be
        (1e-7, 15.0, torch.inf, True),
        (1e-7, 1e12, torch.inf, True),  # a bound in place of inf says no more
    ],
)
def test_errors_of_a_cost_of_zero_are_relative_to_the_swing(monkeypatch, off, ub, w, refined):
    def above(answer: BackendSolution) -> BackendSolution:
        return answer._replace(v=answer.v + off, iterations=0 * answer.iterations)

    monkeypatch.setitem(BACKENDS, "above", doctored(above))
    H, G = torch.diag(torch.tensor([0.0, 1e-4, 1e-4])), torch.tensor([[0, 3.0, 0], [0, 0, 0.5]])
    two, q = torch.ones(2).double(), torch.tensor([0.0, 0.03, 0.7]).double()
    parts: Any = {"G": G.double(), "lb": 0 * two, "ub": ub * two, "w": w * two}
    qp = qm.QuadraticProgram(H.double(), q, **parts, check_values=False)
    solution = qm.solve_qp(qp, torch.linspace(0.5, 1, BATCH).double()[:, None], solver="above")
    assert solution.iterations.any() == refined  # those of the refinement
    assert_close(solution.value, torch.zeros(BATCH).double(), atol=1e-12, rtol=0)


def standing(stages: int) -> qm.QuadraticProgram:
    """Return a body on one of two legs at a time: all forces that carry it cost nothing."""
    dt, n = 0.02, 4 * stages
    C, ub = torch.zeros(2 * stages, n).double(), torch.full((stages, 4), torch.inf).double()
    for k in range(stages):  # f_1, f_2, height and speed of each stage
        C[2 * k : 2 * k + 2, 4 * k : 4 * k + 4] = torch.tensor([[0, 0, 1, 0], [-dt, -dt, 0, 1]])
        if k:
            C[2 * k : 2 * k + 2, 4 * k - 2 : 4 * k] = torch.tensor([[-1, -dt], [0, -1]])
        ub[k, k // 2 % 2] = 0
    rows = torch.tensor([[1.0, 0, 0, 0], [0, 1, 0, 0], [0.3, 0, 0, 0], [0, 0.3, 0, 0]]).double()
    H = torch.diag(torch.tensor([0, 0, 10, 0.3]).double().repeat(stages))
    b, G = torch.tensor([0, -9.81 * dt]).double().repeat(stages), torch.block_diag(*[rows] * stages)
    q = torch.zeros(n).double()
    return qm.QuadraticProgram(H, q, C=C, b=b, G=G, lb=q, ub=ub.flatten())


@pytest.mark.parametrize("solver", BACKENDS)
def test_a_cost_of_zero_without_curvature_is_certified(solver):
    solution = qm.solve_qp(standing(8), solver=solver)
    assert_close(solution.value, torch.zeros(()).double(), atol=1e-18, rtol=0)


@pytest.mark.parametrize(("speed", "right"), [(1e-12, True), (1e-6, False)])
def test_rounding_of_multipliers_that_cancel_is_no_error_of_the_value(speed, right):
    qp = standing(2)
    p, _ = Programs.of(*qp.tensors(), torch.zeros(1, 0).double())
    z, lam, chi = torch.zeros(1, 8).double(), torch.zeros(1, 8).double(), torch.zeros(1, 4).double()
    z[0, [1, 5]] = 9.81 + torch.tensor([speed, -speed]).double() / 0.02
    z[0, 3], z[0, 6] = speed, 0.02 * speed
    lam[0, 0::4], lam[0, 2::4] = 0.7, -0.7 / 0.3
    assert (lam @ qp.G).abs().max() > 0
    _, residual, error = certified(p, z, lam, chi, chi[:, :0])
    assert residual[0] <= 1e-6
    assert (error[0] <= 1e-6) == right


# Solutions rejected by the certificate go to another solver


@pytest.mark.parametrize("liar", LIES, indirect=True)
def test_wrong_answers_are_caught_and_replaced(liar):
    known = known_qp(0, batch=(BATCH,))
    with qm.SolveLog() as log:
        solution = solve(known, solver=liar)
    assert_right(solution, known)
    assert (log.solves, log.unsolved) == (BATCH, 0)
    assert log.fallback >= BATCH - 1  # the one whose solution stands for all is right


@pytest.mark.parametrize("count", [BATCH, 2 * BATCH])
@pytest.mark.parametrize("name", INACCURACIES)
def test_inaccurate_answers_are_sharpened_or_of_many_solved_again(monkeypatch, name, count):
    monkeypatch.setitem(BACKENDS, "coarse", doctored(INACCURACIES[name]))
    known = known_qp(0, batch=(count,), matrices=(count,))
    with qm.SolveLog() as log:
        solution = solve(known, solver="coarse")
    assert_right(solution, known)
    assert (log.refined, log.fallback) == ((count, 0) if count <= FEW else (0, count))
    assert solution.residual.max() < 1e-9


def test_only_rejected_solutions_are_solved_again(monkeypatch):
    wrong = np.array([False, True, False, False, True, True])

    def lie(answer: BackendSolution) -> BackendSolution:
        return answer._replace(v=answer.v + wrong[:, None])

    monkeypatch.setitem(BACKENDS, "liar", doctored(lie))
    known = known_qp(1, batch=(BATCH,), matrices=(BATCH,))
    with qm.SolveLog() as log:
        solution = solve(known, solver="liar")
    assert_right(solution, known)
    assert log.fallback == 3


def one_by_one(known: KnownQP, rest: AtRest) -> list[BatchSolution]:
    return [rest.solve(s[None]) for s in known.fixed.numpy()]


def at_rest(known: KnownQP, solver: str = "daqp", **changes) -> AtRest:
    n_f = known.fixed.shape[-1]
    return AtRest(replace(known.qp, **changes), n_f, n_f, solver)


def shared(seed: int, **options) -> KnownQP:
    """Return known QPs that differ in their fixed entries alone, though not in their solution's."""
    one = known_qp(seed, batch=(), **options)
    steps = torch.linspace(-0.6, 0.6, 20, dtype=torch.float64)[:, None]
    return replace(one, fixed=one.fixed + steps * normal(one.fixed.shape[-1], seed=seed))


@pytest.mark.parametrize("units", [1.0, 2.0**20])
@pytest.mark.parametrize("seed", range(8))
def test_qps_at_rest_have_the_solutions_of_a_batch(seed, units):
    """From its own active set, a batch's solution is exact."""
    known = shared(seed)
    qp = replace(known.qp, **{x: units * getattr(known.qp, x) for x in ("H", "q", "w")})
    known = replace(known, qp=qp)
    batch = solve(known, solver="daqp", on_failure="mask")
    batch = solve(known, solver="daqp", on_failure="mask", warm_start=batch)
    with qm.SolveLog() as log:
        rest = at_rest(known)
        answers = one_by_one(known, rest)
    assert (rest.prepared.units is None) == (units == 1)
    assert batch.solved.any()
    assert batch.active[batch.solved].any()
    for k, answer in enumerate(answers):
        assert answer.status[0] == batch.status[k]
        if not answer.status[0]:
            for name in ("value", "z", "lam", "chi", "xi"):
                one, other = getattr(answer, name)[0], getattr(batch, name)[k].numpy()
                assert np.abs(one - other).max() <= 1e-9 * (1 + np.abs(other).max())
    assert (log.solves, log.unsolved) == (20, int((~batch.solved).sum()))
    assert log.recalled > 0
    rest = at_rest(known)
    for _ in range(2):  # from empty sets, and from the last ones
        together = rest.solve(known.fixed.numpy())
        assert together.status.tolist() == batch.status.tolist()
        value = batch.value.numpy()[together.status == 0]
        assert np.allclose(together.value[together.status == 0], value, rtol=1e-9, atol=1e-9)


def test_a_cost_that_is_not_convex_has_no_solution_at_rest():
    known = shared(2)
    rest = at_rest(known, H=-known.qp.H, check_values=False)
    assert {x.status[0] for x in one_by_one(known, rest)} == {qm.Status.INVALID_DATA}
    nan = np.full((1, known.fixed.shape[-1]), np.nan)
    assert at_rest(known).solve(nan).status[0] == qm.Status.INVALID_DATA


def test_a_solver_does_not_get_its_failures_again(monkeypatch, asked):
    recorder = BACKENDS["recorder"]
    monkeypatch.setitem(BACKENDS, "liar", lambda qps: LIES["v off"](recorder(qps)))
    known = known_qp(3, batch=(BATCH,))
    with qm.SolveLog() as log:
        assert_right(solve(known, solver="liar"), known)
    assert counts(asked) == [BATCH]
    assert (log.fallback, log.recalled) == (BATCH, 0)


@pytest.mark.parametrize("ones", [[], [0], [0, 2, 5], [*range(6)]], ids=str)
def test_active_sets_right_or_unknown_avoid_the_backend(asked, ones):
    """Rows without bounds are left out; they differ between elements."""
    known = known_qp(3, batch=(BATCH,))
    active = solve(known, solver="torch").active
    unknown = torch.full_like(active, UNKNOWN)
    unknown[ones] = active[ones]
    with qm.SolveLog() as log:
        assert_right(solve(known, solver="recorder", warm_start=unknown), known)
    assert counts(asked) == []
    assert (log.fallback, log.recalled) == (0, BATCH)


def test_the_active_set_of_an_unsolved_qp_is_unknown():
    known = spoil(known_qp(3, batch=(BATCH,)), 4)
    active = solve(known, solver="daqp", on_failure="mask").active
    assert (active[4] == UNKNOWN).all()
    assert (active[:4].abs() <= 2).all()
    assert solve(known_qp(3, batch=(BATCH,)), warm_start=active).solved.all()


@pytest.fixture
def nobody_solves(monkeypatch: pytest.MonkeyPatch) -> None:
    nothing = doctored(LIES["zeros"])
    for name in list(BACKENDS):
        monkeypatch.setitem(BACKENDS, name, nothing)
    monkeypatch.setattr(interior_point, "solve", lambda qps, **_: nothing(qps))
    monkeypatch.setattr(refinement, "MAX_SETS", 0)
    lost = lambda self, active: self.unsolved(qm.Status.NOT_CONVERGED)  # noqa: E731
    monkeypatch.setattr(Programs, "recalled", lost)


@pytest.mark.usefixtures("nobody_solves")
def test_unsolved_qps_are_not_converged(recwarn):
    known = known_qp(4, batch=(2, 3))
    message = (
        r"6 of 6 QPs have no certified solution. 6 NOT_CONVERGED, first at batch index \(0, 0\): "
        r"no solver reached the certificate's tolerance, and the QP is neither"
    )
    with qm.SolveLog() as log:
        solution = solve(known, on_failure="mask")
    assert not recwarn
    assert (solution.status == qm.Status.NOT_CONVERGED).all()
    assert (solution.value == torch.inf).all()
    assert (solution.residual > 1e-6).all()
    assert (log.solves, log.unsolved) == (6, 6)
    with pytest.raises(qm.SolverError, match=message):
        solve(known)
    with pytest.warns(RuntimeWarning, match=message):
        solve(known, on_failure="warn")


# The log


def spoil(known: KnownQP, index: int) -> KnownQP:
    q = known.qp.q.clone()
    q[index] = torch.nan
    return replace(known, qp=replace(known.qp, q=q, check_values=False))


def test_the_log_adds_up_all_solves_of_its_block():
    known = known_qp(5, batch=(BATCH,))
    with qm.SolveLog() as log:
        first = solve(known)
        second = solve(spoil(known, 1), on_failure="mask")
    solve(known)
    assert log.solves == 2 * BATCH
    assert log.unsolved == 1
    assert log.fallback == 0
    assert log.iterations == int(first.iterations.sum() + second.iterations.sum())
    assert log.residual == max(first.residual.max(), second.residual[second.solved].max())
    assert log.seconds > 0


def test_the_log_reports_the_metrics_of_training():
    counts = {"solves": 4, "unsolved": 1, "fallback": 2, "recalled": 3, "residual": 1e-8}
    log = qm.SolveLog(**counts, iterations=10, seconds=0.5)
    expected = {f"qp/{name}": x for name, x in counts.items()}
    assert log.metrics() == expected | {"qp/iterations": 2.5, "time/qp": 0.5}
    assert qm.SolveLog().metrics()["qp/iterations"] == 0


def test_an_inner_log_takes_over_for_its_block_and_ends_even_by_an_error():
    known = known_qp(5, batch=(BATCH,))
    with qm.SolveLog() as outer:
        solve(known)
        with pytest.raises(qm.QPError, match="solver"), qm.SolveLog() as inner:
            _ = [solve(known, solver=solver) for solver in ("daqp", "none")]
        solve(known)
    assert (outer.solves, inner.solves) == (2 * BATCH, BATCH)


def test_the_log_counts_its_own_thread_only():
    known = known_qp(5, batch=(BATCH,))

    def logged() -> int:
        with qm.SolveLog() as log:
            solve(known)
        return log.solves

    with qm.SolveLog() as log, ThreadPoolExecutor(2) as pool:
        counts = list(pool.map(lambda _: logged(), range(4)))
    assert counts == [BATCH] * 4
    assert log.solves == 0


# QPs that never reach a backend


def test_rows_without_a_bound_or_a_free_variable_are_left_out(asked):
    known = known_qp(6, soft=("free", "inside", "above"), hard=("at_upper",))
    assert_right(solve(known, solver="recorder"), known)
    assert [qps.l.shape for qps in asked] == [(1, 3)]


def test_invalid_elements_reach_no_backend(asked):
    known = spoil(known_qp(7, batch=(BATCH,)), 2)
    solution = solve(known, solver="recorder", on_failure="mask")
    assert counts(asked) == [BATCH - 1]
    assert np.isfinite(asked[0].g).all()
    assert solution.status.tolist() == [0, 0, qm.Status.INVALID_DATA, 0, 0, 0]
    asked.clear()
    known = spoil(known_qp(8, batch=(1,)), 0)
    alone = solve(known, solver="recorder", on_failure="mask")
    assert alone.status.tolist() == [qm.Status.INVALID_DATA]
    assert solve(known_qp(8, batch=(0,)), solver="recorder").status.shape == (0,)
    assert asked == []


def test_an_indefinite_hessian_is_not_certified(solver):
    """A stationary point of a concave cost satisfies all first-order conditions."""
    known = known_qp(0)
    H = known.qp.H - 1e3 * torch.eye(known.qp.n_z).double()
    indefinite = qm.QuadraticProgram(H, *known.qp.tensors()[1:], check_values=False)
    found = qm.solve_qp(indefinite, known.fixed, solver=solver, on_failure="mask")
    assert found.status == qm.Status.INVALID_DATA
    with pytest.raises(ValueError, match="not positive semidefinite"):
        qm.solve_qp(indefinite, known.fixed, solver=solver)


@pytest.mark.parametrize("solver", ["proxqp", "daqp"])
def test_a_row_that_the_fixed_entries_decide_but_for_rounding_is_no_row(solver):
    """In Q with a banded C, x_0 and u_0 determine x_1 up to rounding.

    The multiplier of such a row belongs to no free variable, so no solver can determine it.
    """
    physics = PointMass()
    A, B, theta = physics.corrupted(1)
    mpc = qm.QPMPC.from_model(
        A,
        B,
        10,
        stage_weight=torch.cat((theta, torch.zeros(2))),
        state_bounds=(physics.lb_s, physics.ub_s),
        action_bounds=(physics.lb_a, physics.ub_a),
        solver=solver,
    )
    s = torch.tensor([[-2.0, 0.42, -0.7, 0.23], [2.0, 0.06, 0.63, -0.42]]).double()
    a = torch.tensor([[-0.23, -1.0], [0.82, -0.36]]).double()
    solution = mpc.solve(s, a)
    x_1 = slice(mpc.n_x + mpc.n_u, mpc.n_x + mpc.n_u + 1)
    assert (solution.sigma[:, x_1] > 0).all()
    assert_close((solution.upsilon + solution.eta)[:, x_1], torch.full((2, 1), 100.0).double())
    assert solution.residual.max() < 1e-8
    assert solution.iterations.max() < 100


def files_called(call: Callable[[], Any]) -> list[str]:
    """Return the package's files that a call passes through, in its order."""
    files: list[str] = []

    def note(frame: FrameType, event: str, _: Any) -> None:
        if event == "call" and frame.f_code.co_filename.startswith(ROOT):
            files.append(frame.f_code.co_filename)

    call()  # so that nothing is left to compile or prepare
    before = sys.getprofile()
    sys.setprofile(note)
    try:
        call()
    finally:
        sys.setprofile(before)
    return [file for file, _ in itertools.groupby(files)]


def test_a_value_and_a_step_change_files_seldom():
    """A reader of the call changes page as often."""
    A, B = [[1.0, 0.1], [0.0, 0.9]], [[0.0], [0.1]]
    bounds: Any = {"state_bounds": ([-1.0, -1.0], [1.0, 1.0]), "action_bounds": ([-1.0], [1.0])}
    mpc = qm.QPMPC.from_model(A, B, 10, stage_weight=[1.0, 0.1, 0.01], solver="daqp", **bounds)
    files = files_called(lambda: mpc.value(torch.tensor([[0.3, -0.2]]).double()))
    assert len(files) <= 26
    assert len(files) - len(set(files)) <= 14
    assert len(set(files)) <= 12
    linear = qm.LinearMPC((A, B, [[1.0, 0.0]]), 10, Q=[1.0], dR=[0.1], u_bounds=(-1.0, 1.0))
    controller = qm.Controller(linear)
    assert len(files_called(lambda: controller.step([0.1], [0.5]))) <= 30
