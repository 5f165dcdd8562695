"""A QP's own units: far from ordinary sizes it is solved, and certified, in these.

Tolerances are relative, but to no less than one: to the solvers and the certificate a QP whose
cost, variables or rows are of size 1e-8 is a QP of zeros. With units of cost kappa, of length l,
and of the rows rho (of G) and gamma (of C),

    z = l z',  H' = H l^2 / kappa,  q' = q l / kappa,  C' = C l / gamma,  b' = b / gamma,
    G' = G l / rho,  (lb, ub)' = (lb, ub) / rho,  w' = w rho / kappa,

is the same QP. All units are powers of two, so that rounding is the same, too.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from torch import Tensor

from torch_qpmpc.qp.kernels import per_sample, per_theta
from torch_qpmpc.qp.pipeline.batch import FlatPrograms
from torch_qpmpc.qp.pipeline.batch_solution import RawSolution

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
        if not len(p) or not p.arrays.q.shape[-1]:
            return None
        a = p.arrays
        given = (a.H, a.C, a.G, p.group_array, a.q, a.b, a.lb, a.ub, a.w)
        units = per_theta.units(*given, SMALL, LARGE)
        return None if units is None else cls(*per_sample.tensors(units, p.device))

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

    @property
    def inverse(self) -> Units:
        """The units of these units' numbers, in which they are the QPs' own."""
        return Units(1 / self.cost, 1 / self.length, 1 / self.rows, 1 / self.equalities)

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

    def multipliers(self, p: FlatPrograms, lam: Tensor) -> Tensor:
        """Multipliers ``(B, n_g)`` of the rows in these units."""
        return lam * self._of(p, self.rows) / self._of(p, self.cost)

    def _of(self, p: FlatPrograms, unit: Tensor) -> Tensor:
        """A unit of each QP, ``(B or 1, n)``."""
        return unit if len(unit) == 1 else unit[p.group]


def units_of(p: FlatPrograms) -> Units | None:
    """`Units.of` once for a theta."""
    return p.known("units", lambda: Units.of(p))
