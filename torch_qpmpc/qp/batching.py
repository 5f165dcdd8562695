"""Batch dimensions: flattened, reduced, aligned under vmap, summed in gradients."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor


def broadcast(*shapes: Sequence[int]) -> torch.Size:
    """`torch.broadcast_shapes`, at once where there is nothing to broadcast."""
    common: Sequence[int] = ()
    for shape in filter(len, shapes):
        if len(common) and tuple(shape) != tuple(common):
            return torch.broadcast_shapes(*shapes)
        common = shape
    return torch.Size(common)


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


def weighted_sum(weight: Tensor, vectors: Tensor, like: Tensor) -> Tensor:
    """``weight`` ``(*batch,)`` times ``(*batch, n)``, summed over the dimensions ``like`` lacks."""
    if like.ndim == 1:
        return weight.reshape(-1) @ listed(vectors)
    return sum_to(weight.unsqueeze(-1) * vectors, like)


def outer(left: Tensor, right: Tensor, like: Tensor) -> Tensor:
    """The outer products ``left right'`` summed over the batch dimensions that ``like`` lacks."""
    if like.ndim == 2:
        return listed(left).mT @ listed(right)
    return sum_to(left.unsqueeze(-1) * right.unsqueeze(-2), like)


def multiply(matrices: Tensor, group: Tensor, vectors: Tensor) -> Tensor:
    """Multiply ``(M, i, j)`` by ``(B or 1, j)`` to ``(B, i)``, by the matrix ``group`` of each."""
    if matrices.shape[0] == 1:
        return F.linear(vectors, matrices[0])
    vectors = vectors.expand(len(group), -1)
    return torch.bmm(matrices[group], vectors.unsqueeze(-1)).squeeze(-1)


def times(matrix: Tensor, vector: Tensor) -> Tensor:
    """Multiply ``(*batch, i, j)`` by ``(*batch, j)`` to ``(*batch, i)``, broadcasting."""
    return (vector.unsqueeze(-2) @ matrix.mT).squeeze(-2)


def listed(vectors: Tensor) -> Tensor:
    """``(*batch, n)`` as ``(B, n)``; with n = 0 too, where -1 could be any size."""
    return vectors.reshape(math.prod(vectors.shape[:-1]), vectors.shape[-1])


def largest(x: Tensor, *, keepdim: bool = False) -> Tensor:
    """Largest absolute entry along the last dimension; zero where that is empty."""
    if x.shape[-1]:
        # vector_norm is one operation, but takes several times as long for a large batch.
        return x.abs().amax(-1, keepdim=keepdim)
    return x.new_zeros((*x.shape[:-1], 1) if keepdim else x.shape[:-1])
