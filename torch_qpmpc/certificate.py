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


@dataclass
class Products:
    """H z ``(B, n_z)``, G z ``(B, n_g)`` and G'lam ``(B, n_z)`` of a claimed solution."""

    Hz: Tensor
    Gz: Tensor
    G_lam: Tensor

    @classmethod
    def of(cls, programs: FlatPrograms, z: Tensor, lam: Tensor) -> Products:
        p = programs
        return cls(p.multiply(p.H, z), p.multiply(p.G, z), p.multiply(p.G.mT, lam))


def certify(
    programs: FlatPrograms,
    z: Tensor,
    lam: Tensor,
    chi: Tensor,
    xi: Tensor,
    products: Products | None = None,
) -> Certificate:
    """Judge z ``(B, n_z)`` with multipliers lam ``(B, n_g)``, chi ``(B, n_c)``, xi ``(B, n_f)``.

    The residual is the largest of: stationarity, C z = b, the fixed entries, violation of hard
    rows, multipliers outside [-w, w] or of absent bounds, and the rows' summed complementarity
    gaps; each relative to the size of the terms that it compares. ``products`` saves computing
    them again.
    """
    p, n_f = programs, programs.fixed.shape[-1]
    given = Products.of(p, z, lam) if products is None else products
    Hz, y, pull, push = given.Hz, given.Gz, given.G_lam, p.multiply(p.C.mT, chi)
    stationarity = Hz + p.q + pull + push
    stationarity[:, :n_f] += xi
    scale = 1 + _largest(torch.cat((Hz, pull, push), dim=-1)).maximum(_largest(p.q))

    hard, size = p.w.isinf(), lam.abs()
    weight = p.w.masked_fill(hard, 0)
    outside = (y - y.maximum(p.lb).minimum(p.ub)).abs()
    sigma = outside.masked_fill(hard, 0)
    # h*(lam): the bound that lam pushes from; one that is absent can have no multiplier.
    bound = torch.where(lam > 0, p.ub, p.lb)
    absent = bound.isinf()
    excess = torch.where(absent, size, (size - p.w).clamp(min=0) / (1 + p.w))
    gap = weight * sigma + lam * (bound.masked_fill(absent, 0) - y)

    cost = (z * (0.5 * Hz + p.q)).sum(-1) + (weight * sigma).sum(-1)
    parts = [
        _largest(stationarity) / scale,
        _largest(p.multiply(p.C, z) - p.b) / (1 + _largest(p.b) + _largest(z)),
        _largest(z[:, :n_f] - p.fixed),
        _largest((outside - sigma) / (1 + y.abs())),
        _largest(excess),
        gap.abs().sum(-1) / (1 + cost.abs()),
    ]
    residual = torch.stack(parts).amax(0)
    return Certificate(cost + p.c, sigma, residual.nan_to_num(torch.inf, torch.inf))


def _largest(x: Tensor) -> Tensor:
    """Largest absolute entry along the last dimension; zero where that is empty."""
    return x.abs().amax(-1) if x.shape[-1] else x.new_zeros(x.shape[:-1])
