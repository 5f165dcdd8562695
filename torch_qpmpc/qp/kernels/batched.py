"""Batched linear algebra in torch, on the device of its tensors."""

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


def null_space(A: Tensor, singular: float) -> tuple[Tensor, Tensor, Tensor]:
    """Return the pseudo-inverse of A ``(B, k, d)``, its null space, and its rank, ``(B,)``.

    The null space has an orthonormal basis of rows, ``(B, d, d)``, after as many rows of zeros as
    the rank. Rows of A are dependent below the singular value ``singular``, relative to the
    largest.
    """
    left, sizes, right = torch.linalg.svd(A, full_matrices=True)
    k, kept = sizes.shape[-1], sizes > singular * largest(sizes, keepdim=True)
    share = (kept / sizes.where(kept, 1)).unsqueeze(-2)
    inverse = (right[:, :k].mT * share) @ left[:, :, :k].mT
    null = right.masked_fill(F.pad(kept, (0, A.shape[-1] - k)).unsqueeze(-1), 0)
    return inverse, null, kept.sum(-1)


def null_space_inverses(
    H: Tensor, A: Tensor, singular: float, flat: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Return pseudo-inverses of A ``(B, k, d)``, and of H ``(B, d, d)`` on its null space.

    With them ``z = A^+ b + H^+ (a - H A^+ b)`` and ``t = A^+'(a - H z)`` are the solution of least
    norm of ``H z + A't = a, A z = b``. Errors grow with A's condition number; that of the KKT
    matrix is its square. H has no curvature below ``flat``, relative to its largest entry.

    Returns:
        The two, and the rank of A, ``(B,)``.
    """
    inverse, null, rank = null_space(A, singular)
    least = flat * largest(H.flatten(1))
    of_H = torch.linalg.pinv(null @ H @ null.mT, atol=least, rtol=0 * least, hermitian=True)
    return inverse, null.mT @ of_H @ null, rank
