"""The derivative of the solve, attached by autograd Functions; `derivatives` has the formulas.

*Eager* calls run the pipeline and attach one Function. *Traced* calls (`torch.func`, compile, fake
tensors, forward mode) are one custom operator over the same pipeline, which stays opaque to
`torch.compile`, fake tensors and `vmap`. The Function around it makes it differentiable under
`torch.func` and in forward mode, which a custom operator alone is not.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from torch_qpmpc.errors import QPError
from torch_qpmpc.qp.batching import align, broadcast
from torch_qpmpc.qp.derivatives import N_THETA, gradients, tangents
from torch_qpmpc.qp.pipeline.solve import Outputs, solve_now
from torch_qpmpc.qp.program import NDIMS
from torch_qpmpc.qp.tracing import is_differentiating, is_forward_mode, transforms

#: Event dimensions of the operator's tensors: H, q, c, C, b, G, lb, ub, w, fixed, start.
EVENT_NDIMS = (*NDIMS, 1, 1)
#: The number of arguments after those: start, n_kept, solver, on_failure.
N_OTHERS = 4


def solve_eager(
    theta: Sequence[Tensor], start: Tensor | None, n_kept: int, solver: str, on_failure: str
) -> Outputs:
    """Solve; value, z, chi, lam and xi are differentiable in ``theta``, H to w and fixed."""
    outputs = solve_now(*theta, start, n_kept, solver, on_failure)  # pyright: ignore[reportCallIssue]
    if torch.is_grad_enabled() and any(x.requires_grad for x in theta):
        outputs = (*Solution.apply(outputs[:6], n_kept, *theta), *outputs[5:])
    return outputs


class Solution(torch.autograd.Function):
    """The derivatives of a computed solution in theta."""

    @staticmethod
    def forward(ctx: Any, known: Sequence[Tensor], n_kept: int, *theta: Tensor) -> tuple:
        *solution, status = known
        ctx.set_materialize_grads(False)
        ctx.n_kept = n_kept
        # Saving z, chi, lam and xi, which are outputs, makes this backward differentiable.
        ctx.save_for_backward(*theta, *solution[1:], status)
        return tuple(solution)

    @staticmethod
    def backward(ctx: Any, *incoming: Tensor | None) -> tuple:  # pyright: ignore[reportIncompatibleMethodOverride]
        theta, solution = ctx.saved_tensors[:N_THETA], ctx.saved_tensors[N_THETA:]
        needed = ctx.needs_input_grad[2:]
        return None, None, *gradients(incoming, theta, solution, needed, ctx.n_kept)


solve_op = torch.library.custom_op("torch_qpmpc::solve", solve_now, mutates_args=())


def solve_traced(*arguments: Any) -> Outputs:
    """Call `solve_now` in the form that the current trace or transform supports.

    Dynamo traces no Function that has a jvp, no Function under `vmap`, and no custom operator under
    `grad`. It would silently drop the outer derivative of nested transforms.

    Raises:
        QPError: the combination of transforms is not supported.
    """
    if not is_differentiating():
        return solve_op(*arguments)
    stack = transforms()
    if not torch.compiler.is_compiling():
        if stack.count("Jvp") > 1:
            raise QPError.expected(
                "derivative", "jvp in jvp", "one forward mode", "Use hessian, or jacrev inside."
            )
        forward = stack or is_forward_mode()
        return (TracedForward if forward else Traced).apply(*arguments)
    if set(stack) <= {"Vmap"}:
        return solve_op(*arguments) if stack else Traced.apply(*arguments)
    if stack == ("Grad",):
        # Without an operation on an argument of `grad`, Dynamo fails or takes its gradient as zero.
        return Traced.apply(*(x.view_as(x) if isinstance(x, Tensor) else x for x in arguments))
    raise QPError.expected(
        "torch.compile",
        f"{' in '.join(reversed(stack))} inside a compiled function",
        "vmap, or one grad, jacrev or vjp of a scalar",
        "Exclude this function with torch.compiler.disable.",
    )


@solve_op.register_fake
def _(H, q, c, C, b, G, lb, ub, w, fixed, start, n_kept, solver, on_failure):
    operands = (H, q, c, C, b, G, lb, ub, w, fixed)
    batch = broadcast(*(t.shape[: t.ndim - n] for t, n in zip(operands, EVENT_NDIMS, strict=False)))

    def count() -> Tensor:
        return q.new_empty(batch, dtype=torch.int64)

    n_z, n_c, n_g, n_f = q.shape[-1], b.shape[-1], lb.shape[-1], fixed.shape[-1]
    vectors = [q.new_empty((*batch, n)) for n in (n_z, n_c, n_g, n_f)]
    active = q.new_empty((*batch, n_g), dtype=torch.int8)
    errors = q.new_empty(batch), q.new_empty(batch)
    return (q.new_empty(batch), *vectors, count(), *errors, count(), active)


@solve_op.register_vmap
def _(info: Any, in_dims: tuple, *args: Any) -> tuple:
    return solve_op(*align(in_dims, args, EVENT_NDIMS)), (0,) * 10


def _setup_context(ctx: Any, inputs: tuple, output: Outputs) -> None:
    _, z, chi, lam, xi, status, *_ = output
    ctx.set_materialize_grads(False)
    ctx.n_kept = inputs[N_THETA + 1]
    # Saving z, chi, lam and xi, which are outputs, makes this backward differentiable.
    ctx.save_for_backward(*inputs[:N_THETA], z, chi, lam, xi, status)


def _backward(ctx: Any, *incoming: Tensor | None) -> tuple:
    theta, solution = ctx.saved_tensors[:N_THETA], ctx.saved_tensors[N_THETA:]
    needed = ctx.needs_input_grad[:N_THETA]
    grads = gradients(incoming[:5], theta, solution, needed, ctx.n_kept)
    return (*grads, *(None,) * N_OTHERS)


solve_op.register_autograd(_backward, setup_context=_setup_context)


class Traced(torch.autograd.Function):
    """`solve_op`, differentiable under `torch.func`."""

    # No *args: Dynamo recognises this style of Function by its number of parameters.
    @staticmethod
    def forward(H, q, c, C, b, G, lb, ub, w, fixed, start, n_kept, solver, on_failure) -> Outputs:
        return solve_op(H, q, c, C, b, G, lb, ub, w, fixed, start, n_kept, solver, on_failure)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Outputs) -> None:
        ctx.mark_non_differentiable(*output[5:])
        _setup_context(ctx, inputs, output)

    backward = staticmethod(_backward)

    @staticmethod
    def vmap(info: Any, in_dims: tuple, *args: Any) -> tuple:
        return Traced.apply(*align(in_dims, args, EVENT_NDIMS)), (0,) * 10


class TracedForward(Traced):
    """`Traced`, differentiable in forward mode as well, which Dynamo does not trace."""

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Outputs) -> None:
        Traced.setup_context(ctx, inputs, output)
        ctx.save_for_forward(*ctx.to_save)

    @staticmethod
    def jvp(ctx: Any, *d_inputs: Tensor | None) -> tuple:
        theta, solution = ctx.saved_tensors[:N_THETA], ctx.saved_tensors[N_THETA:]
        d_outputs = tangents(d_inputs[:N_THETA], theta, solution, ctx.n_kept)
        return *d_outputs, *(None,) * 5

    @staticmethod
    def vmap(info: Any, in_dims: tuple, *args: Any) -> tuple:
        return TracedForward.apply(*align(in_dims, args, EVENT_NDIMS)), (0,) * 10
