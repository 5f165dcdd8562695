"""Batch dimensions: flattened for the solvers, aligned under vmap, summed in gradients."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor


def flatten(vectors: Tensor, batch: torch.Size) -> Tensor:
    """``(*batch, n)``, or what broadcasts to it, as ``(B, n)``: detached, on the CPU, float64."""
    n = vectors.shape[-1]
    wide = vectors.detach().to("cpu", torch.float64).expand(*batch, n)
    return wide.reshape(batch.numel(), n)


def align(in_dims: tuple, args: tuple, event_ndims: Sequence[int]) -> list[Any]:
    """Move the vmapped dimension of each tensor to the front, and align the batch ranks.

    Args:
        in_dims, args: as a vmap rule gets them.
        event_ndims: trailing dimensions of each tensor that are no batch; arguments beyond these
            are passed on as they are.
    """
    tensors = [
        (i, tensor, dim, n)
        for i, (tensor, dim, n) in enumerate(zip(args, in_dims, event_ndims, strict=False))
        if tensor is not None
    ]
    rank = max(tensor.ndim - n - (dim is not None) for _, tensor, dim, n in tensors)
    out = list(args)
    for i, tensor, dim, n in tensors:
        if dim is not None:
            moved = tensor.movedim(dim, 0)
            missing = rank - (moved.ndim - 1 - n)
            out[i] = moved.reshape(moved.shape[0], *(1,) * missing, *moved.shape[1:])
    return out


def sum_to(tensor: Tensor, like: Tensor) -> Tensor:
    """Sum a batched gradient to the shape of the operand it belongs to."""
    return tensor.sum_to_size(like.shape)


def outer(left: Tensor, right: Tensor, like: Tensor) -> Tensor:
    """The outer products ``left right'`` summed over the batch dimensions that ``like`` lacks."""
    if like.ndim == 2:
        return left.reshape(-1, left.shape[-1]).mT @ right.reshape(-1, right.shape[-1])
    return sum_to(left.unsqueeze(-1) * right.unsqueeze(-2), like)
