"""The QP's cost of theta: H, q and w with their discounts (eq:qpH, eq:qp2c0)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torch_qpmpc import kernels, theta_kernels
from torch_qpmpc.layout import Layout
from torch_qpmpc.sensitivity import is_differentiating, is_plain, is_traced

#: H ``(n_z, n_z)``, q ``(n_z,)`` and w ``(n_g,)`` of the QP.
Cost = tuple[Tensor, Tensor, Tensor]


class Discounts(NamedTuple):
    """What theta's cost is multiplied by, float64.

    ``of_z`` ``(n_z,)`` and ``of_rows`` ``(n_g,)`` are gamma^k, or one. ``hardness`` ``(n_g,)`` is
    added to w: inf for a hard row, whose w is a placeholder, and else zero. ``stages`` is
    ``ties("q")`` of `Layout`.
    """

    of_z: Tensor
    of_rows: Tensor
    hardness: Tensor
    stages: Tensor


def discounted(
    layout: Layout, kind: str, blocks: tuple[Tensor, ...], q: Tensor, w: Tensor, by: Discounts
) -> Cost:
    """From theta's H of the stages and of x_N, or a full one, and its q and w."""
    H = layout.hessian(kind, blocks, by.of_z, by.stages)
    return H, by.of_z * q, torch.addcmul(by.hardness, by.of_rows, w)


def diagonal_cost(
    layout: Layout, factors: Sequence[Tensor], squared: Sequence[bool], by: Discounts
) -> Cost | None:
    """`discounted` for a diagonal H in one kernel; None where that would hide it from PyTorch.

    With its gradient it is some thirty operations of torch, which take as long as 40 QPs.

    Args:
        layout: of z.
        factors: H ``(n_x + n_u,)``, H_f ``(n_x,)``, w and q, or what they are the squares of.
        squared: which of H, H_f and w are.
        by: the discounts.
    """
    shapes = ((layout.n,), (layout.n_x,), by.of_rows.shape, by.of_z.shape)
    fits = all(
        x.shape == shape and x.is_cpu and x.dtype == torch.float64
        for x, shape in zip(factors, shapes, strict=True)
    )
    if not (fits and is_plain(factors)):
        return None
    given = kernels.arrays(*factors, *by)
    found = kernels.tensors(theta_kernels.diagonal_cost(*given, *squared), factors[0].device)
    if is_differentiating():
        found = DiagonalCost.apply(found, given, layout, squared, by, *factors)
    H, q, w = found
    return H, q, w


class DiagonalCost(torch.autograd.Function):
    """A cost that is known, with its gradient: for `diagonal_cost`."""

    @staticmethod
    def forward(
        ctx: Any,
        found: Sequence[Tensor],
        given: Sequence[np.ndarray],
        layout: Layout,
        squared: Sequence[bool],
        by: Discounts,
        *factors: Tensor,
    ) -> tuple[Tensor, ...]:
        ctx.set_materialize_grads(False)
        ctx.given, ctx.constants = given, (layout, squared, by)
        ctx.save_for_backward(*factors)
        of_H, of_H_f, of_w, of_q = ctx.needs_input_grad[5:]
        learned = (of_H or of_H_f, of_q, of_w)
        ctx.mark_non_differentiable(
            *(x for x, is_learned in zip(found, learned, strict=True) if not is_learned)
        )
        return tuple(found)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple:  # pyright: ignore[reportIncompatibleMethodOverride]
        # Asked for even where the arrays do: autograd looks whether they have changed since.
        factors, needed = ctx.saved_tensors, ctx.needs_input_grad[5:]
        if is_differentiating() or is_traced([x for x in gradients if x is not None]):
            found = _gradients(factors, needed, gradients, *ctx.constants)
        else:
            found = _gradients_by_kernel(needed, gradients, ctx.given, ctx.constants[1])
        return (*(None,) * 5, *found)


def _gradients_by_kernel(
    needed: Sequence[bool],
    gradients: Sequence[Tensor | None],
    given: Sequence[np.ndarray],
    squared: Sequence[bool],
) -> list[Tensor | None]:
    """Of the factors, without derivatives of their own."""
    *_, of_z, of_rows, _, _ = given
    shapes = (of_z.shape * 2, of_z.shape, of_rows.shape)
    incoming = (
        np.zeros(shape) if x is None else kernels.arrays(x)[0]
        for x, shape in zip(gradients, shapes, strict=True)
    )
    found = theta_kernels.diagonal_cost_gradient(*incoming, *given, *squared)
    of_H, of_q, of_w = (x is not None for x in gradients)
    asked = zip(found, needed, (of_H, of_H, of_w, of_q), strict=True)
    return [torch.from_numpy(x) if need and has else None for x, need, has in asked]


def _gradients(
    factors: Sequence[Tensor],
    needed: Sequence[bool],
    gradients: Sequence[Tensor | None],
    layout: Layout,
    squared: Sequence[bool],
    by: Discounts,
) -> list[Tensor | None]:
    """Of the factors, and differentiable: those of `discounted`."""
    with torch.enable_grad():
        pairs = zip(factors[:3], squared, strict=True)
        H, H_f, w = (x * x if is_squared else x for x, is_squared in pairs)
        found = discounted(layout, "diagonal", (H, H_f), factors[3], w, by)
    asked = [x for x, need in zip(factors, needed, strict=True) if need]
    pairs = [(x, y) for x, y in zip(found, gradients, strict=True) if y is not None]
    pulled = torch.autograd.grad(
        [x for x, _ in pairs],
        asked,
        [y for _, y in pairs],
        create_graph=is_differentiating(),
        allow_unused=True,
    )
    rest = iter(pulled)
    return [next(rest) if need else None for need in needed]
