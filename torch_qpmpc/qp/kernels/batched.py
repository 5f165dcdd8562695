"""Batched linear algebra in torch, on the device of its tensors: products, and held rows."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor


def multiply(matrices: Tensor, group: Tensor, vectors: Tensor) -> Tensor:
    """Multiply each of ``(B or 1, j)`` by its group's matrix of ``(M, i, j)``, to ``(B, i)``."""
    if matrices.shape[0] == 1:
        return F.linear(vectors, matrices[0])
    vectors = vectors.expand(len(group), -1)
    return torch.bmm(matrices[group], vectors.unsqueeze(-1)).squeeze(-1)


def largest(x: Tensor, *, keepdim: bool = False) -> Tensor:
    """Return the largest absolute entry along the last dimension; zero if that is empty."""
    if x.shape[-1]:
        # vector_norm is one operation, but several times slower for a large batch.
        return x.abs().amax(-1, keepdim=keepdim)
    return x.new_zeros((*x.shape[:-1], 1) if keepdim else x.shape[:-1])


def null_space_inverses(
    H: Tensor, A: Tensor, singular: float, flat: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Return pseudo-inverses of A ``(B, k, d)``, and of H ``(B, d, d)`` on its null space.

    With them ``z = A^+ b + H^+ (a - H A^+ b)`` and ``t = A^+'(a - H z)`` are the solution of least
    norm of ``H z + A't = a, A z = b``. By the singular value decomposition of A, errors grow with
    its condition number; that of the KKT matrix is its square. Rows are dependent below the
    singular value ``singular``, relative to the largest, and H has no curvature below ``flat``,
    relative to its largest entry.

    Returns:
        The two, and the rank of A, ``(B,)``.
    """
    left, sizes, right = torch.linalg.svd(A, full_matrices=True)
    k, kept = sizes.shape[-1], sizes > singular * largest(sizes, keepdim=True)
    share = (kept / sizes.where(kept, 1)).unsqueeze(-2)
    inverse = (right[:, :k].mT * share) @ left[:, :, :k].mT
    null = right.masked_fill(F.pad(kept, (0, A.shape[-1] - k)).unsqueeze(-1), 0)
    least = flat * largest(H.flatten(1))
    of_H = torch.linalg.pinv(null @ H @ null.mT, atol=least, rtol=0 * least, hermitian=True)
    return inverse, null.mT @ of_H @ null, kept.sum(-1)


def hold(to_lam, group, vy, held, level) -> tuple[Tensor, Tensor]:
    """Return v and y with the ``held`` rows at their levels, and their multipliers."""
    d, t = vy.shape[-1] - held.shape[-1], torch.zeros_like(level)
    order, real = _order(held)
    factor = _factor_held(to_lam[:, :, d:], group, order, real)
    order = order * real
    short = (vy[:, d:].gather(1, order) - level.gather(1, order)).masked_fill_(~real, 0)
    change = torch.cholesky_solve(short.unsqueeze(-1), factor).squeeze(-1)
    t = t.scatter_add_(1, order, change)
    return vy - multiply(to_lam.mT, group, t), t


def _order(held: Tensor) -> tuple[Tensor, Tensor]:
    """Return the indices of the held rows, padded with r, and the mask of real ones, ``(B, k)``.

    k is the largest number of held rows in a QP.
    """
    n_qps, r = held.shape
    position = held.cumsum(-1)
    k = int(position[:, -1].max()) if held.numel() else 0
    order = torch.full((n_qps, k + 1), r, device=held.device)
    # Rows that are not held are written to an extra last column.
    index = torch.arange(r, device=held.device).expand(n_qps, r)
    order.scatter_(1, torch.where(held, position - 1, k), index)
    return order[:, :k], torch.arange(k, device=held.device) < position[:, -1:]


def _factor_held(K: Tensor, group: Tensor, order: Tensor, real: Tensor) -> Tensor:
    """Return the factor of K's rows and columns ``order`` ``(B, k)``; padding is an identity."""
    K = F.pad(K, (0, 1, 0, 1))  # for the padding
    n = K.shape[-1]
    index = order.unsqueeze(-1) * n + order.unsqueeze(-2)
    if len(K) > 1:
        index += (group * n * n)[:, None, None]
    K = torch.take(K, index)
    K.diagonal(dim1=-2, dim2=-1).add_(~real)
    return torch.linalg.cholesky_ex(K).L
