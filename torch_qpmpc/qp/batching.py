"""Batch dimensions: alignment under vmap, products, sums in gradients."""

import math
from collections.abc import Sequence
from typing import Any

from torch import Tensor


def align(in_dims: tuple, args: tuple, event_ndims: Sequence[int]) -> list[Any]:
    """Move the vmapped dimension of each tensor of a vmap rule to the front, and align batch ranks.

    Arguments beyond those with ``event_ndims`` event dimensions are returned unchanged.
    """
    known = list(zip(args, in_dims, event_ndims, strict=False))
    rank = max(x.ndim - n - (dim is not None) for x, dim, n in known if x is not None)
    out = list(args)
    for i, (x, dim, n) in enumerate(known):
        if dim is not None:
            moved = x.movedim(dim, 0)
            missing = rank - (moved.ndim - 1 - n)
            out[i] = moved.reshape(moved.shape[0], *(1,) * missing, *moved.shape[1:])
    return out


def weighted_sum(weight: Tensor, vectors: Tensor, like: Tensor) -> Tensor:
    """Sum ``weight`` ``(*batch,)`` times ``(*batch, n)`` over the dimensions ``like`` lacks."""
    if like.ndim == 1:
        return weight.reshape(-1) @ flatten_batch(vectors)
    return (weight.unsqueeze(-1) * vectors).sum_to_size(like.shape)


def outer(left: Tensor, right: Tensor, like: Tensor) -> Tensor:
    """Sum the outer products ``left right'`` over the batch dimensions ``like`` lacks."""
    if like.ndim == 2:
        return flatten_batch(left).mT @ flatten_batch(right)
    return (left.unsqueeze(-1) * right.unsqueeze(-2)).sum_to_size(like.shape)


def times(matrix: Tensor, vector: Tensor) -> Tensor:
    """Multiply ``(*batch, i, j)`` by ``(*batch, j)`` to ``(*batch, i)``, broadcasting."""
    return (vector.unsqueeze(-2) @ matrix.mT).squeeze(-2)


def flatten_batch(vectors: Tensor) -> Tensor:
    """Flatten ``(*batch, n)`` to ``(B, n)``, also for n = 0, where -1 would be ambiguous."""
    return vectors.reshape(math.prod(vectors.shape[:-1]), vectors.shape[-1])


def schema(tensors: Sequence[str], others: str, n_outputs: int) -> str:
    """Return the schema of a custom operator with arguments of these names, and tensors back."""
    inputs = ", ".join(f"Tensor {name}" for name in tensors)
    return f"({inputs}, {others}) -> ({', '.join(['Tensor'] * n_outputs)})"
