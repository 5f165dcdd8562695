"""Arrays of the pipeline: data, reduced QPs, candidates of backends, certified solutions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torch_qpmpc.qp.program import INFINITE, Status, crossed

#: Hard rows that contradict each other by a larger fraction of their terms are infeasible.
CONTRADICTED = 1e-7
#: Optima that are further from zero have a length of their own.
LONG = 2.0**10
#: ``np.ndarray``; ``torch.Tensor`` within backends.
Array = Any


class Theta(NamedTuple):
    """B QPs over M distinct matrix triples, in float64, in another order than `QuadraticProgram`.

    H ``(M, n_z, n_z)``, symmetric, C ``(M, n_c, n_z)``, G ``(M, n_g, n_z)``, q ``(B, n_z)``, c
    ``(B,)``, b ``(B, n_c)``, lb, ub, w ``(B, n_g)``. What the batch shares has a leading one.
    """

    H: Array
    C: Array
    G: Array
    q: Array
    c: Array
    b: Array
    lb: Array
    ub: Array
    w: Array

    @classmethod
    def of(cls, data: Sequence[np.ndarray]) -> Theta:
        """Convert H, q, c, C, b, G, lb, ub, w, each with its leading dimension, to float64.

        H becomes its symmetric part, a bound from `INFINITE` on infinite, and lb becomes ub where
        they cross by rounding alone.
        """
        swapped = data[6] > data[7]
        H, q, c, C, b, G, lb, ub, w = (np.ascontiguousarray(x, np.float64) for x in data)
        if swapped.any():
            bounds = torch.from_numpy(data[6].copy()), torch.from_numpy(data[7].copy())
            lb = np.where(swapped & ~crossed(*bounds).numpy(), ub, lb)
        if (lb <= -INFINITE).any() or (ub >= INFINITE).any():
            lb, ub = np.where(lb <= -INFINITE, -np.inf, lb), np.where(ub >= INFINITE, np.inf, ub)
        return cls((H + H.swapaxes(1, 2)) / 2.0, C, G, q, c, b, lb, ub, w)


class SoftQPs(NamedTuple):
    """The input of a backend: B problems of d variables and r rows,

        min over v:  1/2 v'Hv + g'v + sum_i w_i dist(G_i v, [l_i, u_i]),

    with H ``(M, d, d)``, G ``(M, r, d)``, group ``(B,)``, g ``(B, d)``, l, u, w ``(B, r)``;
    ``w_i = inf`` means a hard row. The vectors need not be contiguous.
    """

    H: Array
    G: Array
    group: Array
    g: Array
    l: Array  # noqa: E741 - the literature's name for the lower bound
    u: Array
    w: Array

    def in_own_units(self, solve: Callable[[SoftQPs], BackendSolution]) -> BackendSolution:
        """Solve QPs whose optimum may be far from zero in units of their own, powers of two.

        It is no match for a solver's absolute tolerances. It is no further than without rows, and
        seldom than most bounds.
        """
        with np.errstate(all="ignore"):
            curvature = np.ldexp(1.0, np.frexp(np.abs(self.H).max((1, 2), initial=0.0))[1])
            size = np.abs(self.g).max(-1, initial=0.0) / curvature[self.group]
            if not ((size > LONG) & (size < np.inf)).any():
                return solve(self)
            ends = (np.where(x != 0, np.abs(x), np.inf) for x in (self.l, self.u))
            near = np.minimum(*ends) / np.linalg.norm(self.G, axis=-1)[self.group]
            size = np.minimum(size, np.median(near, axis=-1)) if near.shape[1] else size
        long = (size > LONG) & (size < np.inf)
        length = np.where(long, np.ldexp(1.0, np.frexp(size)[1]), 1.0)[:, None]
        force = curvature[self.group, None] * length
        parts = {"H": self.H / curvature[:, None, None], "g": self.g / force, "w": self.w / force}
        v, lam, iterations = solve(self._replace(**parts, l=self.l / length, u=self.u / length))
        return BackendSolution(v * length, lam * force, iterations)


class BackendSolution(NamedTuple):
    """v ``(B, d)``, signed row multipliers lam = eta - upsilon ``(B, r)``, iterations ``(B,)``.

    It has no status: the certificate decides which QPs are solved.
    """

    v: Array
    lam: Array
    iterations: Array


class BatchSolution(NamedTuple):
    """Solutions of B QPs, see `QPSolution`, or candidates, which are SOLVED or NOT_CONVERGED."""

    value: Array
    z: Array
    chi: Array
    lam: Array
    xi: Array
    status: Array
    residual: Array
    value_error: Array
    iterations: Array
    active: Array

    def at(self, index: np.ndarray) -> BatchSolution:
        """Return copies of the solutions at ``index``."""
        return BatchSolution._make(x[index] for x in self)

    def put(self, index: Array, others: BatchSolution) -> None:
        """Replace the solutions at ``index``."""
        for own, new in zip(self, others, strict=True):
            own[index] = new

    def improve(self, index: np.ndarray, others: BatchSolution) -> None:
        """Replace solutions at ``index`` by others that are better.

        Those are solved, or proved to have no solution, or have a smaller residual, which is what a
        refinement starts from: an infinite error of the value may be due to rounding alone.
        """
        left, right = (x == Status.NOT_CONVERGED for x in (self.status[index], others.status))
        smaller = others.residual < self.residual[index]
        better = np.flatnonzero(np.where(left == right, smaller, left))
        self.put(index[better], others.at(better))


def to_tensor(x: Array) -> Tensor:
    """Return ``x`` as a tensor on its device, without a copy."""
    return torch.from_numpy(x) if isinstance(x, np.ndarray) else x


def per_qp(unit: np.ndarray, group: np.ndarray) -> np.ndarray:
    """Return the row of ``unit`` ``(M, n)`` for each QP, ``(B, n)``, or ``(1, n)`` if M = 1."""
    return unit if len(unit) == 1 else unit[group]
