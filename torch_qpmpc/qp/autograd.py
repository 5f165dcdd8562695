"""The eager path: solve, then attach the derivative with one autograd Function."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from torch_qpmpc.qp.boundary import Outputs, solve_now
from torch_qpmpc.qp.derivatives import gradients
from torch_qpmpc.qp.operator import N_THETA, kkt


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
        return None, None, *gradients(incoming, theta, solution, needed, ctx.n_kept, kkt)
