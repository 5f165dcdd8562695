"""The QP's cost of theta: H, q and w with their discounts (eq:qpH, eq:qp2c0)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torch_qpmpc.mpc.layout import Layout
from torch_qpmpc.qp.kernels import per_sample, per_theta
from torch_qpmpc.qp.sensitivity import is_differentiating, is_plain, is_traced

#: H ``(n_z, n_z)``, q ``(n_z,)`` and w ``(n_g,)`` of the QP.
Cost = tuple[Tensor, Tensor, Tensor]


#: Of H, H_f, w and q, and of the `Discounts`.
_DTYPES = (*[torch.float64] * 7, torch.int64)


class Discounts(NamedTuple):
    """What theta's cost is multiplied by.

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
) -> Cost:
    """`discounted` for a diagonal H: by one kernel, or by torch where that has to look on.

    With its gradient it is some thirty operations of torch, which take as long as 40 QPs.

    Args:
        layout: of z.
        factors: H ``(n_x + n_u,)``, H_f ``(n_x,)``, w and q, or what they are the squares of.
        squared: which of H, H_f and w are.
        by: the discounts.
    """
    if not _suit_the_kernel(layout, factors, by):
        return _by_torch(layout, factors, squared, by)
    given = per_sample.arrays(*factors, *by)
    found = per_sample.tensors(per_theta.diagonal_cost(*given, *squared), factors[0].device)
    if is_differentiating():
        found = DiagonalCost.apply(found, given, layout, squared, by, *factors)
    H, q, w = found
    return H, q, w


def _suit_the_kernel(layout: Layout, factors: Sequence[Tensor], by: Discounts) -> bool:
    """Whether they are plain tensors on the CPU, as the layout has them, and no discount learns."""
    tensors, n_z, n_g = (*factors, *by), (layout.n_z,), (layout.n_z + layout.n_linear,)
    shapes = ((layout.n,), (layout.n_x,), n_g, n_z, n_z, n_g, n_g, n_z)
    fit = all(
        x.shape == shape and x.is_cpu and x.dtype == dtype
        for x, shape, dtype in zip(tensors, shapes, _DTYPES, strict=True)
    )
    return fit and not any(x.requires_grad for x in by) and is_plain(tensors)


def _by_torch(
    layout: Layout, factors: Sequence[Tensor], squared: Sequence[bool], by: Discounts
) -> Cost:
    *roots, q = factors
    H, H_f, w = (x * x if square else x for x, square in zip(roots, squared, strict=True))
    return discounted(layout, "diagonal", (H, H_f), q, w, by)


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
        ctx.given, ctx.layout, ctx.squared = given, layout, squared
        of_H, of_H_f, of_w, of_q = needed = ctx.needs_input_grad[5:]
        # The rest may change before the gradient is asked for, which does not depend on it.
        counts = zip(factors, needed, (*squared, False), strict=True)
        ctx.save_for_backward(*(x if need and square else None for x, need, square in counts), *by)
        learned = zip(found, (of_H or of_H_f, of_q, of_w), strict=True)
        ctx.mark_non_differentiable(*(x for x, is_learned in learned if not is_learned))
        return tuple(found)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple:  # pyright: ignore[reportIncompatibleMethodOverride]
        # Asked for even where the arrays do: autograd looks whether they have changed since.
        saved, needed = ctx.saved_tensors, ctx.needs_input_grad[5:]
        if is_differentiating() or is_traced([x for x in gradients if x is not None]):
            factors, by = _aliases(saved[:4], needed, ctx.given), Discounts(*saved[4:])
            found = _gradients(factors, gradients, ctx.layout, ctx.squared, by)
        else:
            found = _gradients_by_kernel(needed, gradients, ctx.given, ctx.squared)
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
        np.zeros(shape) if x is None else per_sample.arrays(x)[0]
        for x, shape in zip(gradients, shapes, strict=True)
    )
    found = per_theta.diagonal_cost_gradient(*incoming, *given, *squared)
    of_H, of_q, of_w = (x is not None for x in gradients)
    asked = zip(found, needed, (of_H, of_H, of_w, of_q), strict=True)
    return [torch.from_numpy(x) if need and has else None for x, need, has in asked]


@torch.enable_grad()
def _aliases(
    saved: Sequence[Tensor | None], needed: Sequence[bool], given: Sequence[np.ndarray]
) -> list[Tensor]:
    """The factors, in which alone to differentiate: their own graphs and hooks are autograd's.

    Of what is not saved the values do not count.
    """
    return [
        torch.zeros(like.shape, dtype=torch.float64).requires_grad_(need)
        if x is None
        else x.view_as(x)
        for x, need, like in zip(saved, needed, given, strict=False)
    ]


def _gradients(
    factors: Sequence[Tensor],
    gradients: Sequence[Tensor | None],
    layout: Layout,
    squared: Sequence[bool],
    by: Discounts,
) -> list[Tensor | None]:
    """Of the factors where they require one, and differentiable."""
    with torch.enable_grad():
        found = _by_torch(layout, factors, squared, by)
    pairs = [(x, y) for x, y in zip(found, gradients, strict=True) if y is not None]
    pulled = torch.autograd.grad(
        [x for x, _ in pairs],
        [x for x in factors if x.requires_grad],
        [y for _, y in pairs],
        create_graph=is_differentiating(),
        allow_unused=True,
    )
    rest = iter(pulled)
    return [next(rest) if x.requires_grad else None for x in factors]
