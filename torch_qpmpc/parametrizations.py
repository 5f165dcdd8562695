"""Keep H positive semidefinite while it is learned, in the idiom of `torch.nn.utils.parametrize`.

With H = L L' any gradient step on L leaves H positive semidefinite, so that the update of eq:thup
needs no semidefinite program (eq:sdp1).
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from torch_qpmpc.errors import QPError


class SquareRoot(nn.Module):
    """The Cholesky factor of a diagonal: non-negative entries ``h = l * l``, any shape.

    An entry that starts at exactly zero stays there, as its gradient is zero: the paper's
    diag(theta_1, .., theta_4, 0, 0) keeps its zero action weights.
    """

    def forward(self, factor: Tensor) -> Tensor:
        return factor * factor

    def right_inverse(self, value: Tensor) -> Tensor:
        """A factor of ``value``; `QPError` if an entry is negative."""
        if (value < 0).any():
            raise QPError.expected("diagonal", f"{value.min():.3g}", "non-negative entries")
        return value.sqrt()


class Cholesky(nn.Module):
    """Positive semidefinite matrices ``H = L L'`` from lower triangular L, ``(*batch, n, n)``."""

    def forward(self, factor: Tensor) -> Tensor:
        lower = factor.tril()
        return lower @ lower.mT

    def right_inverse(self, value: Tensor) -> Tensor:
        """A lower triangular factor of a possibly singular ``value``.

        By a QR factorisation of the symmetric square root, as the usual Cholesky algorithm needs
        a positive definite matrix. `QPError` if ``value`` is not positive semidefinite.
        """
        eigenvalues, vectors = torch.linalg.eigh((value + value.mT) / 2)
        tolerance = 1e-5 if value.dtype == torch.float32 else 1e-9
        if (eigenvalues < -tolerance * eigenvalues.abs().amax(-1, keepdim=True)).any():
            raise QPError.expected(
                "H",
                f"smallest eigenvalue {eigenvalues.min():.3g}",
                "a positive semidefinite matrix",
            )
        root = vectors * eigenvalues.clamp(min=0).sqrt().unsqueeze(-2)
        upper = torch.linalg.qr(root.mT).R
        sign = torch.where(upper.diagonal(dim1=-2, dim2=-1) < 0, -1.0, 1.0)
        return upper.mT * sign.unsqueeze(-2)
