from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.func import jacrev, vmap
from torch.testing import assert_close

from tests.problems import KnownQP, known_qp, normal, random_mpc, random_states
from torch_qpmpc import QPError, QuadraticProgram, solve_qp
from torch_qpmpc.qp.program import EVENT_SHAPES
from torch_qpmpc.qp.solution import active_rows

OPERANDS = (*EVENT_SHAPES, "fixed")
PARTS = ("value", "z", "sigma", "chi", "upsilon", "eta", "xi")
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

    step = 1e-6
    central = (scalar(start + step * direction) - scalar(start - step * direction)) / (2 * step)
    leaf = start.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(scalar(leaf), leaf, allow_unused=True)
    gradient = torch.zeros_like(leaf) if gradient is None else gradient
    finite = torch.where(gradient.isfinite(), gradient, 0)
    assert_close((finite * direction).sum(), central, rtol=1e-5, atol=2e-5)


@pytest.mark.parametrize("name", OPERANDS)
@pytest.mark.parametrize("part", PARTS[1:])
def test_every_part_in_every_operand_agrees_with_finite_differences(part, name):
    known = known_qp(1, batch=(3,), soft=KINDS, hard=("inside", "at_lower", "at_upper"))
    assert_agrees_with_differences(operands_of(known), name, part)


@pytest.mark.parametrize("matrices", [(), (3,), (2, 1)])
def test_shared_and_separate_matrices(matrices):
    batch = (2, 3) if matrices == (2, 1) else (3,)
    known = known_qp(2, batch=batch, matrices=matrices, soft=KINDS, hard=("inside", "at_upper"))
    for name in ("H", "C", "G", "b"):
        assert_agrees_with_differences(operands_of(known), name, "z")


def test_saturated_rows_pass_on_their_weight():
    known = known_qp(3, soft=("below", "above", "inside"), hard=())
    operands = operands_of(known)
    leaf = operands[OPERANDS.index("w")].requires_grad_()
    (gradient,) = torch.autograd.grad(part_of(operands, "z").sum(), leaf)
    saturated = active_rows(known.lam, known.qp.w)[1]
    assert saturated.any()
    assert (gradient[saturated] != 0).all()
    assert (gradient[~saturated] == 0).all()


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


def test_at_a_kink_the_gradient_is_one_of_the_one_sided_derivatives():
    # min 1/2 (z - s)^2 over z <= 1 at s = 1: the bound is reached, with a zero multiplier.
    one = torch.ones(1, dtype=torch.float64)
    s = one.clone().requires_grad_()
    qp = QuadraticProgram(
        torch.eye(1).double(),
        -s,
        one.sum() * 0,
        torch.zeros(0, 1).double(),
        torch.zeros(0).double(),
        torch.eye(1).double(),
        -one,
        one,
        one * torch.inf,
    )
    (gradient,) = torch.autograd.grad(solve_qp(qp, solver="daqp").z.sum(), s)
    assert gradient.item() in (pytest.approx(0.0, abs=1e-9), pytest.approx(1.0, abs=1e-9))


def test_dependent_active_rows_have_a_finite_gradient():
    # The same hard bound twice: its multiplier is not unique, z is.
    one = torch.ones(2, dtype=torch.float64)
    q = torch.tensor([-3.0, 0.5], dtype=torch.float64, requires_grad=True)
    upper = one.clone().requires_grad_()
    G = torch.tensor([[1.0, 0.0], [1.0, 0.0]], dtype=torch.float64)
    qp = QuadraticProgram(
        torch.eye(2).double(),
        q,
        q.new_zeros(()),
        q.new_zeros(0, 2),
        q.new_zeros(0),
        G,
        -one,
        upper,
        one * torch.inf,
    )
    z = solve_qp(qp, solver="proxqp").z
    of_q, of_upper = torch.autograd.grad(z.sum(), (q, upper))
    assert_close(of_q, torch.tensor([0.0, -1.0]).double(), atol=1e-6, rtol=0)
    assert_close(of_upper.sum(), torch.tensor(1.0).double(), atol=1e-6, rtol=0)


def test_a_fully_fixed_z_moves_with_the_fixed_entries():
    one, none = torch.ones(1).double(), torch.zeros(0, 1).double()
    qp = QuadraticProgram(
        H=torch.eye(1).double(),
        q=one,
        c=one[0],
        C=none,
        b=none[:, 0],
        G=torch.eye(1).double(),
        lb=-2 * one,
        ub=2 * one,
        w=torch.inf * one,
    )
    fixed = normal(3, 1).clamp(-1, 1).requires_grad_()
    (slope,) = torch.autograd.grad(solve_qp(qp, fixed).z.sum(), fixed)
    assert_close(slope, torch.ones_like(fixed))


def test_the_values_second_derivative_agrees_with_differences_of_its_first():
    mpc, s = random_mpc(1), random_states(6)

    def gradient(x: Tensor) -> Tensor:
        x = x.detach().requires_grad_()
        return torch.autograd.grad(mpc.value(x).sum(), x)[0]

    second = vmap(jacrev(jacrev(mpc.value)))(s)
    step = 1e-5
    for i, axis in enumerate(torch.eye(s.shape[-1], dtype=s.dtype)):
        central = (gradient(s + step * axis) - gradient(s - step * axis)) / (2 * step)
        assert_close(second[..., i], central, rtol=1e-5, atol=1e-6)


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


def test_a_third_derivative_is_refused():
    mpc, s = random_mpc(0), random_states(1)[0].requires_grad_()
    (first,) = torch.autograd.grad(mpc.policy(s).sum(), s, create_graph=True)
    with pytest.raises(QPError, match="derivative: got the second of the solution, or the third"):
        first.sum().backward()


def test_an_unsolved_element_has_no_gradient_whatever_comes_in():
    mpc = random_mpc(0)
    s = random_states(3)
    s[1] = torch.nan
    mpc.on_failure = "mask"
    s.requires_grad_()
    action = mpc.policy(s)
    action.backward(torch.tensor([[1.0], [torch.inf], [1.0]]).to(action).expand_as(action))
    assert s.grad is not None
    assert (s.grad[1] == 0).all()
    assert s.grad.isfinite().all()
    assert all(p.grad.isfinite().all() for p in mpc.parameters() if p.grad is not None)


def test_compiled_policy_and_its_gradient():
    mpc, s = random_mpc(0), random_states(4)
    compiled = torch.compile(mpc.policy, fullgraph=True, backend="aot_eager")
    gradients = []
    for policy in (mpc.policy, compiled):
        leaf = s.clone().requires_grad_()
        gradients.append(torch.autograd.grad(policy(leaf).square().sum(), leaf)[0])
    assert_close(*gradients)


@pytest.mark.parametrize("length", [1e-8, 1.0, 1e8])
@pytest.mark.parametrize("cost", [1e-12, 1e-8, 1.0, 1e8])
def test_the_gradient_of_z_does_not_depend_on_the_units(cost, length):
    """With a cost of 1e-8 a multiplier is small, but not rounding: its row is active."""
    M = normal(6, 6)
    H, q = M @ M.mT + torch.eye(6, dtype=torch.float64), 5 * normal(6)
    w = torch.tensor([torch.inf] * 3 + [4.0] * 3, dtype=torch.float64)
    C, box = normal(1, 6), torch.full((6,), 0.5, dtype=torch.float64)

    def in_units(q: Tensor, cost: float, length: float) -> Tensor:
        qp = QuadraticProgram(
            H=H * cost / length**2,
            q=q * cost / length,
            c=torch.zeros((), dtype=torch.float64),
            C=C / length,
            b=torch.zeros(1, dtype=torch.float64),
            G=torch.eye(6, dtype=torch.float64),
            lb=-box * length,
            ub=box * length,
            w=w * cost / length,
        )
        return solve_qp(qp, solver="daqp").z / length

    ordinary = jacrev(lambda q: in_units(q, 1.0, 1.0))(q)
    assert ordinary.abs().max() > 0.1
    found = jacrev(lambda q: in_units(q, cost, length))(q)
    assert_close(found, ordinary, rtol=1e-8, atol=1e-8)
