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

from torch_qpmpc.batching import largest
from torch_qpmpc.programs import FlatPrograms

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
    """The terms of a claim's KKT conditions.

    H z, G'lam, C'chi and ``slope``, their sum with q, ``(B, n_z)``; y = G z and ``beyond``, how far
    it is above ub (or below lb, negative), ``(B, n_g)``.
    """

    Hz: Tensor
    G_lam: Tensor
    C_chi: Tensor
    slope: Tensor
    y: Tensor
    beyond: Tensor

    @classmethod
    def of(cls, programs: FlatPrograms, z: Tensor, lam: Tensor, chi: Tensor) -> Products:
        p = programs
        Hz, G_lam, C_chi = p.times_H(z), p.times_G(lam, transposed=True), p.multiply(p.C.mT, chi)
        y = p.times_G(z)
        return cls(Hz, G_lam, C_chi, Hz + p.q + G_lam + C_chi, y, y - y.clamp(p.lb, p.ub))


@dataclass(frozen=True, eq=False)
class _Rows:
    """What the certificate needs to know of the rows and of the sizes of q and b.

    All but the sizes ``(B or 1, n_g)``: ``weight`` is w with zeros on hard rows, ``soft`` one on
    soft rows, ``shrink`` 1 / (1 + w); lb and ub have zeros for absent bounds, which ``no_lb`` and
    ``no_ub`` mark, or None if none is absent.
    """

    weight: Tensor
    soft: Tensor
    shrink: Tensor
    lb: Tensor
    ub: Tensor
    no_lb: Tensor | None
    no_ub: Tensor | None
    q_size: Tensor
    b_size: Tensor

    @classmethod
    def of(cls, p: FlatPrograms) -> _Rows:
        hard, no_lb, no_ub = p.w.isinf(), p.lb.isinf(), p.ub.isinf()
        return cls(
            p.w.masked_fill(hard, 0),
            (~hard).to(p.w),
            1 / (1 + p.w),
            p.lb.masked_fill(no_lb, 0),
            p.ub.masked_fill(no_ub, 0),
            no_lb if no_lb.any() else None,
            no_ub if no_ub.any() else None,
            1 + largest(p.q),
            1 + largest(p.b),
        )


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
    terms = Products.of(p, z, lam, chi) if products is None else products
    rows: _Rows = p.known("rows", lambda: _Rows.of(p))
    stationarity = terms.slope.clone()
    stationarity[:, :n_f] += xi
    scale = largest(torch.cat((terms.Hz, terms.G_lam, terms.C_chi), dim=-1))

    outside = terms.beyond.abs()
    sigma, charge = outside * rows.soft, outside * rows.weight
    up, down = lam.clamp(min=0), lam.clamp(max=0)
    excess = (lam.abs() - p.w).clamp_(min=0).mul_(rows.shrink)
    # Row by row h(y) + h*(lam) - lam y, where h* charges the bound that lam pushes from.
    gap = (rows.ub - terms.y).mul_(up)
    gap += (rows.lb - terms.y).mul_(down)
    gap += charge
    cost = torch.add(p.q, terms.Hz, alpha=0.5).mul_(z).sum(-1) + charge.sum(-1)
    parts = [
        largest(stationarity) / rows.q_size.maximum(1 + scale),
        largest(p.multiply(p.C, z) - p.b) / (rows.b_size + largest(z)),
        largest(z[:, :n_f] - p.fixed),
        _violation(outside - sigma, terms.y),
        largest(excess),
        gap.abs_().sum(-1) / (1 + cost.abs()),
    ]
    for absent, push in ((rows.no_ub, up), (rows.no_lb, down)):
        if absent is not None:
            parts.append(largest(push * absent))
    residual = torch.stack(parts).amax(0)
    return Certificate(cost + p.c, sigma, residual.nan_to_num(torch.inf, torch.inf))


def _violation(outside: Tensor, y: Tensor) -> Tensor:
    """The largest violation of a hard row, relative to its y, ``(B,)``."""
    worst = largest(outside)
    # Relative to one or more: what is small as it is need not be divided.
    return worst if (worst <= TOLERANCE).all() else largest(outside / (1 + y.abs()))
