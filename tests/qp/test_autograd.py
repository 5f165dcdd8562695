import gc
import weakref
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from tests.problems import KnownQP, known_qp, normal, random_mpc, random_states, solution_of
from tests.refused import refused
from torch_qpmpc import QPMPC, QPError, QuadraticProgram, SolverError, Status, solve_qp
from torch_qpmpc.qp.kkt import kkt_op
from torch_qpmpc.qp.program import EVENT_SHAPES
from torch_qpmpc.qp.solution import QPSolution
from torch_qpmpc.qp.solve import solve, solve_op

SOLUTION = (
    *("value", "z", "sigma", "chi", "upsilon", "eta", "mu", "xi"),
    *("active", "status", "residual"),
)
OPERANDS = (*EVENT_SHAPES, "fixed")


def solution(*operands: Tensor, **options: Any) -> QPSolution:
    qp = QuadraticProgram(*operands[:-1], check_values=False)
    options.setdefault("solver", "daqp")
    return solve_qp(qp, operands[-1], **options)


def value(*operands: Tensor, **options: Any) -> Tensor:
    return solution(*operands, **options).value


def operands_of(known: KnownQP, *, differentiable: bool = False) -> list[Tensor]:
    tensors = (*known.qp.tensors(), known.fixed)
    return [tensor.clone().requires_grad_(differentiable) for tensor in tensors]


def infeasible(known: KnownQP, index: int) -> KnownQP:
    qp = known.qp
    G, w = qp.G.clone(), qp.w.clone()
    G[index, 1] = G[index, 0]
    w[index, :2] = torch.inf
    lb, ub = qp.lb.clone(), qp.ub.clone()
    lb[index, 0], ub[index, 0] = 1.0, 2.0
    lb[index, 1], ub[index, 1] = 3.0, 4.0
    return replace(known, qp=replace(qp, G=G, lb=lb, ub=ub, w=w))


# Values of the gradient


def test_gradient_is_that_of_the_lagrangian_at_the_solution(solver):
    known = known_qp(0, batch=(4,), matrices=(4,))
    operands = operands_of(known, differentiable=True)
    weight = torch.tensor([1.0, -2.0, 0.5, 3.0]).double()
    value(*operands, solver=solver).backward(weight)
    z, lam, chi = known.z, known.lam, known.chi

    def outer(left: Tensor, right: Tensor) -> Tensor:
        return left.unsqueeze(-1) * right.unsqueeze(-2)

    expected = {
        "H": 0.5 * outer(z, z),
        "q": z,
        "c": torch.ones(4).double(),
        "C": outer(chi, z),
        "b": -chi,
        "G": outer(lam, z),
        "lb": known.upsilon,
        "ub": -known.eta,
        "w": known.sigma,
        "fixed": -known.xi,
    }
    for name, operand in zip(OPERANDS, operands, strict=True):
        weighted = weight.reshape(-1, *(1,) * (operand.ndim - 1)) * expected[name]
        assert_close(
            operand.grad, weighted, rtol=1e-4, atol=1e-4, msg=lambda m, n=name: f"{n}: {m}"
        )


@pytest.mark.parametrize("of_action", [False, True])
def test_gradient_in_state_and_action_agrees_with_finite_differences(of_action):
    mpc, s, a = random_mpc(0), random_states(6), random_states(6, 1, size=0.4)
    s.requires_grad_()
    a.requires_grad_()
    if of_action:
        assert torch.autograd.gradcheck(mpc.action_value, (s, a), eps=1e-5, atol=1e-4)
    else:
        assert torch.autograd.gradcheck(mpc.value, (s,), eps=1e-5, atol=1e-4)


def test_batch_dimensions_broadcast_in_value_and_gradient():
    K, B = 3, 4
    shapes = {"H": (K, 1), "q": (B,), "c": (K, 1), "C": (1, B), "b": (), "G": (), "w": (K, 1)}
    known = known_qp(3, soft=("inside", "above", "at_upper"), hard=())
    generator = torch.Generator().manual_seed(0)
    operands = []
    for name, operand in zip(OPERANDS, operands_of(known), strict=True):
        scale = 0.02 * torch.rand(shapes.get(name, (B,)), generator=generator).double()
        scale = scale.reshape(*scale.shape, *(1,) * operand.ndim)
        operands.append(((1 + scale) * operand).requires_grad_())
    values = value(*operands, solver="torch")
    assert values.shape == (K, B)
    values.square().sum().backward()

    loop = [operand.detach().clone().requires_grad_() for operand in operands]
    for k in range(K):
        for j in range(B):
            one = []
            for name, operand in zip(OPERANDS, loop, strict=True):
                n_event = len(EVENT_SHAPES.get(name, ("n_f",)))
                expanded = operand.expand(K, B, *operand.shape[operand.ndim - n_event :])
                one.append(expanded[k, j])
            single = value(*one, solver="torch")
            assert_close(values[k, j], single)
            single.square().backward()
    for name, together, alone in zip(OPERANDS, operands, loop, strict=True):
        assert_close(together.grad, alone.grad, msg=lambda m, n=name: f"{n}: {m}")


@pytest.mark.parametrize("name", OPERANDS)
def test_one_batched_operand_makes_a_batch(name):
    known = known_qp(3, soft=("inside", "above", "at_upper"), hard=("inside",))
    operands, index = operands_of(known), OPERANDS.index(name)
    scale = torch.tensor([0.99, 1.0, torch.nan, 1.01]).double()
    batched = torch.stack([factor * operands[index] for factor in scale])

    def of_one(operand: Tensor) -> QPSolution:
        changed = [*operands[:index], operand, *operands[index + 1 :]]
        return solution(*changed, on_failure="mask")

    together = of_one(batched)
    for i, operand in enumerate(batched):
        alone = of_one(operand)
        for name in SOLUTION:
            part, expected = getattr(together, name)[i], getattr(alone, name)
            assert_close(part, expected, rtol=1e-6, atol=1e-7, equal_nan=True)  # mu is w's NaN
    assert together.solved.tolist() == [True, True, False, True]


def test_gradient_does_not_depend_on_the_kept_entries():
    known = known_qp(4, batch=(3,))
    gradients = []
    for n_kept in (None, 2, 5):
        operands = operands_of(known, differentiable=True)
        qp = QuadraticProgram(*operands[:-1], check_values=False)
        solve(qp, operands[-1], n_kept, "daqp", "raise", None).value.sum().backward()
        gradients.append([operand.grad for operand in operands])
    for other in gradients[1:]:
        assert_close(other, gradients[0], rtol=1e-5, atol=1e-5)


# The value alone


def test_the_value_alone_is_that_of_the_whole_solution_with_its_derivatives():
    mpc, s = random_mpc(6, learn=tuple(EVENT_SHAPES)), random_states(5).requires_grad_()
    operands, incoming = (*mpc.parameters(), s), normal(3, 5)
    alone, whole = mpc.value(s), mpc.solve(s).value
    assert torch.equal(alone, whole)
    for options in ({}, {"create_graph": True}):
        found, expected = (
            torch.autograd.grad(value, operands, incoming[0], retain_graph=True, **options)
            for value in (alone, whole)
        )
        assert_close(found, expected)
    second, expected = (
        torch.autograd.grad(g[-1].square().sum(), operands[:-1], allow_unused=True)
        for g in (found, expected)
    )
    assert max(gradient.abs().max() for gradient in second if gradient is not None) > 1e-3
    assert_close(second, expected)


@pytest.mark.parametrize("value_of", [QPMPC.value, lambda mpc, s: mpc.solve(s).value])
def test_gradients_are_batched_as_torch_autograd_grad_does(value_of):
    mpc, s, incoming = random_mpc(6), random_states(5).requires_grad_(), normal(3, 5)
    value = value_of(mpc, s)
    rows = torch.autograd.grad(value, s, incoming, is_grads_batched=True, retain_graph=True)[0]
    for row, weight in zip(rows, incoming, strict=True):
        assert_close(row, torch.autograd.grad(value, s, weight, retain_graph=True)[0])


def test_a_value_that_is_let_go_is_freed_at_once():
    mpc, s = random_mpc(6), random_states(5)
    gc.collect()
    gc.disable()
    try:
        value = mpc.value(s)
        known = weakref.ref(value), weakref.ref(value.grad_fn)
        del value
        assert [ref() for ref in known] == [None, None]
    finally:
        gc.enable()


def test_a_value_that_is_changed_in_place_keeps_its_gradient():
    mpc, s = random_mpc(6), random_states(5)
    expected = torch.autograd.grad(mpc.value(s).sum(), mpc.C)
    assert_close(torch.autograd.grad(mpc.value(s).mul_(2.0).sum() / 2.0, mpc.C), expected)


# Unsolved elements


@pytest.mark.parametrize("part", ["value", "z"])
@pytest.mark.parametrize("incoming", [1.0, torch.inf, torch.nan])
def test_an_unsolved_element_has_no_gradient_whatever_comes_in(incoming, part):
    known = infeasible(known_qp(5, batch=(3,), matrices=(3,)), 1)
    operands = operands_of(known, differentiable=True)
    found = solution(*operands, on_failure="mask")
    assert found.value[1] == torch.inf
    outcome = getattr(found, part)
    weight = torch.tensor([1.0, incoming, 1.0]).double()
    outcome.backward(weight.reshape(3, *(1,) * (outcome.ndim - 1)).expand_as(outcome))
    for name, operand in zip(OPERANDS, operands, strict=True):
        assert operand.grad.isfinite().all(), name
        assert (operand.grad[1] == 0).all(), name
    assert (operands[0].grad[0] != 0).any()  # pyright: ignore[reportOptionalSubscript] - seen above


def test_invalid_elements_have_no_gradient_and_spoil_no_other():
    known = known_qp(6, batch=(3,), matrices=(3,))
    operands = operands_of(known)
    for i in range(len(operands)):
        spoilt = [operand.clone() for operand in operands]
        spoilt[i][1].fill_(torch.nan)
        for operand in spoilt:
            operand.requires_grad_()
        values = value(*spoilt, on_failure="mask")
        assert_close(values, torch.where(torch.arange(3) == 1, torch.inf, known.value))
        values[values.isfinite()].sum().backward()
        for operand in spoilt:
            assert operand.grad.isfinite().all(), OPERANDS[i]


def test_an_unsolved_element_carries_infinite_cost_and_its_fixed_entries():
    known = infeasible(known_qp(5, batch=(3,), matrices=(3,)), 1)
    found = solve_qp(known.qp, known.fixed, solver="daqp", on_failure="mask")
    assert found.solved.tolist() == [True, False, True]
    assert found.status[1] == Status.INFEASIBLE
    assert found.value[1] == torch.inf
    assert_close(found.z[1, :2], known.fixed[1])
    for name in ("sigma", "chi", "upsilon", "eta", "xi"):
        assert (getattr(found, name)[1] == 0).all()
    assert (found.z[1, 2:] == 0).all()


# torch.func and torch.compile


def test_the_operator_keeps_torchs_contract():
    batch = (3,)
    known = known_qp(9, batch=batch)
    operands = operands_of(known, differentiable=True)
    active = torch.zeros(known.lam.shape, dtype=torch.int8)
    arguments = (*operands, active, 2, "daqp", "mask")
    # Without its slow check of AOT autograd, which test_compile.py covers.
    checks = ("test_schema", "test_autograd_registration", "test_faketensor")
    torch.library.opcheck(solve_op, arguments, test_utils=checks)
    gradients = [torch.ones_like(x) for x in (known.z, known.lam, known.chi, known.xi)]
    solution = (known.z, known.lam, torch.zeros(batch, dtype=torch.int64))
    theta = [x.detach() for x in operands]
    torch.library.opcheck(kkt_op, (*gradients, *solution, *theta, 2), test_utils=checks)


# Outputs


def test_multipliers_of_a_row_sum_to_its_weight():
    known = known_qp(11, batch=(4,))
    found = solve_qp(known.qp, known.fixed, solver="daqp")
    soft = known.qp.w.isfinite()
    total = found.upsilon + found.eta + found.mu
    assert_close(total[soft], known.qp.w[soft])
    assert (found.mu[~soft] == torch.inf).all()
    assert (torch.minimum(found.upsilon, found.eta) == 0).all()
    assert (found.mu >= -1e-9).all()
    assert (found.sigma[~soft] == 0).all()


def test_single_precision_in_single_precision_out(solver):
    known = known_qp(12, batch=(4,), dtype=torch.float32)
    operands = operands_of(known, differentiable=True)
    found = solution(*operands, solver=solver)
    for name, part in solution_of(known).items():
        assert getattr(found, name).dtype == torch.float32
        assert_close(getattr(found, name), part, rtol=1e-3, atol=1e-3)
    found.value.sum().backward()
    for operand in operands:
        assert operand.grad.dtype == torch.float32


def test_an_asymmetry_within_the_tolerance_of_single_precision_does_no_harm():
    H, unit = torch.eye(2), torch.ones(2)
    H[0, 1] = 8e-6
    qp = QuadraticProgram(H, -100 * unit, G=H, lb=-1e9 * unit, ub=1e9 * unit, w=unit)
    assert_close(solve_qp(qp, solver="daqp").z, 100 * unit, rtol=1e-5, atol=0)


# Errors


GOOD, OTHER = known_qp(14, batch=(3,)), known_qp(14)
CODES = r"of torch.int8, expected \(3, 13\) of torch.int8. Pass the solution of the same batch"


@refused(
    ({"fixed": [1.0, 2.0]}, "fixed: got list, expected a floating-point torch.Tensor"),
    ({"fixed": torch.ones(2, dtype=torch.int64)}, "fixed: got torch.int64, expected a float"),
    ({"fixed": torch.tensor(1.0)}, r"fixed: got shape \(\), expected shape \(\*batch, n_f\)"),
    ({"fixed": torch.ones(13)}, r"fixed: got shape \(13,\), .* with n_f <= n_z = 12"),
    ({"fixed": torch.ones(4, 2)}, r"fixed: got shape \(4, 2\), .* the QP's batch \(3,\)"),
    ({"on_failure": None}, "on_failure: got None, expected one of raise, warn, mask"),
    ({"solver": ["daqp"]}, "solver: got list, expected a str"),
    ({"on_failure": "ignore"}, "on_failure: got 'ignore', expected one of raise, warn, mask"),
    ({"warm_start": solve_qp(OTHER.qp, OTHER.fixed)}, rf"warm_start: got shape \(13,\) {CODES}"),
    ({"warm_start": torch.zeros(3, 12).char()}, rf"warm_start: got shape \(3, 12\) {CODES}"),
    ({"warm_start": torch.zeros(3, 13)}, r"warm_start: got shape \(3, 13\) of torch.float32, exp"),
)
def test_bad_arguments_are_named(arguments):
    solve_qp(GOOD.qp, **({"fixed": GOOD.fixed} | arguments))


@pytest.mark.parametrize("on_failure", ["raise", "warn"])
def test_failures_are_counted_and_located(on_failure):
    known = infeasible(known_qp(5, batch=(3,), matrices=(3,)), 1)
    b = known.qp.b.clone()
    b[2] = torch.nan
    operands = operands_of(known)
    operands[OPERANDS.index("b")] = b
    message = (
        r"2 of 3 QPs have no certified solution. 1 INFEASIBLE, first at batch index \(1,\): .*; "
        r"soften rows with a finite w.* 1 INVALID_DATA, first at batch index \(2,\): NaN or inf"
    )
    if on_failure == "raise":
        with pytest.raises(SolverError, match=message):
            value(*operands, on_failure=on_failure)
    else:
        with pytest.warns(RuntimeWarning, match=message):
            values = value(*operands, on_failure=on_failure)
        assert values.isinf().tolist() == [False, True, True]


def test_invalid_data_alone_is_bad_input():
    operands = operands_of(known_qp(5))
    operands[OPERANDS.index("lb")].fill_(torch.nan)
    with pytest.raises(QPError, match=r"1 of 1 QPs .* 1 INVALID_DATA: NaN or inf in the data"):
        value(*operands)


# Threads and processes


TOO_LARGE = r"batch: got 12 QPs of n_z = 12, expected as many as .* Solve the batch in chunks, .*"
CPU = "[enforce fail at alloc_cpu.cpp:124] . DefaultCPUAllocator: can't allocate memory"


@pytest.mark.parametrize(
    ("error", "kind", "message"),
    [
        (MemoryError("Unable to allocate 8.00 TiB for an array"), QPError, f"{TOO_LARGE}array"),
        (RuntimeError(CPU), QPError, f"{TOO_LARGE}memory"),
        (torch.OutOfMemoryError("CUDA out of memory."), QPError, f"{TOO_LARGE}memory"),
        (RuntimeError("of another kind"), RuntimeError, "of another kind"),
    ],
)
@pytest.mark.parametrize("differentiated", [False, True])
def test_a_batch_that_is_too_large_for_memory_is_named(
    error, kind, message, differentiated, monkeypatch
):
    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr("torch_qpmpc.qp.pipeline.solve.solve_programs", fail)
    known = known_qp(1, batch=(4, 3))
    fixed = known.fixed.clone().requires_grad_(differentiated)
    with pytest.raises(kind, match=message):
        solve_qp(known.qp, fixed)
