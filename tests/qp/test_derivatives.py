import itertools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.func import hessian, jacfwd, jacrev, vmap
from torch.testing import assert_close

from tests.covering import covering
from tests.problems import KnownQP, central_difference, known_qp, normal, random_mpc, random_states
from torch_qpmpc import QPMPC, QuadraticProgram, solve_qp
from torch_qpmpc.qp import kkt
from torch_qpmpc.qp.program import EVENT_SHAPES

OPERANDS = (*EVENT_SHAPES, "fixed")
PARTS = ("value", "z", "sigma", "chi", "upsilon", "eta", "xi")
SOLVERS = pytest.mark.parametrize("solver", ["proxqp", "daqp", "torch"])
KINDS = ("inside", "at_lower", "at_upper", "below", "above", "no_upper", "free")


def part_of(operands: list[Tensor], part: str) -> Tensor:
    qp = QuadraticProgram(*operands[:-1], check_values=False)
    return getattr(solve_qp(qp, operands[-1], solver="daqp"), part)


def operands_of(known: KnownQP) -> list[Tensor]:
    return [tensor.clone() for tensor in (*known.qp.tensors(), known.fixed)]


def assert_agrees_with_differences(operands: list[Tensor], name: str, part: str) -> None:
    index = OPERANDS.index(name)
    start = operands[index]
    direction = normal(*start.shape, seed=index)
    if name == "H":
        direction = direction + direction.mT
    weight = normal(*part_of(operands, part).shape, seed=3)

    def scalar(moved: Tensor) -> Tensor:
        return (part_of([*operands[:index], moved, *operands[index + 1 :]], part) * weight).sum()

    leaf = start.clone().requires_grad_()
    central = central_difference(lambda: scalar(leaf), leaf, direction, 1e-6)
    (gradient,) = torch.autograd.grad(scalar(leaf), leaf, allow_unused=True)
    gradient = torch.zeros_like(leaf) if gradient is None else gradient
    finite = torch.where(gradient.isfinite(), gradient, 0)
    assert_close((finite * direction).sum(), central, rtol=1e-5, atol=2e-5)


@pytest.mark.parametrize("name", OPERANDS)
@pytest.mark.parametrize("part", PARTS)
def test_every_part_in_every_operand_agrees_with_finite_differences(part, name, monkeypatch):
    monkeypatch.setattr(kkt, "_solve_dense", None)  # no rows are dependent
    known = known_qp(1, batch=(3,), soft=KINDS, hard=("inside", "at_lower", "at_upper"))
    assert_agrees_with_differences(operands_of(known), name, part)


@pytest.mark.parametrize("matrices", [(), (3,), (2, 1)])
def test_shared_and_separate_matrices(matrices):
    batch = (2, 3) if matrices == (2, 1) else (3,)
    known = known_qp(2, batch=batch, matrices=matrices, soft=KINDS, hard=("inside", "at_upper"))
    for name in ("H", "C", "G", "b"):
        assert_agrees_with_differences(operands_of(known), name, "z")


def test_policy_gradient_in_the_state_on_and_off_the_bounds():
    mpc, s = random_mpc(0), random_states(16, size=3.0)
    action, bound = mpc.policy(s), mpc.ub[mpc.n_x]
    assert torch.autograd.gradcheck(mpc.policy, (s.clone().requires_grad_(),), eps=1e-6, atol=1e-5)
    pinned = action.abs() > bound - 1e-9
    slope = vmap(jacrev(mpc.policy))(s).abs().sum(-1)
    assert pinned.any()
    assert (~pinned).any()
    assert slope[pinned].max() < 1e-9
    assert slope[~pinned].min() > 1e-6


UNSTABLE = (3.0, 1.0, 15), (10.0, 1.0, 10), (3.65, 10.0, 15)


@pytest.mark.parametrize(
    ("plant", "bound", "solver"),
    covering(itertools.product(UNSTABLE, (None, 1.0), ("proxqp", "daqp", "torch"))),
)
def test_an_action_at_its_bound_has_no_slope_however_unstable_the_model(plant, bound, solver):
    """The multipliers differ by factors of 1e6 to 1e18; soft states reach theirs of 100."""
    a, b, N = plant
    options: dict[str, Any] = {"state_bounds": ([-bound], [bound])} if bound else {}
    options |= {"stage_weight": [1.0, 0.1], "action_bounds": ([-1.0], [1.0]), "gamma": 1.0}
    mpc = QPMPC.from_model([[a]], [[b]], N, solver=solver, **options)
    s = vector(2.0 * b / (a - 1))
    plan = mpc.solve(s).z.detach()[1::2]
    assert_close(plan, -torch.ones(N).double(), rtol=0, atol=0.02)
    slope = torch.autograd.functional.jacobian(lambda s: mpc.solve(s).z[1::2], s)
    assert_close(slope, torch.zeros(N, 1).double(), rtol=0, atol=1e-9)


@SOLVERS
def test_soft_rows_whose_multipliers_are_rounding_beside_others_are_not_held(solver):
    A = [[-8.46, 0.36, -2.15], [-3.67, 2.0, 1.03], [-0.18, -2.12, -3.71]]
    B, weights = [[-1.34], [-0.25], [-0.13]], [0.305, 0.113, 0.382, 7.14]
    bounds: Any = {"state_bounds": ([-1.0] * 3, [2.0] * 3), "action_bounds": ([-1.0], [1.0])}
    bounds |= {"terminal_weight": [21.4, 1.05, 0.169], "gamma": 1.0, "solver": solver}
    mpc = QPMPC.from_model(A, B, 11, stage_weight=weights, **bounds)
    s = vector(-1.526, -0.342, 0.357)
    slope: Any = torch.autograd.functional.jacobian(lambda s: mpc.solve(s).z, s)
    assert slope.isfinite().all()
    assert (slope[3].abs() < 1e-9).all()  # u_0 is at its bound


@SOLVERS
@pytest.mark.parametrize("b", [1.0, 10.0])
def test_an_unstable_plan_has_the_slope_of_its_free_actions(b, solver):
    """The first actions are at their bound, and the policy is affine in s nearby."""
    options: dict[str, Any] = {"action_bounds": ([-1.0], [1.0]), "gamma": 1.0, "solver": solver}
    mpc = QPMPC.from_model([[2.0]], [[b]], 20, stage_weight=[1.0, 0.1], **options)
    s, step = vector(0.99 * b), 1e-4
    slope: Any = torch.autograd.functional.jacobian(lambda s: mpc.solve(s).z[1::2], s)
    ends = [mpc.solve(s + sign * step).z[1::2].detach() for sign in (1, -1)]
    assert_close(slope[:, 0], (ends[0] - ends[1]) / (2 * step), rtol=1e-6, atol=1e-6)


def test_a_fully_fixed_z_moves_with_the_fixed_entries():
    one = torch.ones(1).double()
    qp = QuadraticProgram(one.diag(), one, lb=-2 * one, ub=2 * one)
    fixed = normal(3, 1).clamp(-1, 1).requires_grad_()
    (slope,) = torch.autograd.grad(solve_qp(qp, fixed).z.sum(), fixed)
    assert_close(slope, torch.ones_like(fixed))


@pytest.mark.parametrize("name", [name for name in OPERANDS if name != "c"])
def test_second_derivative_of_the_value_in_every_operand(name):
    known = known_qp(7, soft=KINDS, hard=("inside", "at_upper"))
    operands, index = operands_of(known), OPERANDS.index(name)
    direction = normal(*operands[index].shape, seed=index)
    if name == "H":
        direction = direction + direction.mT

    def slope(x: Tensor) -> Tensor:
        value = part_of([*operands[:index], x, *operands[index + 1 :]], "value")
        (gradient,) = torch.autograd.grad(value, x, create_graph=True)
        return (torch.where(gradient.isfinite(), gradient, 0) * direction).sum()

    leaf = operands[index].clone().requires_grad_()
    (second,) = torch.autograd.grad(slope(leaf), leaf)
    step = 1e-5
    ends = [slope((operands[index] + sign * step * direction).requires_grad_()) for sign in (1, -1)]
    central = (ends[0] - ends[1]) / (2 * step)
    finite = torch.where(second.isfinite(), second, 0)
    assert_close((finite * direction).sum(), central, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("length", [1e-8, 1.0, 1e8, 10.0 ** torch.arange(-12, 12, 2).double()])
@pytest.mark.parametrize("cost", [1e-12, 1e-8, 1.0, 1e8])
def test_gradients_of_all_parts_do_not_depend_on_the_units(cost, length):
    """With a cost of 1e-8 a multiplier is small, but not rounding: its row is active."""
    known = known_qp(7, soft=KINDS, hard=("inside", "at_upper"))

    def in_units(cost: float, length: Any, row: float, equality: float) -> list[Tensor]:
        leaves = [x.requires_grad_() for x in operands_of(known)]
        H, q, c, C, b, G, lb, ub, w, fixed = leaves
        z = torch.as_tensor(length, dtype=torch.float64).expand(12)
        qp = QuadraticProgram(
            H=H * cost / z.outer(z),
            q=q * cost / z,
            c=c * cost,
            C=C * equality / z,
            b=b * equality,
            G=G * row / z,
            lb=lb * row,
            ub=ub * row,
            w=w * cost / row,
        )
        found = solve_qp(qp, fixed * z[:2], solver="daqp")
        multipliers = found.lam * row, found.chi * equality, found.xi * z[:2]
        parts = found.z / z, *(x / cost for x in multipliers)
        weighted = [(normal(*x.shape, seed=i) * x).sum() for i, x in enumerate(parts)]
        gradients = torch.autograd.grad(torch.stack(weighted).sum(), leaves, materialize_grads=True)
        return [torch.where(x.isfinite(), x, 0) for x in gradients]

    ordinary = in_units(1.0, 1.0, 1.0, 1.0)
    assert ordinary[1].abs().max() > 0.1
    assert_close(in_units(cost, length, 1e-3, 1e4), ordinary, rtol=1e-7, atol=1e-7)


@SOLVERS
@pytest.mark.parametrize(("lower", "width"), [(1.0, 1e-7), (300.0, 1e-4), (1e7, 1.0), (-1e7, 1.0)])
def test_a_row_within_close_bounds_is_not_held(lower, width, solver):
    one, lb = vector(1.0), vector(lower)

    def z(s: Tensor) -> Tensor:
        qp = QuadraticProgram(one.diag(), -s, lb=lb, ub=lb + width, check_values=False)
        return solve_qp(qp, solver=solver).z

    for share, expected in ((0.5, 1.0), (1.5, 0.0)):
        slope = torch.autograd.functional.jacobian(z, lb + share * width)
        assert_close(slope, vector(expected)[None], rtol=0, atol=1e-9)


@pytest.mark.parametrize("unit", [1e-4, 1.0, 1e4])
def test_a_multiplier_is_as_large_as_the_cost_of_its_variable(unit):
    """Beside a variable that costs 1e8 times as much; it is 5e-9, and its bound is active."""
    one = torch.ones(2, dtype=torch.float64)

    def z(ub: Tensor) -> Tensor:
        H, q = vector(1.0, 1e-8), vector(-3.0, -1.5e-8)
        return solve_qp(QuadraticProgram((unit * H).diag(), unit * q, ub=ub), solver="daqp").z

    assert_close(torch.autograd.functional.jacobian(z, one), one.diag(), rtol=0, atol=1e-9)


# Structured points: bounds that coincide, opposite rows, corners

INF = torch.inf
#: An optimum without rows, for zero multipliers of rows through it.
CENTRE = torch.tensor([0.4, -0.3, 0.2, 0.1, -0.5], dtype=torch.float64)
#: A QP as a function of a few parameters.
Family = Callable[[Tensor], tuple[QuadraticProgram, Tensor]]


def vector(*entries: float) -> Tensor:
    return torch.tensor(entries, dtype=torch.float64)


def family(
    rows: Tensor,
    lb: Sequence[float],
    ub: Sequence[float],
    w: Sequence[float],
    shift: Sequence[float] = (0.0,),
    moves: Tensor | None = None,
) -> Family:
    """Return QPs in z of 5, the first entry fixed, with C z = b and ``rows`` (z - CENTRE).

    Parameter 0 moves the bounds by ``moves`` (by default all by 1), parameter 1 the fixed entry, 2
    to 6 move q, and 7 b. ``shift`` is added to q, to put multipliers on the rows.
    """
    M, C, fixed = normal(5, 5), normal(1, 5, seed=1), CENTRE[:1]
    H = M @ M.mT + torch.eye(5, dtype=torch.float64)
    moves = torch.ones(len(rows), dtype=torch.float64) if moves is None else moves
    offset = rows @ CENTRE

    def program(p: Tensor) -> tuple[QuadraticProgram, Tensor]:
        q = -H @ CENTRE + vector(*shift).expand(5) + p[2:7]
        b, move = C @ CENTRE + p[7:], offset + moves * p[0]
        rest = rows, vector(*lb) + move, vector(*ub) + move, vector(*w)
        return QuadraticProgram(H, q, 0 * q[0], C, b, *rest, check_values=False), fixed + p[1:2]

    return program


def assert_derivatives_at_the_origin(program: Family, solver: str) -> None:
    """Compare all derivatives of z, and the second ones of the value, with differences."""

    def z(p: Tensor) -> Tensor:
        return solve_qp(*program(p), solver=solver).z

    def value(p: Tensor) -> Tensor:
        return solve_qp(*program(p), solver=solver).value

    origin, step = torch.zeros(8, dtype=torch.float64), 1e-3
    axes = step * torch.eye(8, dtype=torch.float64)
    expected = (vmap(z)(axes) - vmap(z)(-axes)).mT / (2 * step)
    eager = torch.autograd.functional.jacobian(z, origin)
    for slope in (eager, jacrev(z)(origin), jacfwd(z)(origin)):
        assert_close(slope, expected, rtol=0, atol=1e-4)
    slopes = vmap(jacrev(value))
    first = (slopes(axes) - slopes(-axes)).mT / (2 * step)
    eager = torch.autograd.functional.hessian(value, origin)
    for second in (eager, jacrev(jacrev(value))(origin), hessian(value)(origin)):
        assert_close(second, first, rtol=1e-5, atol=1e-4)


ROW = normal(1, 5, seed=2)


PAIR = torch.cat((ROW, normal(1, 5, seed=3)))
BESIDE = torch.cat((ROW, torch.eye(5, dtype=torch.float64)[2:]))


def equal(w: float, shift: float) -> Family:
    bounds = [0.0, -1.0, -1.0, -1.0], [0.0, 1.0, 1.0, 1.0]
    return family(BESIDE, *bounds, [w, INF, 5.0, INF], [shift])


def opposite(w: float, scale: float) -> Family:
    """Return a'z <= beta, scale a'z >= scale beta: an upper bound if the scale is negative."""
    lower, upper = ([-INF, 0.0], [0.0, INF]) if scale > 0 else ([-INF, -INF], [0.0, 0.0])
    rows, moves = torch.cat((ROW, scale * ROW)), vector(1.0, scale)
    return family(rows, lower, upper, [w, INF], moves=moves)


def pinched() -> Family:
    rows, moves = torch.cat((PAIR, vector(1.0, 2.0)[None] @ PAIR)), vector(1.0, 1.0, 3.0)
    return family(rows, [0.0, 0.0, -INF], [INF, INF, 0.0], [INF] * 3, moves=moves)


#: Rows that hold z, and one that does not, as it is beyond its price.
STRUCTURED = {
    **{f"equal, {w}, {shift}": equal(w, shift) for w in (INF, 50.0) for shift in (0.0, 1.0)},
    **{
        f"opposite, {w}, {scale}": opposite(w, scale)
        for w, scale in ((INF, 1.0), (50.0, -1.0), (50.0, 30.0), (INF, -1e-3))
    },
    "equal, beyond its price": family(ROW, [0.0], [0.0], [0.1], [3.0]),
    "equal but for rounding": family(ROW, [0.0], [1e-15], [INF]),
    "pinched": pinched(),
}


@SOLVERS
@pytest.mark.parametrize("name", STRUCTURED)
def test_rows_that_hold_z_together_are_equalities(name, solver):
    assert_derivatives_at_the_origin(STRUCTURED[name], solver)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_opposite_rows_are_recognised_in_all_units(dtype, unit):
    one = torch.ones(2, dtype=dtype)

    def z(t: Tensor) -> Tensor:
        # Exact in float32: rows that are opposite up to rounding alone have another solution.
        rows = torch.tensor([[0.375, 0.75], [-0.09375, -0.1875]], dtype=dtype)
        ub = torch.stack((t, -t / 4))
        qp = QuadraticProgram(one.diag(), 0 * one, G=rows, ub=ub, check_values=False)
        return solve_qp(qp, solver="daqp").z

    # At t = 0 the multipliers are zero. z is linear in t.
    slope = torch.autograd.functional.jacobian(z, torch.zeros((), dtype=dtype))
    assert_close(unit * slope, z(torch.tensor(unit, dtype=dtype)), rtol=1e-5, atol=0)


def test_equal_bounds_share_the_gradient_evenly_at_a_zero_multiplier():
    zero, eye = torch.zeros(1, dtype=torch.float64), torch.eye(1, dtype=torch.float64)

    def part(name: str) -> Callable[[Tensor, Tensor], Tensor]:
        return lambda lb, ub: getattr(
            solve_qp(QuadraticProgram(eye, zero, lb=lb, ub=ub, check_values=False)), name
        )

    for jacobian in (jacrev, jacfwd):
        assert [x.item() for x in jacobian(part("z"), argnums=(0, 1))(zero, zero)] == [0.5, 0.5]
    for outer in (jacrev, jacfwd):
        second = outer(jacrev(part("value"), argnums=(0, 1)), argnums=(0, 1))(zero, zero)
        assert [x.item() for row in second for x in row] == [0.25] * 4


def test_second_derivatives_do_not_reach_the_other_bound_of_a_row():
    """V with -1 <= z <= t, -z <= -t depends on t alone, and not on the lower bound."""
    eye, one = torch.eye(1, dtype=torch.float64), torch.ones(1, dtype=torch.float64)

    def value(lower: Tensor, t: Tensor) -> Tensor:
        lb, ub = torch.cat((lower, -INF * one)), torch.cat((t, -t))
        G = torch.cat((eye, -eye))
        qp = QuadraticProgram(eye, 0 * one, G=G, lb=lb, ub=ub, check_values=False)
        return solve_qp(qp, solver="daqp").value

    for second in (hessian, lambda f, argnums: jacrev(jacrev(f, argnums), argnums)):
        (of_lower, mixed), (_, of_t) = second(value, argnums=(0, 1))(-one, 0 * one)
        assert of_lower.item() == mixed.item() == 0
        assert of_t.item() == pytest.approx(1.0)


def test_structured_points_in_batches_and_under_vmap():
    """The rows meet in three of four elements."""
    gaps = vector(0.0, 0.5, 0.0, 1e-15)

    program = family(torch.cat((ROW, -ROW)), [-INF] * 2, [0.0] * 2, [INF] * 2)

    def z(p: Tensor, gap: Tensor) -> Tensor:
        qp, fixed = program(p)
        tensors = [*qp.tensors()[:7], qp.ub + torch.stack((0 * gap, gap)), qp.w]
        return solve_qp(QuadraticProgram(*tensors, check_values=False), fixed, solver="daqp").z

    points = torch.zeros(4, 8, dtype=torch.float64)
    together = vmap(jacrev(z))(points, gaps)
    alone = torch.stack([jacrev(z)(p, gap) for p, gap in zip(points, gaps, strict=True)])
    assert_close(together, alone)
    assert_close(together[0], together[3])
    assert (together[0] - together[1]).abs().max() > 0.1


def test_a_row_on_fixed_entries_alone_has_no_part_in_the_derivatives(monkeypatch):
    monkeypatch.setattr(torch.linalg, "pinv", None)  # of a singular KKT system
    rows, slopes = torch.eye(5, dtype=torch.float64)[[0, 2]], []
    for width in (0.0, 1.0):
        bounds = [-width, -1.0], [width, 1.0]
        program = family(rows, *bounds, [5.0, INF], moves=torch.zeros(2, dtype=torch.float64))
        origin = torch.zeros(8, dtype=torch.float64)
        slopes.append(jacrev(lambda p, f=program: solve_qp(*f(p), solver="daqp").z)(origin))
    assert_close(*slopes)


@SOLVERS
def test_at_a_corner_the_derivative_is_one_sided(solver):
    """z at two of its bounds, with zero multipliers: as if these were absent."""
    eye = torch.eye(5, dtype=torch.float64)[1:3]
    program, origin = family(eye, [-1.0, -1.0], [0.0, 0.0], [INF, 5.0]), torch.zeros(8).double()

    def z(p: Tensor) -> Tensor:
        return solve_qp(*program(p), solver=solver).z

    slope, inwards = jacrev(z)(origin), torch.zeros_like(origin)
    inwards[2:7] = eye[0] + eye[1]
    assert (slope @ inwards)[1:3].max() < -1e-3
    step = 1e-3 * inwards
    assert_close(slope @ step, z(step) - z(origin), rtol=0, atol=1e-8)


def test_a_slack_has_no_slope_where_its_row_is_about_to_be_held():
    one = torch.ones(1, dtype=torch.float64)

    def sigma(s: Tensor) -> Tensor:
        qp = QuadraticProgram(one.diag(), -s, lb=-one, ub=one, w=5 * one, check_values=False)
        return solve_qp(qp, solver="daqp").sigma

    assert jacrev(sigma)(one).item() == 0
    assert sigma(1.01 * one).item() == sigma(0.99 * one).item() == 0


@SOLVERS
def test_more_active_rows_than_variables_give_a_consistent_derivative(solver):
    """z_1 <= 1, z_2 <= 1 and z_1 + z_2 <= 2, moved together, take z with them."""
    one = torch.ones(3, dtype=torch.float64)
    rows = torch.tensor([[1.0, 0.0], [0.0, 1.0], [1.0, 1.0]], dtype=torch.float64)

    def z(ub: Tensor) -> Tensor:
        qp = QuadraticProgram(one[:2].diag(), -5 * one[:2], G=rows, lb=-9 * one, ub=ub)
        return solve_qp(qp, solver=solver).z

    slope = torch.autograd.functional.jacobian(z, vector(1.0, 1.0, 2.0))
    assert_close(slope @ vector(1.0, 1.0, 2.0), vector(1.0, 1.0))
    assert_close(slope @ vector(1.0, -1.0, 0.0), vector(1.0, -1.0))


@pytest.mark.parametrize("size", [1e-15, 1.0, 1e15])
def test_gradients_are_linear_in_what_comes_in(size, monkeypatch):
    """All variables are at a bound, so that only rounding errors are left of p."""
    monkeypatch.setattr(kkt, "_solve_dense", None)
    one = torch.ones(2, dtype=torch.float64)
    H, ub = vector(2.0, 0.3, 0.3, 1.0).reshape(2, 2), vector(1.0, 0.5).requires_grad_()
    z = solve_qp(QuadraticProgram(H, -5 * one, lb=-one, ub=ub), solver="daqp").z
    (gradient,) = torch.autograd.grad(size * (z * vector(0.7, -0.2)).sum(), ub)
    assert_close(gradient / size, vector(0.7, -0.2), rtol=1e-12, atol=0)


def test_opposite_rows_are_not_sought_without_weakly_active_ones(monkeypatch):
    monkeypatch.setattr(kkt, "implied_equalities", None)
    mpc, s = random_mpc(0), random_states(16, size=3.0).requires_grad_()
    mpc.policy(s).sum().backward()
    assert s.grad is not None


def test_a_search_for_implied_equalities_that_does_not_end_finds_none(monkeypatch):
    def endless(*_: object) -> None:
        raise RuntimeError("Maximum number of iterations reached.")

    monkeypatch.setattr("scipy.optimize.nnls", endless)
    opposite = np.array([[1.0, 0.0], [-1.0, 0.0]])
    masks = np.array([False, False]), np.array([True, True]), np.array([False, False])
    assert not kkt.implied_equalities(opposite, *masks).any()
