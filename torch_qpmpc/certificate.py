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

from torch_qpmpc import kernels
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

    H z, G'lam, C'chi and ``left``, their sum with q and xi, ``(B, n_z)``; y = G z, ``(B, n_g)``.
    """

    Hz: Tensor
    G_lam: Tensor
    C_chi: Tensor
    left: Tensor
    y: Tensor

    @classmethod
    def of(
        cls, programs: FlatPrograms, z: Tensor, lam: Tensor, chi: Tensor, xi: Tensor
    ) -> Products:
        p = programs
        Hz, G_lam, C_chi = (
            p.times_H(z),
            p.times_G(lam, transposed=True),
            p.multiply(p.C, chi, transposed=True),
        )
        left = Hz + p.q + G_lam + C_chi
        left[:, : xi.shape[-1]] += xi
        return cls(Hz, G_lam, C_chi, left, p.times_G(z))


@dataclass(frozen=True, eq=False)
class _Scales:
    """What the certificate needs to know of theta alone.

    Of the rows, ``(B or 1, n_g)``: ``weight`` is w with zeros on hard rows, ``soft`` and ``hard``
    are one on such rows, ``shrink`` is 1 / (1 + w) and ``minus_limit`` -w / (1 + w), zero on hard
    rows; lb and ub have zeros for absent bounds, which ``no_lb`` and ``no_ub`` mark. None stands
    for marks of which there are none. Then -b, and the sizes of q and b, ``(B or 1, 1)``.
    """

    weight: Tensor
    soft: Tensor
    hard: Tensor | None
    shrink: Tensor
    minus_limit: Tensor
    lb: Tensor
    ub: Tensor
    no_lb: Tensor | None
    no_ub: Tensor | None
    minus_b: Tensor
    q_size: Tensor
    b_size: Tensor

    @classmethod
    def of(cls, p: FlatPrograms) -> _Scales:
        hard, no_lb, no_ub = p.w.isinf(), p.lb.isinf(), p.ub.isinf()
        weight, shrink = p.w.masked_fill(hard, 0.0), 1.0 / (1.0 + p.w)
        return cls(
            weight,
            soft=(~hard).to(p.w),
            hard=hard.to(p.w) if hard.any() else None,
            shrink=shrink,
            minus_limit=-weight * shrink,
            lb=p.lb.masked_fill(no_lb, 0),
            ub=p.ub.masked_fill(no_ub, 0),
            no_lb=no_lb if no_lb.any() else None,
            no_ub=no_ub if no_ub.any() else None,
            minus_b=-p.b,
            q_size=_size(p.q),
            b_size=largest(p.b, keepdim=True),
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
    rows, multipliers outside [-w, w] or of absent bounds, each relative to the size of the terms
    that it compares; and what all of them, with the rows' complementarity gaps, are worth at the
    claim's own z and multipliers, relative to the cost. ``products`` saves computing them again.
    """
    p = programs
    terms = Products.of(p, z, lam, chi, xi) if products is None else products
    if not z.is_cpu:
        return _certify(p, z, lam, chi, terms)
    t = terms
    of_claim = (z, t.Hz, t.G_lam, t.C_chi, t.left, t.y, lam, chi, p.multiply(p.C, z))
    given = (p.fixed, p.q, p.c, p.b, p.lb, p.ub, p.w)
    judged = kernels.judge(*kernels.arrays(*of_claim, *given))
    return Certificate(*map(torch.from_numpy, judged))


def _certify(p: FlatPrograms, z: Tensor, lam: Tensor, chi: Tensor, terms: Products) -> Certificate:
    """`certify` in torch, for any device."""
    scales: _Scales = p.known("scales", lambda: _Scales.of(p))
    beyond = terms.y - terms.y.clamp(p.lb, p.ub)
    outside, up, down = beyond.abs(), lam.clamp(min=0.0), lam.clamp(max=0.0)
    sigma, charge = outside * scales.soft, outside * scales.weight
    # A soft row's multiplier beyond w, and a hard row's violation.
    defect = torch.addcmul(scales.minus_limit, lam.abs(), scales.shrink).clamp_(min=0.0)
    if scales.hard is not None:
        defect.addcdiv_(outside * scales.hard, terms.y.abs().add_(1.0))
    # Row by row h(y) + h*(lam) - lam y, where h* charges the bound that lam pushes from.
    gap = torch.addcmul(charge, scales.ub - terms.y, up).addcmul_(scales.lb - terms.y, down)
    cost = torch.linalg.vecdot(torch.add(p.q, terms.Hz, alpha=0.5), z) + charge.sum(-1)
    short = p.affine(p.C, z, scales.minus_b)
    # An absurd z or chi makes relative errors small that are large in the cost.
    slip = torch.linalg.vecdot(terms.left.abs(), z.abs())
    slip += torch.linalg.vecdot(short.abs(), chi.abs())
    slip += gap.abs_().sum(-1)
    forces = torch.cat((terms.Hz, terms.G_lam, terms.C_chi), dim=-1)
    errors = [
        terms.left / scales.q_size.maximum(_size(forces)),
        short / (scales.b_size + _size(z)),
        z[:, : p.fixed.shape[-1]] - p.fixed,
        defect,
        (slip / cost.abs().add_(1.0)).unsqueeze(-1),
    ]
    for absent, push in ((scales.no_ub, up), (scales.no_lb, down)):
        if absent is not None:
            errors.append(push * absent)
    residual = largest(torch.cat(errors, dim=-1))
    return Certificate(cost + p.c, sigma, residual.nan_to_num_(torch.inf, torch.inf))


def _size(x: Tensor) -> Tensor:
    """What absolute errors in x are compared with, ``(B, 1)``."""
    return largest(x, keepdim=True).add_(1.0)
