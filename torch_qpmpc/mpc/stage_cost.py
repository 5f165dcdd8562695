"""A convex quadratic stage cost from observed costs, by least squares."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from torch_qpmpc.mpc.projections import nearest_psd

#: ADMM ends when an iteration changes the weight by less, relatively, or after so many iterations.
TOLERANCE, ITERATIONS = 1e-11, 20_000
#: A ridge, relative to the largest eigenvalue, that makes the weight unique.
RIDGE = 1e-9


class StageCost(NamedTuple):
    """``1/2 v'Wv + q'v + c`` of v = [d; x; u]: W ``(n, n)``, q ``(n,)`` and c ``()``."""

    W: Tensor
    q: Tensor
    c: Tensor


def fit_stage_cost(v: Tensor, cost: Tensor, n_free: int = 0, diagonal: bool = False) -> StageCost:
    """Fit a stage cost whose W is positive semidefinite, except in its first rows and columns.

    The problem is convex. ADMM alternates between its normal equations and the projection of W,
    in units in which v has zero mean and unit variance.

    Args:
        v: the arguments of the cost, ``(m, n)``.
        cost: the observed costs, ``(m,)``.
        n_free: the number of first entries of v, such as those of d, whose rows and columns of W
            have any sign; they are zero in a diagonal W.
        diagonal: fit a diagonal W.
    """
    n = v.shape[-1]
    middle, size = v.mean(0), v.std(0, correction=0)
    scale = torch.where(size > 1e-12 * middle.abs(), 1 / size, 0.0)
    x = (v - middle) * scale
    if diagonal:
        rows = columns = torch.arange(n_free, n)
    else:
        rows, columns = torch.triu_indices(n, n)
    # sqrt(2) W_ij off the diagonal: the norm of these entries is the Frobenius norm of W.
    weight = torch.where(rows == columns, 1.0, 2**0.5).to(v)

    def matrix(entries: Tensor) -> Tensor:
        W = entries.new_zeros(n, n)
        W[rows, columns] = W[columns, rows] = entries / weight
        return W

    def projected(entries: Tensor) -> Tensor:
        W = matrix(entries)
        W[n_free:, n_free:] = nearest_psd(W[n_free:, n_free:])
        return W[rows, columns] * weight

    quadratic = x[:, rows] * x[:, columns] * weight / 2
    linear = torch.cat((x, torch.ones_like(x[:, :1])), dim=-1)
    both = torch.cat((quadratic, cost.unsqueeze(-1)), dim=-1)
    both = both - linear @ _least_squares(linear, both)
    features, target = both[:, :-1], both[:, -1]
    entries = _admm(features.mT @ features / len(v), features.mT @ target / len(v), projected)
    rest = _least_squares(linear, (cost - quadratic @ entries).unsqueeze(-1)).flatten()
    W, q, c = scale.unsqueeze(-1) * matrix(entries) * scale, scale * rest[:-1], rest[-1]
    return StageCost(W, q - W @ middle, c - q @ middle + middle @ W @ middle / 2)


def _least_squares(X: Tensor, Y: Tensor) -> Tensor:
    """Return the solution of smallest norm."""
    return torch.linalg.lstsq(X, Y, driver="gelsd").solution


def _admm(gram: Tensor, target: Tensor, projected: Callable[[Tensor], Tensor]) -> Tensor:
    """Minimise ``1/2 w'gram w - target'w`` over a convex cone, by its projection."""
    largest = torch.linalg.eigvalsh(gram)[-1].clamp(min=torch.finfo(gram.dtype).tiny)
    rho = gram.diagonal().mean().clamp(min=RIDGE * largest)
    inverse = torch.linalg.inv(gram + (RIDGE * largest + rho) * torch.eye(len(gram)).to(gram))
    z, dual = torch.zeros_like(target), torch.zeros_like(target)
    for _ in range(ITERATIONS):
        w = inverse @ (target + rho * (z - dual))
        last, z = z, projected(w + dual)
        dual = dual + w - z
        change = torch.maximum((z - last).abs().amax(), (w - z).abs().amax())
        if change <= TOLERANCE * z.abs().amax():
            break
    return z
