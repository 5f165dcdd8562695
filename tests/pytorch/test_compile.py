"""`torch.compile(fullgraph=True)` gives the eager numbers, or an error."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor
from torch._dynamo.testing import CompileCounter
from torch.func import grad, jvp, vmap
from torch.testing import assert_close

from tests.problems import random_mpc, random_states
from torch_qpmpc import QPMPC, QuadraticProgram, solve_qp
from torch_qpmpc.qp.program import EVENT_SHAPES

Function = Callable[[Tensor, Tensor], Tensor]
pytestmark = pytest.mark.usefixtures("fresh_dynamo")


def functions(mpc: QPMPC) -> dict[str, Function]:
    return {
        "value": lambda s, a: mpc.value(s),
        "action value": mpc.action_value,
        "policy": lambda s, a: mpc.policy(s),
        "vmap of action value": lambda s, a: vmap(mpc.action_value)(s, a),
        "dV/ds": lambda s, a: grad(lambda s: mpc.value(s).sum())(s),
    }


def outcome(mpc: QPMPC, function: Function, s: Tensor, a: Tensor) -> tuple[Tensor, list]:
    mpc.zero_grad()
    out = function(s, a)
    out.square().sum().backward()
    return out.detach(), [part.grad for part in mpc.parameters()]


@pytest.mark.parametrize(
    ("name", "known", "backend"),
    [
        ("value", "state", "aot_eager"),
        ("action value", "preview", "aot_eager"),
        pytest.param("policy", "state", "aot_eager", marks=pytest.mark.slow),
        ("vmap of action value", "state", "aot_eager"),
        pytest.param("value", "state", "inductor", marks=pytest.mark.slow),
    ],
)
def test_compiled_in_one_graph_equals_eager(name, known, backend):
    preview = {"n_d": 1} if known == "preview" else {}
    mpc, a = random_mpc(3, **preview), random_states(4, 1, size=0.4)
    s = random_states(4, mpc.n_p)
    function = functions(mpc)[name]
    compiled = torch.compile(function, fullgraph=True, backend=backend)
    assert_close(outcome(mpc, compiled, s, a), outcome(mpc, function, s, a))


def test_a_gradient_inside_of_what_is_compiled():
    mpc, s = random_mpc(3), random_states(4)
    function = functions(mpc)["dV/ds"]
    compiled = torch.compile(function, fullgraph=True, backend="aot_eager")
    assert_close(compiled(s, s), function(s, s))


@pytest.mark.parametrize(("output", "of"), [("value", "fixed"), ("z", "q")])
def test_a_gradient_in_an_argument_passed_unchanged(output, of):
    qp, s = random_mpc(3).quadratic_program(), random_states(4)
    given = {name: x.detach() for name, x in zip(EVENT_SHAPES, qp.tensors(), strict=True)}
    given["fixed"] = s

    def total(x: Tensor) -> Tensor:
        theta: dict[str, Any] = given | {of: x}
        fixed = theta.pop("fixed")
        return getattr(solve_qp(QuadraticProgram(**theta, check_values=False), fixed), output).sum()

    compiled = torch.compile(grad(total), fullgraph=True, backend="aot_eager")
    expected = grad(total)(given[of])
    assert expected.abs().max() > 0.1
    assert_close(compiled(given[of]), expected)


@pytest.mark.parametrize("name", ["value", pytest.param("policy", marks=pytest.mark.slow)])
def test_batch_sizes_and_updates_of_theta_do_not_compile_again(name):
    mpc, counter = random_mpc(3), CompileCounter()
    function = functions(mpc)[name]
    compiled: Any = torch.compile(function, fullgraph=True, backend=counter)
    for batch in range(2, 9):
        s = random_states(batch)
        assert_close(compiled(s, s), function(s, s))
        with torch.no_grad():
            mpc.C[:, 0].add_(0.01)
    assert counter.frame_count == 2  # of one size, and of any


@pytest.mark.parametrize(
    "transformed",
    [
        pytest.param(lambda f: vmap(grad(f)), id="vmap of grad", marks=pytest.mark.slow),
        pytest.param(lambda f: lambda s: jvp(f, (s,), (torch.ones_like(s),))[1], id="jvp"),
    ],
)
def test_transforms_that_cannot_be_compiled_are_refused_or_left_eager(transformed):
    mpc, s = random_mpc(3), random_states(4)
    function = transformed(mpc.value)
    with pytest.raises(Exception, match="QPError"):
        torch.compile(function, fullgraph=True, backend="aot_eager")(s)
    torch._dynamo.reset()
    alone: Any = torch.compiler.disable(function)
    apart = torch.compile(alone, backend="aot_eager")
    assert_close(apart(s), function(s))


def test_a_second_derivative_through_a_compiled_function_is_refused():
    mpc, s = random_mpc(3), random_states(4).requires_grad_()
    compiled = torch.compile(mpc.value, fullgraph=True, backend="aot_eager")
    (slope,) = torch.autograd.grad(compiled(s).sum(), s, create_graph=True)
    with pytest.raises(RuntimeError, match="does not currently support double backward"):
        slope.square().sum().backward()


def test_an_exported_program_has_the_same_values_for_any_batch():
    mpc, s = random_mpc(3), random_states(4)
    shapes = {"s": {0: torch.export.Dim("batch")}}
    program = torch.export.export(mpc, (s,), dynamic_shapes=shapes)
    more = random_states(7, seed=1)
    assert_close(program.module()(more), mpc.value(more))
