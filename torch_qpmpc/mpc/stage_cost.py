"""A convex quadratic stage cost from observed costs, by least squares."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from torch_qpmpc.errors import QPError
from torch_qpmpc.mpc.log import LARGEST
from torch_qpmpc.mpc.ridge import ridge

#: Strengths of the ridge, down to those of costs without noise, and the share of the evidence's
#: that is used: enough for collinear columns, and too little to bias others.
STRENGTHS, SHARE = 10.0 ** torch.arange(-32, 0.1, 0.25, dtype=torch.float64), 1e-3
#: The error, relative to the terms of a row, of a cost that is quadratic up to rounding.
EXACT = 1e-6
#: The error that the nearest positive semidefinite W may add.
HARMLESS = 1e-6
#: The ridge on changes to a positive semidefinite W, relative to the mean square of a column.
RIDGE = 1e-6
#: L-BFGS: the smallest eigenvalue that it starts from, its tolerance and its iterations.
FLOOR, TOLERANCE, ITERATIONS = 1e-2, 1e-9, 500


@dataclass(frozen=True, eq=False)
class StageCost:
    """``1/2 v'Wv + q'v + c`` of v = [d; x; u], which unpacks as W ``(n, n)``, q ``(n,)``, c ``()``.

    Attributes:
        W, q, c: the cost.
        R2: the share of the observed costs' variance that it explains, adjusted for the number of
            its coefficients; NaN if there are not more observations than coefficients.
    """

    W: Tensor
    q: Tensor
    c: Tensor
    R2: float = torch.nan

    def __iter__(self) -> Iterator[Tensor]:
        return iter((self.W, self.q, self.c))

    def __call__(self, v: Tensor) -> Tensor:
        """Return the costs ``(*batch,)`` of v ``(*batch, n)``."""
        return (v @ self.W * v).sum(-1) / 2 + v @ self.q + self.c


class _Observed(NamedTuple):
    """Costs ``(m,)`` at x ``(m, n)``, and the entries of W: rows, columns, and which are free."""

    x: Tensor
    cost: Tensor
    rows: Tensor
    columns: Tensor
    free: Tensor
    n_free: int

    def features(self, which: Tensor | None = None) -> Tensor:
        """Return the derivatives of the cost in q and the entries of W, all or ``which``."""
        rows, columns = self.rows, self.columns
        if which is not None:
            rows, columns = rows[which], columns[which]
        products = self.x[:, rows] * self.x[:, columns]
        return torch.cat((self.x, products * torch.where(rows == columns, 0.5, 1.0)), dim=-1)

    def matrix(self, entries: Tensor) -> Tensor:
        """Return W from its entries."""
        n = self.x.shape[1]
        W = self.x.new_zeros(n, n)
        W[self.rows, self.columns] = W[self.columns, self.rows] = entries
        return W

    def convex(self, W: Tensor) -> Tensor:
        """Return the block of W that has to be positive semidefinite."""
        return W[self.n_free :, self.n_free :]


def fit_stage_cost(v: Tensor, cost: Tensor, n_free: int = 0, diagonal: bool = False) -> StageCost:
    """Fit a stage cost whose W is positive semidefinite, except in its first rows and columns.

    It is ridge regression about a typical v, in units in which columns have unit variance. The
    strength is a thousandth of the evidence's (`ridge`), and vanishes for a cost without noise; of
    collinear columns it takes the smallest coefficients. A W that is not positive semidefinite is
    replaced by the best one that is. The rows and columns of the first ``n_free`` entries of v
    ``(m, n)``, such as d, have any sign; they are zero in a ``diagonal`` W. ``cost`` is ``(m,)``.

    Raises:
        QPError: there are no rows, or entries that are not finite or too large.
    """
    for name, value in (("v", v), ("cost", cost)):
        if not len(v) or not value.isfinite().all() or value.abs().amax() > LARGEST:
            got = f"{value.abs().amax().item():.3g}" if len(v) else "no rows"
            remedy = "Squares of larger numbers overflow: choose larger units."
            expected = f"finite numbers up to {LARGEST:g}"
            raise QPError.expected(name, got, expected, remedy)
    v, cost = v.detach().double(), cost.detach().double()
    n = v.shape[1]
    middle, size = _middle(v), v.std(0, correction=0)
    scale = torch.where(size > 1e-12 * v.abs().amax(0), 1 / size, 0.0)
    unit = cost.abs().amax().clamp(min=torch.finfo(cost.dtype).tiny)
    rows, columns = torch.triu_indices(n, n)
    # A diagonal W has no entries of d.
    kept = (rows == columns) & (rows >= n_free) if diagonal else rows >= 0
    rows, columns = rows[kept], columns[kept]
    seen = _Observed((v - middle) * scale, cost / unit, rows, columns, rows < n_free, n_free)
    W, q, c = _fit(seen)
    W, q, c = unit * W * scale * scale.unsqueeze(-1), unit * q * scale, unit * c
    fitted = StageCost(W, q - W @ middle, c - q @ middle + middle @ W @ middle / 2)
    R2 = _adjusted_R2(cost, cost - fitted(v), 1 + n + len(rows))
    return StageCost(fitted.W, fitted.q, fitted.c, R2)


def _middle(v: Tensor) -> Tensor:
    """Return the row nearest to the median, where the linear relations of columns hold."""
    distance = (v - v.median(0).values).abs()
    size = distance.median(0).values
    return v[(distance / torch.where(size > 0, size, 1.0)).square().sum(1).argmin()]


def _adjusted_R2(cost: Tensor, error: Tensor, coefficients: int) -> float:
    spread, m = (cost - cost.mean()).square().sum(), len(cost)
    if m <= coefficients:
        return torch.nan
    if spread.sqrt() <= 1e-12 * cost.norm():
        return 1.0  # of a constant cost
    return (1 - error.square().sum() / spread * (m - 1) / (m - coefficients)).item()


def _fit(seen: _Observed) -> tuple[Tensor, Tensor, Tensor]:
    """Return W, q and c in the units of ``seen``."""
    n, X = seen.x.shape[1], seen.features()
    w, c = _regression(X, seen.cost)
    weights = torch.ones_like(seen.cost)
    # The rounding of a row is relative to its terms: without more noise, so are their weights.
    terms = X.abs() @ w.abs() + c.abs()
    if (terms > 0).all():
        exact = _regression(X, seen.cost, 1 / terms)
        if ((seen.cost - X @ exact[0] - exact[1]).abs() <= EXACT * terms).all():
            weights, (w, c) = 1 / terms, exact
    W, q = seen.matrix(w[n:]), w[:n]
    block = seen.convex(W)
    nearest = _nearest(block)
    if torch.equal(nearest, block):
        return W, q, c
    before = _error(seen, W, q, c, weights)
    W, q, c = _completed(seen, nearest, weights)
    if _error(seen, W, q, c, weights) <= (1 + HARMLESS) * before + HARMLESS * EXACT:
        return W, q, c
    weights = torch.ones_like(weights)
    return _completed(seen, _best_convex(seen, block), weights)


def _error(seen: _Observed, W: Tensor, q: Tensor, c: Tensor, weights: Tensor) -> Tensor:
    """Return the root mean square of the weighted errors."""
    return ((StageCost(W, q, c)(seen.x) - seen.cost) * weights).square().mean().sqrt()


def _regression(X: Tensor, y: Tensor, weights: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Return w and c of y ~ X w + c, rows weighted, with the evidence's ridge on w."""
    square = torch.ones_like(y) if weights is None else weights.square()
    share = square / square.sum()
    middle, mean = share @ X, share @ y
    root = share.sqrt().unsqueeze(-1)
    X, y = root * (X - middle), root * (y - mean).unsqueeze(-1)
    w = ridge(X, y, strengths=STRENGTHS, share=SHARE)[:, 0]
    return w, mean - middle @ w


def _completed(seen: _Observed, block: Tensor, weights: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return W with the convex ``block``, and the best q, c and other entries of W."""
    n, n_free = seen.x.shape[1], seen.n_free
    x = seen.x[:, n_free:]
    rest = seen.cost - (x @ block * x).sum(-1) / 2
    w, c = _regression(seen.features(seen.free), rest, weights)
    entries = w.new_zeros(len(seen.rows))
    entries[seen.free] = w[n:]
    W = seen.matrix(entries)
    W[n_free:, n_free:] = block
    return W, w[:n], c


def _nearest(W: Tensor) -> Tensor:
    """Return W if it is positive semidefinite, else the nearest matrix in units of its entries."""
    size = W.diagonal().clamp(min=0).sqrt()
    size = size.clamp(min=1e-8 * W.abs().amax().sqrt())
    if not (size > 0).all():
        return W
    eigenvalues, vectors = torch.linalg.eigh(W / size / size.unsqueeze(-1))
    if eigenvalues[0] >= -torch.finfo(W.dtype).eps * len(W) * eigenvalues[-1].abs():
        return W
    return (vectors * eigenvalues.clamp(min=0)) @ vectors.mT * size * size.unsqueeze(-1)


def _best_convex(seen: _Observed, block: Tensor) -> Tensor:
    """Return the positive semidefinite block that costs least in place of the best ``block``."""
    rows, columns = seen.rows[~seen.free] - seen.n_free, seen.columns[~seen.free] - seen.n_free
    kept = seen.convex(seen.matrix((~seen.free).to(block)))
    F = _profiled(seen)
    F = F / (F @ (_nearest(block) - block)[rows, columns]).norm()
    T = _whitening(seen) if kept.all() else torch.eye(len(block)).to(block)
    eigenvalues, vectors = torch.linalg.eigh(torch.linalg.solve(T, torch.linalg.solve(T, block).mT))
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

    def closure() -> Tensor:
        optimizer.zero_grad()
        loss = (F @ (T @ root @ root.mT @ T.mT - block)[rows, columns]).square().sum() / 2
        loss.backward()
        return loss

    with torch.enable_grad():
        optimizer.step(closure)
    return (T @ root @ root.mT @ T.mT * kept).detach()


def _whitening(seen: _Observed) -> Tensor:
    """Return T such that T'x has uncorrelated entries, with rows weighted as in x's products."""
    x = seen.x[:, seen.n_free :]
    x = x * x.norm(dim=1, keepdim=True)
    s, V = torch.linalg.eigh(x.mT @ x)
    return V / s.clamp(min=1e-12 * s[-1]).sqrt()


def _profiled(seen: _Observed) -> Tensor:
    """Return F of the error ``|F w|^2`` of changes w of W's block, if all else is optimal.

    It is triangular, and contains a small ridge.
    """
    n = seen.x.shape[1]
    others = torch.cat((seen.features(seen.free), torch.ones_like(seen.cost).unsqueeze(-1)), -1)
    F = seen.features(~seen.free)[:, n:]
    size = others.norm(dim=0)
    others = others / torch.where(size > 0, size, 1.0)
    F = F - others @ torch.linalg.lstsq(others, F, driver="gelsd").solution
    pull = torch.diag(RIDGE**0.5 * F.norm(dim=0))
    return torch.linalg.qr(torch.cat((F, pull)), mode="r")[1]
