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

import numpy as np
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
        # Some thirty operations on small arrays, for which torch takes several times as long.
        parts = (p.H, p.C, p.G, p.q, p.b, p.lb, p.ub, p.w)
        H, C, G, *vectors = (np.abs(part.cpu().numpy()) for part in parts)
        group = p.group.cpu().numpy() if len(H) > 1 else None
        q, b, lb, ub, w = (_per_triple(_finite(vector), len(H), group) for vector in vectors)
        C, G = C.sum(-1), G.sum(-1)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            length = _unit(_median(np.concatenate((np.maximum(lb, ub) / G, b / C), axis=-1)))
            cost = np.maximum(q.max(-1, keepdims=True) * length, H.max((1, 2))[:, None] * length**2)
            if w.shape[-1]:  # of a QP without any other cost
                cost = np.where(cost > 0, cost, (w * G).max(-1, keepdims=True) * length)
            units = (_unit(cost), length, _unit(G * length), _unit(C * length))
        if all((unit == 1.0).all() for unit in units):
            return None
        return cls(*(torch.from_numpy(unit).to(p.q) for unit in units))

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

    def multipliers(self, p: FlatPrograms, lam: Tensor) -> Tensor:
        """Multipliers ``(B, n_g)`` of the rows in these units."""
        return lam * self._of(p, self.rows) / self._of(p, self.cost)

    def _of(self, p: FlatPrograms, unit: Tensor) -> Tensor:
        """A unit of each QP, ``(B or 1, n)``."""
        return unit if len(unit) == 1 else unit[p.group]


def units_of(p: FlatPrograms) -> Units | None:
    """`Units.of` once for a theta."""
    return p.known("units", lambda: Units.of(p))


def _finite(sizes: np.ndarray) -> np.ndarray:
    """Zeros for what is infinite or NaN and says nothing of sizes; in place."""
    sizes[~np.isfinite(sizes)] = 0.0
    return sizes


def _per_triple(sizes: np.ndarray, count: int, group: np.ndarray | None) -> np.ndarray:
    """The largest ``(B or 1, n)`` of the QPs that share their matrices, ``(M, n)``."""
    if group is None:
        return sizes.max(0, keepdims=True)
    largest = np.zeros((count, sizes.shape[-1]))
    np.maximum.at(largest, group, np.broadcast_to(sizes, (len(group), sizes.shape[-1])))
    return largest


def _median(sizes: np.ndarray) -> np.ndarray:
    """The (lower) median of the positive finite sizes of each row, ``(M, 1)``; inf if none is."""
    known = (sizes > 0) & (sizes < np.inf)
    ordered = np.sort(np.where(known, sizes, np.inf), axis=-1)
    if not ordered.shape[-1]:
        return np.full((len(sizes), 1), np.inf)
    middle = np.maximum(known.sum(-1, keepdims=True) - 1, 0) // 2
    return np.take_along_axis(ordered, middle, axis=-1)


def _unit(sizes: np.ndarray) -> np.ndarray:
    """The power of two next above each size, or one if that is ordinary, zero or not finite."""
    extreme = ((sizes > 0) & (sizes < SMALL)) | ((sizes > LARGE) & (sizes < np.inf))
    if not extreme.any():
        return np.ones_like(sizes)
    return np.where(extreme, np.ldexp(1.0, np.frexp(sizes)[1]), 1.0)
