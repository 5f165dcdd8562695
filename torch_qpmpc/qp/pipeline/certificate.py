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

from torch_qpmpc.qp.batching import largest
from torch_qpmpc.qp.kernels import per_sample
from torch_qpmpc.qp.pipeline.batch import FlatPrograms

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
    judged = per_sample.judge(*per_sample.arrays(*of_claim, *given))
    return Certificate(*map(torch.from_numpy, judged))


def _certify(p: FlatPrograms, z: Tensor, lam: Tensor, chi: Tensor, terms: Products) -> Certificate:
    """`certify` in torch, for any device."""
    hard, no_lb, no_ub = p.w.isinf(), p.lb.isinf(), p.ub.isinf()
    y, up, down = terms.y, lam.clamp(min=0.0), lam.clamp(max=0.0)
    outside = (y - y.clamp(p.lb, p.ub)).abs()
    charge = outside * p.w.masked_fill(hard, 0.0)
    # Row by row h(y) + h*(lam) - lam y, where h* charges the bound that lam pushes from.
    lb, ub = p.lb.masked_fill(no_lb, 0.0), p.ub.masked_fill(no_ub, 0.0)
    gap = charge + (ub - y) * up + (lb - y) * down
    cost = torch.linalg.vecdot(p.q + 0.5 * terms.Hz, z) + charge.sum(-1)
    short = p.multiply(p.C, z) - p.b
    # An absurd z or chi makes relative errors small that are large in the cost.
    slip = torch.linalg.vecdot(terms.left.abs(), z.abs())
    slip = slip + torch.linalg.vecdot(short.abs(), chi.abs()) + gap.abs().sum(-1)
    forces = torch.cat((terms.Hz, terms.G_lam, terms.C_chi, p.q.expand_as(z)), dim=-1)
    errors = (
        terms.left / (1.0 + largest(forces, keepdim=True)),
        short / (1.0 + largest(p.b, keepdim=True) + largest(z, keepdim=True)),
        z[:, : p.fixed.shape[-1]] - p.fixed,
        # A hard row's violation, and a soft row's multiplier beyond w.
        torch.where(hard, outside / (1.0 + y.abs()), (lam.abs() - p.w) / (1.0 + p.w)).clamp(min=0),
        up * no_ub,
        down * no_lb,
        (slip / (1.0 + cost.abs())).unsqueeze(-1),
    )
    residual = largest(torch.cat(errors, dim=-1)).nan_to_num_(torch.inf, torch.inf)
    return Certificate(cost + p.c, outside.masked_fill(hard, 0.0), residual)
