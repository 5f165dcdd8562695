"""The project's own judgement of a claimed solution: a relative, sign-aware KKT residual.

No solver's word is taken. For multipliers ``lam = eta - upsilon`` of the softened rows, optimality
of ``h(y) = w dist(y, [lb, ub])`` in y = Gz is ``h(y) + h*(lam) = lam y`` with the conjugate
``h*(lam) = ub max(lam, 0) - lb max(-lam, 0)`` on ``|lam| <= w`` (Fenchel and Young). Each row's gap
is non-negative on its own, so errors of opposite sign cannot cancel as they do in a summed
duality gap.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torch_qpmpc.condense import FlatPrograms

#: A claimed solution with a larger relative residual is not a solution.
TOLERANCE = 1e-6


@dataclass
class Certificate:
    """Value ``(B,)``, slacks ``(B, n_g)`` and relative KKT residual ``(B,)`` of claims."""

    value: Tensor
    sigma: Tensor
    residual: Tensor


def certify(programs: FlatPrograms, z: Tensor, lam: Tensor, chi: Tensor, xi: Tensor) -> Certificate:
    """Judge z ``(B, n_z)`` with multipliers lam ``(B, n_g)``, chi ``(B, n_c)``, xi ``(B, n_f)``.

    The residual is the largest of: stationarity, C z = b, the fixed entries, violation of hard
    rows, multipliers outside [-w, w], and the rows' summed complementarity gaps; each relative to
    the size of the terms that it compares.
    """
    p = programs
    Hz, y = p.multiply(p.H, z), p.multiply(p.G, z)
    terms = [Hz, p.q, p.multiply(p.G.mT, lam), p.multiply(p.C.mT, chi)]
    stationarity = torch.stack(terms).sum(0)
    n_f = p.fixed.shape[-1]
    stationarity[:, :n_f] += xi
    scale = 1 + torch.stack([_largest(term) for term in terms]).amax(0)

    hard = p.w.isinf()
    outside = torch.maximum(p.lb - y, y - p.ub).clamp(min=0)
    sigma = outside.masked_fill(hard, 0)
    violation = torch.where(hard, outside / (1 + y.abs()), 0)

    weight = p.w.masked_fill(hard, 0)
    excess = torch.where(hard, 0, (lam.abs() - weight).clamp(min=0) / (1 + weight))
    up, down = lam.clamp(min=0), (-lam).clamp(min=0)
    no_upper, no_lower = p.ub.isinf(), p.lb.isinf()
    # A multiplier of a bound that does not exist is a dual infeasibility of its own size.
    excess = torch.maximum(excess, torch.where(no_upper, up, 0) + torch.where(no_lower, down, 0))
    gap = (
        weight * sigma
        + p.ub.masked_fill(no_upper, 0) * up
        - p.lb.masked_fill(no_lower, 0) * down
        - lam * y
    )

    cost = 0.5 * (z * Hz).sum(-1) + (p.q * z).sum(-1) + (weight * sigma).sum(-1)
    parts = [
        _largest(stationarity) / scale,
        _largest(p.multiply(p.C, z) - p.b) / (1 + _largest(p.b) + _largest(z)),
        _largest(z[:, :n_f] - p.fixed),
        _largest(violation),
        _largest(excess),
        gap.abs().sum(-1) / (1 + cost.abs()),
    ]
    residual = torch.stack(parts).amax(0)
    return Certificate(cost + p.c, sigma, residual.nan_to_num(torch.inf, torch.inf))


def _largest(x: Tensor) -> Tensor:
    """Largest absolute entry along the last dimension; zero where that is empty."""
    return x.abs().amax(-1) if x.shape[-1] else x.new_zeros(x.shape[:-1])
