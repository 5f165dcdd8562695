"""Weights of TD errors of unequal variance, for weighted least squares.

The estimate of least variance weights each squared error by one over its error's variance (Aitken,
"On least squares and linear combinations of observations", 1935). The variance is modelled as in
Harvey, "Estimating regression models with multiplicative heteroscedasticity" (Econometrica, 1976):
its log is linear in the logs of the squares of p and a, as deviations from their means, and of
|Q(p, a)|. The coefficients are the least-squares fit to the batch's log delta^2. Each update fits
them to the errors that the last one left, as in iteratively reweighted least squares.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

#: Added to each regressor of the variance before its logarithm, as a fraction of its mean.
OFFSET = 0.05
#: Added to delta^2, and smallest variance, as a fraction of the batch's median.
FLOOR = 0.01
#: Smallest batch to which the variance is fitted.
LEAST = 16
#: Keeps equal inputs from a division by zero, and collinear ones apart.
TINY = 1e-9


@torch.no_grad()
def inverse_variance(p: Tensor, a: Tensor, value: Tensor, error: Tensor, use: Tensor) -> Tensor:
    """Return one over the variance of each TD error, relative to its mean, ``(B,)``.

    Args:
        p, a: what is known and the action, ``(B, n_p)`` and ``(B, n_u)``.
        value: Q(p, a), ``(B,)``.
        error: the TD errors, ``(B,)``.
        use: True for the usable pairs, ``(B,)``. The others, and all if they are few or without an
            error, have the weight one.
    """
    weight = torch.ones_like(error)
    square = error[use].square()
    if len(square) < LEAST or not square.any():
        return weight
    inputs = _square(p[use]), _square(a[use]), value[use].abs()
    logs = [torch.log(OFFSET + x.to(square) / x.mean().clamp(min=TINY)) for x in inputs]
    features = F.pad(torch.stack(logs, -1), (1, 0), value=1.0)
    offset = FLOOR * square.median() + TINY * square.mean()
    gram = features.mT @ features + TINY * len(square) * torch.eye(4).to(square)
    beta = torch.linalg.solve(gram, features.mT @ torch.log(square + offset))
    log_variance = features @ beta
    inverse = 1 / torch.exp(log_variance - log_variance.median()).clamp(min=FLOOR)
    weight[use] = inverse / inverse.mean()
    return weight


def _square(x: Tensor) -> Tensor:
    """Return the mean square of each row's standardised entries, ``(B,)``."""
    deviation = x - x.mean(0)
    return (deviation.square() / deviation.square().mean(0).clamp(min=TINY)).mean(-1)
