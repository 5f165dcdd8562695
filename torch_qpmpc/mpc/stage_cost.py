"""A convex quadratic stage cost from observed costs, by least squares."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

#: A ridge, relative to the mean square of the products in v, that makes W unique.
RIDGE = 1e-6
#: L-BFGS: the smallest eigenvalue that it starts from, its tolerance and its iterations.
FLOOR, TOLERANCE, ITERATIONS = 1e-2, 1e-9, 500


class StageCost(NamedTuple):
    """``1/2 v'Wv + q'v + c`` of v = [d; x; u]: W ``(n, n)``, q ``(n,)`` and c ``()``."""

    W: Tensor
    q: Tensor
    c: Tensor


def fit_stage_cost(v: Tensor, cost: Tensor, n_free: int = 0, diagonal: bool = False) -> StageCost:
    """Fit a stage cost whose W is positive semidefinite, except in its first rows and columns.

    The problem is convex. It is solved for a square root of W's other block, in units in which v
    has zero mean and unit variance; all else follows by linear least squares.

    Args:
        v: the arguments of the cost, ``(m, n)``.
        cost: the observed costs, ``(m,)``.
        n_free: the number of first entries of v, such as those of d, whose rows and columns of W
            have any sign; they are zero in a diagonal W.
        diagonal: fit a diagonal W.
    """
    m, n = v.shape
    middle, size = v.mean(0), v.std(0, correction=0)
    scale = torch.where(size > 1e-12 * middle.abs(), 1 / size, 0.0)
    x = (v - middle) * scale
    rows, columns = torch.triu_indices(n, n)
    products = x[:, rows] * x[:, columns] * torch.where(rows == columns, 0.5, 1.0)
    free = (rows < n_free) & (not diagonal)
    convex = (rows >= n_free) & ((rows == columns) | (not diagonal))
    linear = torch.cat((x, torch.ones(m, 1).to(x), products[:, free]), dim=-1)
    both = torch.cat((products[:, convex], cost.unsqueeze(-1)), dim=-1)
    both = both - linear @ _least_squares(linear, both)
    features, unit = both[:, :-1], both[:, -1].square().mean().sqrt()
    W = x.new_zeros(n, n)
    if unit > 0:
        target = both[:, -1] / unit
        entries = rows[convex] - n_free, columns[convex] - n_free
        gram = features.mT @ features / m, features.mT @ target / m
        W[n_free:, n_free:] = unit * _convex(*gram, *entries, n - n_free)
    rest = cost - (x @ W * x).sum(-1) / 2
    q, c, others = _least_squares(linear, rest.unsqueeze(-1)).flatten().split((n, 1, sum(free)))
    W[rows[free], columns[free]] = W[columns[free], rows[free]] = others
    W, q = scale.unsqueeze(-1) * W * scale, scale * q
    return StageCost(W, q - W @ middle, c[0] - q @ middle + middle @ W @ middle / 2)


def _least_squares(X: Tensor, Y: Tensor) -> Tensor:
    """Return the solution of smallest norm."""
    return torch.linalg.lstsq(X, Y, driver="gelsd").solution


def _convex(gram: Tensor, target: Tensor, rows: Tensor, columns: Tensor, n: int) -> Tensor:
    """Minimise ``1/2 w'gram w - target'w`` over W >= 0 with entries w at (rows, columns)."""
    gram = gram + RIDGE * gram.diagonal().mean() * torch.eye(len(gram)).to(gram)
    W = gram.new_zeros(n, n)
    W[rows, columns] = W[columns, rows] = torch.linalg.solve(gram, target)
    eigenvalues, vectors = torch.linalg.eigh(W)
    if eigenvalues[0] >= 0:
        return W
    # Not at a root of zero, where the gradient is zero.
    start = eigenvalues.clamp(min=FLOOR * eigenvalues.abs().amax()).sqrt()
    root = (vectors * start).contiguous().requires_grad_()
    optimizer = torch.optim.LBFGS(
        [root],
        max_iter=ITERATIONS,
        tolerance_grad=TOLERANCE,
        tolerance_change=0.0,
        history_size=50,
        line_search_fn="strong_wolfe",
    )
    kept = torch.zeros(n, n).to(W).index_put((rows, columns), torch.ones(len(rows)).to(W))
    kept = torch.maximum(kept, kept.mT)

    def closure() -> Tensor:
        optimizer.zero_grad()
        w = (root @ root.mT)[rows, columns]
        loss = w @ gram @ w / 2 - target @ w
        loss.backward()
        return loss

    with torch.enable_grad():
        optimizer.step(closure)
    return (root @ root.mT * kept).detach()
