"""Forward mode: the tangents of the value and of the solution from those of the QP's data.

The value's is the Lagrangian's gradient times the data's tangents (eq:gradq). The solution's solves
the KKT system of the active set A, which is symmetric, so that it is the one of the gradient
(`torch_qpmpc.qp.sensitivity`); with dlam_S = sign(lam) dw on the saturated rows S,

    [H   C'  G_A' E'] [dz    ]   [-(dH z + dq + dC'chi + dG'lam + G_S'dlam_S)]
    [C   0   0    0 ] [dchi  ]   [db - dC z                                  ]
    [G_A 0   0    0 ] [dlam_A] = [d(lb, ub)_A - dG_A z                       ]
    [E   0   0    0 ] [dxi   ]   [d(fixed)                                   ]
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torch_qpmpc.qp.program import active_rows

#: Those of H, q, c, C, b, G, lb, ub, w, fixed; None for zero.
Tangents = Sequence[Tensor | None]


def value_tangent(
    tangents: Tangents, z: Tensor, sigma: Tensor, chi: Tensor, lam: Tensor, xi: Tensor
) -> Tensor:
    """dV, ``(*batch,)``."""
    dH, dq, dc, dC, db, dG, dlb, dub, dw, dfixed = tangents
    total = z.new_zeros(z.shape[:-1])
    if dc is not None:
        total = total + dc
    for matrix, left in ((dH, 0.5 * z), (dC, chi), (dG, lam)):
        if matrix is not None:
            total = total + (left * times(matrix, z)).sum(-1)
    weights = (z, -chi, (-lam).clamp(min=0), -lam.clamp(min=0), sigma, -xi)
    for vector, weight in zip((dq, db, dlb, dub, dw, dfixed), weights, strict=True):
        if vector is not None:
            total = total + (weight * vector).sum(-1)
    return total


def right_side(
    tangents: Tangents, z: Tensor, lam: Tensor, chi: Tensor, xi: Tensor, G: Tensor, w: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """The system's right-hand side, in the order of z, lam, chi, xi, and dlam of saturated rows."""
    dH, dq, _, dC, db, dG, dlb, dub, dw, dfixed = tangents
    of_z, of_lam, of_chi = (torch.zeros_like(part) for part in (z, lam, chi))
    of_xi = torch.zeros_like(xi) if dfixed is None else dfixed.expand_as(xi)
    saturated = torch.zeros_like(lam)
    if dw is not None:
        saturated = torch.where(active_rows(lam, w)[1], lam.sign() * dw, 0)
        of_z = of_z - times(G.mT, saturated)
    if dH is not None:
        of_z = of_z - times(dH + dH.mT, z) / 2
    if dq is not None:
        of_z = of_z - dq
    for bound, side in ((dlb, lam < 0), (dub, lam > 0)):
        if bound is not None:
            of_lam = torch.where(side, bound, of_lam)
    if db is not None:
        of_chi = of_chi + db
    if dC is not None:
        of_z, of_chi = of_z - times(dC.mT, chi), of_chi - times(dC, z)
    if dG is not None:
        of_z, of_lam = of_z - times(dG.mT, lam), of_lam - times(dG, z)
    return of_z, of_lam, of_chi, of_xi, saturated


def times(matrix: Tensor, vector: Tensor) -> Tensor:
    """``(*batch, i, j)`` by ``(*batch, j)`` to ``(*batch, i)``, broadcasting."""
    return (vector.unsqueeze(-2) @ matrix.mT).squeeze(-2)
