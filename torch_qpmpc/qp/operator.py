"""The traced way in: the solve as one operator of torch, with its rules side by side.

A custom operator keeps the solver opaque to `torch.compile`, fake tensors and `vmap`. The autograd
Function round it makes it differentiable under `torch.func` and in forward mode as well, which a
custom operator alone is not. The formulas are in `torch_qpmpc.qp.derivatives`.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torch_qpmpc.errors import QPError
from torch_qpmpc.qp.batching import align, broadcast
from torch_qpmpc.qp.boundary import Outputs, solve_now
from torch_qpmpc.qp.derivatives import gradients, solve_kkt, tangents
from torch_qpmpc.qp.program import NDIMS
from torch_qpmpc.qp.tracing import has_values, is_differentiating, is_forward_mode, transforms

#: Event dimensions of the operator's tensors: H, q, c, C, b, G, lb, ub, w, fixed, a warm start.
EVENT_NDIMS = (*NDIMS, 1, 1)
#: Those of the KKT system's: four gradients; z, lam, status; H, .., fixed.
KKT_NDIMS = (1, 1, 1, 1, 1, 1, 0, *NDIMS, 1)
#: Derivatives follow H, .., fixed, but not the start, n_kept, solver and on_failure.
N_THETA, N_OTHERS = 10, 4

solve_op = torch.library.custom_op("torch_qpmpc::solve", solve_now, mutates_args=())
kkt_op = torch.library.custom_op("torch_qpmpc::solve_kkt", solve_kkt, mutates_args=())


def solve_traced(*arguments: Any) -> Outputs:
    """Call `solve_now` in the form that PyTorch can trace or differentiate now.

    Dynamo traces no Function that has a jvp, none at all under `vmap`, and no custom operator under
    `grad`. It would drop the outer derivative of nested transforms without a word.
    """
    if not is_differentiating():
        return solve_op(*arguments)
    around = transforms()
    if not torch.compiler.is_compiling():
        if around.count("Jvp") > 1:
            raise QPError.expected(
                "derivative", "jvp in jvp", "one forward mode", "Use hessian, or jacrev inside."
            )
        forward = around or is_forward_mode()
        return (TracedForward if forward else Traced).apply(*arguments)
    if set(around) <= {"Vmap"}:
        return solve_op(*arguments) if around else Traced.apply(*arguments)
    if around != ("Grad",):
        raise QPError.expected(
            "torch.compile",
            f"{' in '.join(reversed(around))}, transforms inside of what is compiled",
            "vmap, or one grad, jacrev or vjp of a scalar",
            "Leave this function out: torch.compiler.disable.",
        )
    # Dynamo takes the gradient in a tensor for zero, or fails, if it is what `grad` differentiates
    # in and nothing was done to it before.
    return Traced.apply(*(x.view_as(x) if isinstance(x, Tensor) else x for x in arguments))


@solve_op.register_fake
def _(H, q, c, C, b, G, lb, ub, w, fixed, start, n_kept, solver, on_failure):
    operands = (H, q, c, C, b, G, lb, ub, w, fixed)
    batch = broadcast(*(t.shape[: t.ndim - n] for t, n in zip(operands, EVENT_NDIMS, strict=False)))

    def count() -> Tensor:
        return q.new_empty(batch, dtype=torch.int64)

    n_z, n_c, n_g, n_f = q.shape[-1], b.shape[-1], lb.shape[-1], fixed.shape[-1]
    vectors = [q.new_empty((*batch, n)) for n in (n_z, n_c, n_g, n_f)]
    active = q.new_empty((*batch, n_g), dtype=torch.int8)
    return (q.new_empty(batch), *vectors, count(), q.new_empty(batch), count(), active)


@solve_op.register_vmap
def _(info: Any, in_dims: tuple, *args: Any) -> tuple:
    return solve_op(*align(in_dims, args, EVENT_NDIMS)), (0,) * 9


def _setup_context(ctx: Any, inputs: tuple, output: Outputs) -> None:
    _, z, chi, lam, xi, status, *_ = output
    ctx.set_materialize_grads(False)
    ctx.n_kept = inputs[N_THETA + 1]
    # z, chi, lam and xi are outputs: a second derivative follows them by this same backward.
    ctx.save_for_backward(*inputs[:N_THETA], z, chi, lam, xi, status)


def _backward(ctx: Any, *incoming: Tensor | None) -> tuple:
    theta, solution = ctx.saved_tensors[:N_THETA], ctx.saved_tensors[N_THETA:]
    needed = ctx.needs_input_grad[:N_THETA]
    found = gradients(incoming[:5], theta, solution, needed, ctx.n_kept, kkt)
    return (*found, *(None,) * N_OTHERS)


solve_op.register_autograd(_backward, setup_context=_setup_context)


class Traced(torch.autograd.Function):
    """`solve_op`, differentiable under `torch.func`."""

    # Dynamo counts the parameters to tell this style of Function: no *args here.
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
        return Traced.apply(*align(in_dims, args, EVENT_NDIMS)), (0,) * 9


class TracedForward(Traced):
    """And in forward mode, which Dynamo does not trace."""

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Outputs) -> None:
        Traced.setup_context(ctx, inputs, output)
        ctx.save_for_forward(*ctx.to_save)

    @staticmethod
    def jvp(ctx: Any, *of_inputs: Tensor | None) -> tuple:
        theta, solution = ctx.saved_tensors[:N_THETA], ctx.saved_tensors[N_THETA:]
        found = tangents(of_inputs[:N_THETA], theta, solution, ctx.n_kept, kkt)
        return *found, *(None,) * 4

    @staticmethod
    def vmap(info: Any, in_dims: tuple, *args: Any) -> tuple:
        return TracedForward.apply(*align(in_dims, args, EVENT_NDIMS)), (0,) * 9


# The KKT system behind the derivatives of the solution, hidden from traces likewise


def kkt(*arguments: Any) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Call `solve_kkt` in the form that PyTorch can trace now; a further derivative raises."""
    if torch.compiler.is_compiling():
        return kkt_op(*arguments)
    if not is_differentiating() and has_values(*arguments[:-1]):
        return solve_kkt(*arguments)
    return KKTSolution.apply(*arguments)


@kkt_op.register_fake
def _(grad_z, grad_lam, grad_chi, grad_xi, z, lam, status, *theta):
    return tuple(torch.empty_like(x) for x in (grad_z, grad_chi, grad_lam, grad_xi))


@kkt_op.register_vmap
def _(info: Any, in_dims: tuple, *args: Any) -> tuple:
    return kkt_op(*align(in_dims, args, KKT_NDIMS)), (0,) * 4


class KKTSolution(torch.autograd.Function):
    """`kkt_op`, whose derivative would be a second one of the solution."""

    @staticmethod
    def forward(*args):
        return kkt_op(*args)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: tuple) -> None:
        pass

    @staticmethod
    def backward(ctx: Any, *_: Tensor) -> tuple:
        raise QPError.expected(
            "derivative",
            "a second one of the solution, or a third one of the value",
            "one of the solution, or two of the value",
            "Detach what need not be differentiated.",
        )

    @staticmethod
    def jvp(ctx: Any, *_: Tensor) -> tuple:
        return KKTSolution.backward(ctx)

    @staticmethod
    def vmap(info: Any, in_dims: tuple, *args: Any) -> tuple:
        return KKTSolution.apply(*align(in_dims, args, KKT_NDIMS)), (0,) * 4
