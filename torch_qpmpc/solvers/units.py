"""A QP's own units: far from ordinary sizes it is solved, and certified, in these.

Tolerances are relative, but to no less than one: to the solvers and the certificate a QP whose
cost, variables or rows are of size 1e-8 is a QP of zeros. With units of cost kappa, of length l, and
of the rows rho (of G) and gamma (of C),

    z = l z',  H' = H l^2 / kappa,  q' = q l / kappa,  C' = C l / gamma,  b' = b / gamma,
    G' = G l / rho,  (lb, ub)' = (lb, ub) / rho,  w' = w rho / kappa,

is the same QP. All units are powers of two, so that rounding is the same, too.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torch_qpmpc.programs import FlatPrograms
from torch_qpmpc.solvers.raw import RawSolution

#: Sizes in between are ordinary: their unit is one.
SMALL, LARGE = 2.0**-7, 2.0**10


@dataclass(frozen=True, eq=False)
class Units:
    """Of each matrix triple: ``cost`` and ``length`` ``(M, 1)``, ``rows`` ``(M, n_g)`` and
    ``equalities`` ``(M, n_c)``."""

    cost: Tensor
    length: Tensor
    rows: Tensor
    equalities: Tensor

    @classmethod
    def of(cls, p: FlatPrograms) -> Units | None:
        """The units of ``p``, or None where all of them are one."""
        if not len(p) or not p.q.shape[-1]:
            return None
        # What is infinite or NaN says nothing of sizes.
        q, b, w = (_per_triple(p, x.abs().nan_to_num(0, 0, 0)) for x in (p.q, p.b, p.w))
        lower, upper = (x.abs().nan_to_num(0, 0, 0) for x in (p.lb, p.ub))
        bound = _per_triple(p, lower.maximum(upper))
        G, C = p.G.abs().sum(-1), p.C.abs().sum(-1)
        reach = torch.cat((bound / G, b / C, torch.zeros_like(q[:, :1])), dim=-1)
        known = (reach > 0) & reach.isfinite()
        length = _unit(reach.masked_fill(~known, torch.nan).nanmedian(-1, keepdim=True).values)
        force = q.amax(-1, keepdim=True) * length
        cost = force.maximum(p.H.abs().amax((1, 2)).unsqueeze(-1) * length.square())
        if w.shape[-1]:  # of a QP without any other cost
            cost = torch.where(cost > 0, cost, (w * G).amax(-1, keepdim=True) * length)
        units = cls(_unit(cost), length, _unit(G * length), _unit(C * length))
        return None if all((unit == 1).all() for unit in vars(units).values()) else units

    def scaled(self, p: FlatPrograms) -> FlatPrograms:
        """The same QPs in these units."""
        theta = p.known("scaled", lambda: self._scaled(p))
        return theta._with(p.group, p.fixed / self._of(p, self.length))

    def _scaled(self, p: FlatPrograms) -> FlatPrograms:
        def matrix(M: Tensor, rows: Tensor) -> Tensor:
            return M * (self.length / rows).unsqueeze(-1)

        force, rows = self._of(p, self.cost / self.length), self._of(p, self.rows)
        return FlatPrograms(
            p.H * (self.length.square() / self.cost).unsqueeze(-1),
            matrix(p.C, self.equalities),
            matrix(p.G, self.rows),
            p.group,
            p.q / force,
            p.c / self._of(p, self.cost).squeeze(-1),
            p.b / self._of(p, self.equalities),
            p.lb / rows,
            p.ub / rows,
            p.w * self._of(p, self.rows / self.cost),
            p.fixed,
        )

    def restored(self, p: FlatPrograms, raw: RawSolution) -> RawSolution:
        """The solutions in the QPs' own numbers; residuals stay as they are, relative."""
        cost, length = self._of(p, self.cost), self._of(p, self.length)
        rows, equalities = self._of(p, self.rows), self._of(p, self.equalities)
        return replace(
            raw,
            value=raw.value * cost.squeeze(-1),
            z=raw.z * length,
            sigma=raw.sigma * rows,
            chi=raw.chi * cost / equalities,
            lam=raw.lam * cost / rows,
            xi=raw.xi * cost / length,
        )

    def _of(self, p: FlatPrograms, unit: Tensor) -> Tensor:
        """A unit of each QP, ``(B or 1, n)``."""
        return unit if len(unit) == 1 else unit[p.group]


def _per_triple(p: FlatPrograms, sizes: Tensor) -> Tensor:
    """The largest ``(B or 1, n)`` of the QPs that share their matrices, ``(M, n)``."""
    if len(p.H) == 1:
        return sizes.amax(0, keepdim=True)
    index = p.group.unsqueeze(-1).expand(-1, sizes.shape[-1])
    largest = sizes.new_zeros(len(p.H), sizes.shape[-1])
    return largest.scatter_reduce_(0, index, sizes.expand(len(p), -1), "amax")


def _unit(sizes: Tensor) -> Tensor:
    """The power of two next above each size, or one if that is ordinary, zero or not finite."""
    extreme = ((sizes > 0) & (sizes < SMALL)) | ((sizes > LARGE) & sizes.isfinite())
    return torch.where(extreme, sizes / torch.frexp(sizes).mantissa, 1.0)
