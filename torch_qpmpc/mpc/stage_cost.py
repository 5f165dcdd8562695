"""A convex quadratic stage cost from observed costs, by least squares."""

import math
import warnings
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torch_qpmpc.checks import ungraded
from torch_qpmpc.errors import QPError
from torch_qpmpc.identification.innovations import Innovations
from torch_qpmpc.identification.log import LARGEST
from torch_qpmpc.identification.ridge import ridge
from torch_qpmpc.identification.steps import MEASURED, NEXT, logs, valid_steps
from torch_qpmpc.mpc.cost import REMEDY, Cost
from torch_qpmpc.mpc.layout import Layout

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
    """``1/2 v'Wv + q'v + c`` of v = [d; x; u]."""

    #: ``(n, n)``, ``(n,)`` and ``()``.
    W: Tensor
    q: Tensor
    c: Tensor
    #: The share of the observed costs' variance that it explains, adjusted for the number of its
    #: coefficients; NaN if there are not more observations than coefficients.
    R2: float = torch.nan

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


def fit_stage_cost(v: Tensor, cost: Tensor, n_free: int = 0, diagonal: bool = False) -> StageCost:
    """Fit a stage cost whose W is positive semidefinite, except in its first rows and columns.

    It is ridge regression about a typical v, in units in which columns have unit variance, with a
    thousandth of the evidence's strength (`ridge`). A W that is not positive semidefinite is
    replaced by the best one that is. The rows and columns of the first ``n_free`` entries of v
    ``(m, n)``, such as d, have any sign; they are zero in a ``diagonal`` W. ``cost`` is ``(m,)``.
    """
    v, cost = v.detach().double(), cost.detach().double()
    n = v.shape[1]
    distance = (v - v.median(0).values).abs()
    typical = distance.median(0).values
    # The row nearest to the median, where the linear relations of columns hold.
    middle = v[(distance / torch.where(typical > 0, typical, 1.0)).square().sum(1).argmin()]
    size = v.std(0, correction=0)
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
    return replace(fitted, R2=_adjusted_R2(cost, cost - fitted(v), 1 + n + len(rows)))


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
    block = W[seen.n_free :, seen.n_free :]  # it has to be positive semidefinite
    nearest = _nearest(block)
    if torch.equal(nearest, block):
        return W, q, c
    before = _error(seen, W, q, c, weights)
    W, q, c = _completed(seen, nearest, weights)
    if _error(seen, W, q, c, weights) <= (1 + HARMLESS) * before + HARMLESS * EXACT:
        return W, q, c
    return _completed(seen, _best_convex(seen, block), torch.ones_like(weights))


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
    kept = seen.matrix((~seen.free).to(block))[seen.n_free :, seen.n_free :]
    F = _profiled(seen)
    F = F / (F @ (_nearest(block) - block)[rows, columns]).norm()
    T = torch.eye(len(block)).to(block)
    if kept.all():  # such that T'x has uncorrelated entries, with rows weighted as in x's products
        x = seen.x[:, seen.n_free :]
        x = x * x.norm(dim=1, keepdim=True)
        s, V = torch.linalg.eigh(x.mT @ x)
        T = V / s.clamp(min=1e-12 * s[-1]).sqrt()
    eigenvalues, vectors = torch.linalg.eigh(torch.linalg.solve(T, torch.linalg.solve(T, block).mT))
    # Not at a root of zero, where the gradient is zero.
    start = eigenvalues.clamp(min=FLOOR * eigenvalues.abs().amax()).sqrt()
    root = (vectors * start).contiguous().requires_grad_()
    ends: Any = {"max_iter": ITERATIONS, "tolerance_grad": TOLERANCE, "tolerance_change": 0.0}
    optimizer = torch.optim.LBFGS([root], **ends, history_size=50, line_search_fn="strong_wolfe")

    def closure() -> Tensor:
        optimizer.zero_grad()
        loss = (F @ (T @ root @ root.mT @ T.mT - block)[rows, columns]).square().sum() / 2
        loss.backward()
        return loss

    with torch.enable_grad():
        optimizer.step(closure)
    return (T @ root @ root.mT @ T.mT * kept).detach()


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


#: The least R2 without a warning; and the share of the unexplained variance that a cost of the next
#: state or outputs may leave.
GOOD, LEFT = 0.9, 0.5


def fit_rewards(
    log: Any, layout: Layout, diagonal: bool = False, model: Innovations | None = None
) -> StageCost:
    """Fit the stage cost of (d_k, x_k, u_k) to the rewards of a log, as `fit_stage_cost`.

    Many plants reward the next state or its outputs. With a ``model`` costs of (x_{k+1}, u_k) and,
    where each log has the outputs of its estimates, (y_{k+1}, u_k) are fitted, too: one that leaves
    less than half of the variance unexplained is returned as the cost of (x_k, u_k) that the model
    makes of it, but not for a ``diagonal`` W or with known signals. An R2 below 0.9 is warned of.

    Raises:
        QPError: a log lacks finite rewards, or there is no step.
    """
    *parts, measured = zip(*(_observed(steps, layout) for steps in logs(log)), strict=True)
    x, u, following, cost = map(torch.cat, parts)
    if not len(cost):
        raise _unfitted("a log without steps")
    fitted = fit_stage_cost(torch.cat((x, u), -1), cost, layout.n_d, diagonal)
    if model is not None and not diagonal and not layout.n_d:
        L, S, C = map(torch.tensor, (model.L, model.S, model.C))
        nexts = [(following, torch.eye(layout.n_x).to(C), L @ S @ L.mT)]
        if {outputs.shape[1] for outputs in measured} == {len(C)}:
            nexts.append((torch.cat(measured), C, S))
        for following, C, noise in nexts:
            after = fit_stage_cost(torch.cat((following, u), -1), cost)
            if 1 - after.R2 < LEFT * (1 - fitted.R2):
                fitted = _before(after, model, C, noise)
    if not fitted.R2 >= GOOD:
        warnings.warn(poor(fitted.R2), UserWarning, stacklevel=2)
    return fitted


def _before(after: StageCost, model: Innovations, C: Tensor, noise: Tensor) -> StageCost:
    """Return the cost of (x_k, u_k) whose (C x_{k+1}, u_k) has the cost ``after``, in the mean.

    ``noise`` is the covariance of C x_{k+1} about its prediction.
    """
    (n, n_u), W, m = model.B.shape, after.W, len(C)
    A, B, offset = map(torch.tensor, (model.A, model.B, model.offset))
    M = torch.cat((C @ torch.cat((A, B), -1), torch.eye(n + n_u).to(W)[n:]))
    level = torch.nn.functional.pad(C @ offset, (0, n_u))
    noise = (W[:m, :m] * noise).sum() / 2
    c = after.c + level @ W @ level / 2 + after.q @ level + noise
    return StageCost(M.mT @ W @ M, M.mT @ (after.q + W @ level), c, after.R2)


def scheme_cost(fitted: StageCost, layout: Layout, gamma: float, hessian: str) -> Cost:
    """Return the cost of a scheme from a stage's, which x_N has, too."""
    n_d, n_x, n_u, N = layout.n_d, layout.n_x, layout.n_u, layout.horizon
    diagonal = hessian == "diagonal"
    W = fitted.W[n_d:, n_d:].diagonal() if diagonal else fitted.W
    terminal = W[:n_x] if diagonal else W[: n_d + n_x, : n_d + n_x]
    d, x, u = fitted.q.split((n_d, n_x, n_u))
    q = torch.cat((d.repeat(N + 1), layout.stages(x.expand(N + 1, -1), u)))
    ahead = gamma ** torch.arange(N + 1, dtype=torch.float64)
    return Cost(W, terminal, hessian, q=q, c=fitted.c * ahead.sum())


def _observed(steps: Any, layout: Layout) -> tuple[Tensor, ...]:
    """Return [d; x], u, the next x, the costs, and the next y of estimates, without padding."""
    reward = steps.get(("next", "reward"), None) if hasattr(steps, "batch_size") else None
    if reward is None:
        raise _unfitted("a log without rewards")
    kept = valid_steps(steps)
    reward = ungraded("reward", reward).detach().cpu().reshape(steps.shape)[kept].double()
    if not (reward.abs() <= LARGEST).all():
        raise _unfitted("a log with rewards of NaN or inf, or too large")
    u = steps["action"]
    d = steps["preview"][..., : layout.n_d] if layout.n_d else u[..., :0]
    x, following = (steps[key][..., -layout.n_x :] for key in ("observation", NEXT))
    measured = steps.get(MEASURED, u[..., :0])
    parts = (d, x, u, following, measured)
    d, x, u, following, measured = (part.detach().cpu().double()[kept] for part in parts)
    return torch.cat((d, x), -1), u, following, -reward, measured


def poor(R2: float) -> str:
    """Say that a fitted cost explains the rewards poorly."""
    fit = f"explains {R2:.1%} of the rewards' variance"
    fit = "has too few rewards to judge it by" if math.isnan(R2) else fit
    return (
        f"The fitted stage cost {fit}: the controller "
        "may minimise another cost than the plant's. Pass the plant's own cost as stage_weight (a "
        "matrix with hessian='block'), in train.py task.stage_weight, or a log about the states "
        "where the controller is to work."
    )


def _unfitted(got: str) -> QPError:
    expected = "a weight, or finite rewards to fit a cost to"
    return QPError.expected("stage_weight", f"none, and {got}", expected, REMEDY)
