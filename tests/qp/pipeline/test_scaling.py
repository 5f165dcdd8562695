import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from tests.campaign.families import in_units
from tests.covering import covering
from tests.problems import KnownQP, known_qp, programs_of
from torch_qpmpc import QPMPC, QuadraticProgram, SolveLog, Status, solve_qp
from torch_qpmpc.qp.pipeline.batch import Programs
from torch_qpmpc.qp.pipeline.scaling import lengths
from torch_qpmpc.qp.program import TOLERANCE
from torch_qpmpc.qp.solution import QPSolution
from torch_qpmpc.qp.solvers import BACKENDS

BATCH = 4


def in_size(known: KnownQP, **sizes: float) -> KnownQP:
    parts = {"cost": 1.0, "variables": 1.0, "rows": 1.0, "equalities": 1.0} | sizes
    return in_units(known, **{name: torch.tensor(x).double() for name, x in parts.items()})


@pytest.mark.parametrize("size", [1e-8, 1e8])
@pytest.mark.parametrize("unit", ["cost", "variables", "rows", "equalities"])
def test_a_qp_of_any_size_is_solved_without_help(solver, unit, size):
    known = in_size(known_qp(0, batch=(BATCH,)), **{unit: size})
    with SolveLog() as log:
        solution = solve_qp(known.qp, known.fixed, solver=solver)
    assert log.fallback == 0
    for name in ("value", "z", "lam", "chi", "xi", "sigma"):
        expected = getattr(known, name)
        tolerance = 1e-4 * float(expected.abs().max())
        assert_close(getattr(solution, name), expected, rtol=0, atol=tolerance)


@pytest.mark.parametrize("matrices", [(), (BATCH,)])
def test_units_are_powers_of_two_and_make_sizes_ordinary(matrices):
    known = known_qp(0, batch=(BATCH,), matrices=matrices)
    assert programs_of(known).prepared.units is None
    prepared = programs_of(in_size(known, cost=1e-9, variables=1e5)).prepared
    assert all((np.frexp(unit)[0] == 0.5).all() for unit in prepared.units[:4])
    assert prepared.scaled.units is None


def test_far_bounds_of_some_qps_are_no_length_for_the_others(solver):
    """Each row has a far bound in some QP of the batch: those once set the length of all."""
    known = known_qp(0, batch=(24,))
    known = in_size(known, variables=1e-8)
    qp, (count, n_g) = known.qp, known.lam.shape
    far = (torch.arange(n_g) + torch.arange(count)[:, None]) % 3 == 0
    far &= (known.lam == 0) & (known.sigma == 0)
    qp = replace(qp, lb=qp.lb.masked_fill(far, -1e10), ub=qp.ub.masked_fill(far, 1e10))
    solution = solve_qp(qp, known.fixed, solver=solver)
    size = 1e-6 * float(known.value.abs().max())
    assert_close(solution.value, known.value, rtol=1e-6, atol=size)
    assert_close(solution.z, known.z, rtol=0, atol=1e-12)
    units = programs_of(replace(known, qp=qp)).prepared.units
    assert units.length.max() < 1e-6


def test_what_rounding_leaves_of_a_zero_sets_no_unit():
    """b of an identified model had 1e-14 in most rows, and z came in units of that."""
    offset, weight = [5.0, 1e-14, 1e-14, 1e-14], [0.0, 0.0, 0.0, 0.0, 10.0]
    options = {"offset": offset, "stage_weight": weight, "action_bounds": ([-1.0], [1.0])}
    mpc = QPMPC.from_model(0.9 * np.eye(4), [[1.0], [0.0], [0.0], [0.0]], 10, **options)
    s = torch.tensor([[100.0, 1.0, 1.0, 1.0]]).double()
    assert Programs.of(*mpc.quadratic_program().tensors(), s)[0].prepared.units is None
    assert mpc.policy(s).abs() < 1e-8


@pytest.mark.parametrize("seed", range(3))
def test_entries_that_all_but_vanish_set_no_unit(solver, seed):
    """Mean logarithms made much of what exponentials in costs and models leave."""
    A, B = [[1.0, 0.1, 0.0], [0.0, 0.9, 0.3], [0.0, 0.0, 0.8]], [[0.0], [0.1], [0.5]]
    options = {"stage_weight": [1.0, 0.0, 0.0, 0.0], "action_bounds": ([-1.0], [1.0])}
    mpc, s = QPMPC.from_model(A, B, 20, **options), torch.tensor([[3.0, -1.0, 0.5]]).double()
    plain, generator = mpc.quadratic_program(), torch.Generator().manual_seed(seed)
    of_H, of_C = (
        10 ** (-20 - 180 * torch.rand(x.shape, generator=generator).double())
        for x in (plain.q, plain.C)
    )
    of_C *= torch.rand(of_C.shape, generator=generator) < 0.05
    noisy = replace(plain, H=plain.H + of_H.diag(), C=plain.C + of_C)
    solution = solve_qp(noisy, s, solver=solver)
    assert_close(solution.value, solve_qp(plain, s, solver=solver).value, rtol=1e-6, atol=0)
    units = Programs.of(*noisy.tensors(), s)[0].prepared.units
    assert units.length.max() < 1000 * units.length.min()


@pytest.mark.parametrize("unit", [1e-4, 1e4])
def test_units_of_inputs_reach_through_dead_times(unit):
    """Few passes left inputs of 1e6 a millionth of their unit, and plans on levels not the best."""
    A, B = np.eye(5, k=1) + np.diag([0.9, 0.0, 0.0, 0.0, 0.0]), np.eye(5, 1, -4)
    mpc = QPMPC.from_model(A, B, 8, stage_weight=[1.0, 0.0, 0.0, 0.0, 0.0, 0.1])
    H, _, _, C = (x.detach().numpy()[None] for x in mpc.quadratic_program().tensors()[:4])
    size = np.where(np.arange(C.shape[-1]) % 6, unit, 1.0)
    moved = lengths(H / np.outer(size, size), C / size) / size / lengths(H, C)
    assert moved.max() <= 4 * moved.min()


def test_a_hard_bound_holds_where_states_are_large_and_actions_small(solver):
    options = {"stage_weight": [1.0, 1.0, 0.1], "state_bounds": ([-1e4] * 2, [1e4] * 2)}
    options |= {"action_bounds": ([-0.01], [0.01]), "solver": solver}
    mpc = QPMPC.from_model([[1.0, 0.1], [0.0, 0.9]], [[0.0], [1e5]], 10, **options)
    s = torch.tensor([1e4, -1e3]).double()
    assert mpc.policy(s).abs() <= 0.01 * (1 + 1e-6)
    assert_close(mpc.value(s), torch.tensor(3.04986581e8).double(), rtol=1e-6, atol=0)


def test_retries_exclude_the_matrices_of_invalid_qps(solver):
    """One of three QPs with too large units has NaN in its matrices."""
    options = {"stage_weight": [1.0, 0.1, 0.01], "action_bounds": ([-1.0], [1.0])}
    options["terminal_weight"] = [1.0, 1.0]
    A, B, far = [[1.0, 0.1], [0.0, 0.9]], [[0.0], [0.1]], ([-1e6] * 2, [1e6] * 2)
    qp = QPMPC.from_model(A, B, 10, state_bounds=far, **options).quadratic_program()
    H = qp.H.detach().expand(3, -1, -1).clone()
    H[1, 0, 0] = torch.nan
    s = torch.tensor([[1.0, -0.5], [0.0, 0.0], [0.1, 0.2]]).double()
    three = replace(qp, H=H, check_values=False)
    solution = solve_qp(three, s, solver=solver, on_failure="mask")
    assert solution.status.tolist() == [0, Status.INVALID_DATA, 0]
    assert_close(solution.value[[0, 2]], torch.tensor([2.28345503, 0.05404678]).double())


# Bounds that cannot act, rows in lengths of their own, and rows that oppose each other

SIZES = [(12, 30, 2), (7, 9, 0), (15, 40, 4)]


def one_sided(seed: int, low: float, opposed: float | None = None, factor: Any = 1.0) -> dict:
    """Draw upper bounds of rows that a point meets; the second row opposes the first by a gap."""
    n, m, n_c = SIZES[seed % len(SIZES)]
    rng = np.random.default_rng(100 + seed)
    L, q, z = rng.normal(size=(n, n)), 2 * rng.normal(size=n), rng.normal(size=n)
    C, G = rng.normal(size=(n_c, n)), rng.normal(size=(m, n))
    ub = G @ z + rng.uniform(0.1, 2, m)
    if opposed is not None:
        G[1], ub[1] = -G[0], -ub[0] - opposed
    factor = np.broadcast_to(factor, m)
    H = L @ L.T / n + 1e-2 * np.eye(n)
    data = H, q, 0.0, C, C @ z, factor[:, None] * G, np.full(m, low), factor * ub
    return dict(
        zip(["H", "q", "c", "C", "b", "G", "lb", "ub"], map(torch.as_tensor, data), strict=True)
    )


def solved(solver: str, w: float = torch.inf, **data: Tensor) -> tuple[QPSolution, float]:
    """Solve with hard rows; return the largest violation, relative to the terms of its row."""
    parts: Any = {name: x.double() for name, x in data.items()}
    qp = QuadraticProgram(**parts, w=torch.full_like(parts["ub"], w))
    solution = solve_qp(qp, solver=solver, on_failure="mask")
    over = qp.G @ solution.z - qp.ub
    terms = qp.G.abs() @ solution.z.abs() + qp.ub.abs()
    return solution, float((over / terms).max())


@pytest.mark.parametrize("low", [-1e4, -1e7, -3e11, -1e16, -1e19, -1e25])
@pytest.mark.parametrize("seed", range(3))
def test_a_bound_that_cannot_act_costs_nothing(solver, seed, low):
    expected, _ = solved(solver, **one_sided(seed, -torch.inf))
    solution, violation = solved(solver, **one_sided(seed, low))
    assert solution.solved
    assert violation <= TOLERANCE
    assert_close(solution.z, expected.z, rtol=0, atol=1e-6)
    assert_close(solution.value, expected.value, rtol=1e-6, atol=0)


@pytest.mark.parametrize(
    ("solver", "low", "gap"),
    covering(
        itertools.product(
            (*BACKENDS, "qpsolvers:clarabel"), (-torch.inf, -1e6, -1e18), (-0.1, 1e-8, 1e-4, 0.3)
        )
    ),
)
def test_rows_that_oppose_each_other_have_one_verdict(solver, low, gap):
    for seed in range(3):
        solution, violation = solved(solver, **one_sided(seed, low, gap))
        assert solution.status == (Status.INFEASIBLE if gap > 1e-6 else Status.SOLVED)
        assert violation <= 1e-7 or gap > 1e-6


def test_rows_of_any_length_are_judged_by_their_own(solver):
    """Lengths from 1e-6 to 1e6 and bounds of -1e15 in one QP change neither status nor z."""
    for seed in range(3):
        factor = 10 ** np.random.default_rng(seed).uniform(-6, 6, SIZES[seed % 3][1])
        expected, _ = solved(solver, **one_sided(seed, -torch.inf))
        solution, violation = solved(solver, **one_sided(seed, -1e15, factor=factor))
        assert solution.solved
        assert violation <= TOLERANCE
        assert_close(solution.z, expected.z, rtol=0, atol=1e-5)


def test_a_small_bound_holds_beside_a_far_one(solver):
    """A row near 1e-5 is not violated by 1e-6, whatever its other side."""
    for far in (torch.inf, 1e9, 1e19):
        mpc = QPMPC.from_model(
            [[1.0, 0.1], [0.0, 0.9]],
            [[0.0], [0.1]],
            5,
            stage_weight=[1.0, 0.1, 0.01],
            action_bounds=([-1e-5], [far]),
            state_bounds=([-far] * 2, [far] * 2),
            solver=solver,
        )
        u = mpc.policy(torch.tensor([1.0, 0.0]).double())
        assert_close(u, torch.tensor([-1e-5]).double(), rtol=1e-6, atol=0)
