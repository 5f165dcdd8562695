"""Choices of a QP's rows, and the region of states on which each is optimal.

With the tables of `torch_qpmpc.export.tables` each row is free (lam = 0), held at a bound, or
saturated (|lam| = w). A choice for all rows makes lam, y and u_0 affine in p, and its conditions,

    free: lower <= y <= upper;   held: 0 <= |lam| <= w;   saturated: y at the bound or beyond it,

are a polytope, the choice's region.

Where held rows are dependent the multipliers are not unique. They are moved along the dependence
until one row is free or saturated. The regions of two such choices can overlap, with the same law,
and their volumes then add up to more than the set's.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull

from torch_qpmpc.export.tables import Tables
from torch_qpmpc.proofs.encoding import solve_rows
from torch_qpmpc.proofs.polytope import Polytope, facets

Array = np.ndarray
#: Held rows are dependent if a singular value of their unit rows is below this.
DEPENDENT = 1e-9
#: Rows that change by less than this fraction of their terms do not bound a region.
CONSTANT = 1e-10


@dataclass(frozen=True, eq=False)
class Region:
    """A polytope of s with one affine law and one quadratic value.

    Attributes:
        set: the polytope; its rows are facets of length 1.
        vertices: ``(count, d)``.
        K, k: ``(n_u, d)`` and ``(n_u,)``, u_0 is ``K s + k``.
        P, g, c: ``(d, d)``, ``(d,)`` and a number; V is ``s'Ps / 2 + g's + c``.
        active: the rows' choices, codes as in `QPSolution.active`, ``(r,)``; the last ones are of
            soft rows that p alone determines.
    """

    set: Polytope
    vertices: Array
    K: Array
    k: Array
    P: Array
    g: Array
    c: float
    active: Array

    @property
    def volume(self) -> float:
        """The length, area or volume."""
        return volume_of(self.vertices)


def volume_of(vertices: Array) -> float:
    """Return the length, area or volume of the hull of points ``(count, n)``."""
    return float(np.ptp(vertices) if vertices.shape[1] == 1 else ConvexHull(vertices).volume)


@dataclass(frozen=True, eq=False)
class Sliced:
    """Tables of s: the rows are ``Y s - Q lam`` within ``lower, upper``, and so on.

    Soft rows that p alone determines follow, with zeros in Q; R does not have them. ``size`` is
    that of Y before the slice, whose round-off is no slope.
    """

    Y: Array
    lower: Array
    upper: Array
    w: Array
    Q: Array
    R: Array
    K: Array
    k: Array
    F: Array
    P: Array
    g: Array
    c: float
    size: Array

    @classmethod
    def of(cls, tables: Tables, origin: Array, basis: Array) -> Sliced:
        rows, known, P = tables.rows, tables.known, (tables.P + tables.P.T) / 2
        soft = np.isfinite(known.w)
        pairs = ((getattr(rows, x), getattr(known, x)[soft]) for x in ("Y", "lower", "upper", "w"))
        Y, lower, upper, w = (np.concatenate(pair) for pair in pairs)
        more, y_0 = int(soft.sum()), Y @ origin
        return cls(
            Y @ basis,
            lower - y_0,
            upper - y_0,
            w,
            np.pad(tables.Q, (0, more)),
            tables.R,
            tables.K @ basis,
            tables.K @ origin + tables.k,
            np.pad(tables.F, ((0, 0), (0, more))),
            basis.T @ P @ basis,
            basis.T @ (P @ origin + tables.g),
            float(origin @ P @ origin / 2 + tables.g @ origin + tables.c),
            np.abs(Y).sum(1) * np.abs(basis).max(),
        )

    def solve(self, s: Array) -> tuple[Array, Array, Array]:
        """Return the rows' choices and multipliers at points s, and the solver's status."""
        y, r = s @ self.Y.T, len(self.R)
        lower, upper = self.lower - y, self.upper - y
        solution = solve_rows(self.R, lower[:, :r], upper[:, :r], self.w[:r])
        known = (2 * ((upper < 0) * 1 - (lower > 0)))[:, r:]
        active = np.concatenate((solution.active.numpy(), known.astype(np.int8)), axis=1)
        lam = np.concatenate((solution.lam.numpy(), known / 2 * self.w[r:]), axis=1)
        return active, lam, solution.status.numpy()

    def independent(self, active: Array, lam: Array) -> Array:
        """Return a choice without dependent held rows, by moves that change neither y nor u.

        A row with equal bounds is held at the upper one.
        """
        active, lam = active.copy(), lam.copy()
        active[(active == -1) & (self.lower == self.upper)] = 1
        while len(held := np.flatnonzero(abs(active) == 1)):
            left, sizes, _ = np.linalg.svd(self.R[held])
            if len(held) <= len(sizes) and sizes[-1] > DEPENDENT:
                break
            move, equal = left[:, -1], self.lower[held] == self.upper[held]
            move = move * np.sign(move[abs(move).argmax()])
            low = np.where(equal | (active[held] < 0), -self.w[held], 0)
            high = np.where(equal | (active[held] > 0), self.w[held], 0)
            with np.errstate(divide="ignore", invalid="ignore"):
                room = np.where(move > 0, high - lam[held], low - lam[held]) / move
            room[abs(move) < DEPENDENT] = np.inf
            at = room.argmin() if np.isfinite(room.min()) else abs(move).argmax()
            if np.isfinite(room[at]):
                lam[held] += room[at] * move
                end = (high if move[at] > 0 else low)[at]
            else:  # equal hard rows on both sides
                lam[held] -= lam[held[at]] / move[at] * move
                end = 0
            active[held[at]] = 2 * np.sign(end)
        return active

    def region(self, active: Array, states: Polytope) -> Region | None:
        """Return the part of ``states`` on which the choice is optimal; None if it is flat."""
        side, held, saturated = np.sign(active), abs(active) == 1, abs(active) == 2
        bound = np.where(side > 0, self.upper, self.lower)
        w = np.where(saturated, self.w, 0)
        L, l_0 = np.zeros_like(self.Y), side * w
        right = np.column_stack((self.Y, -self.Q @ l_0 - np.where(held, bound, 0)))[held]
        solved = np.linalg.solve(self.Q[np.ix_(held, held)], right)
        L[held], l_0[held] = solved[:, :-1], solved[:, -1]
        Y, y_0 = self.Y - self.Q @ L, -self.Q @ l_0
        size = self.size + np.abs(self.Q) @ np.abs(L).sum(1)
        up, low, equal = side > 0, side < 0, held & (self.lower == self.upper)
        y_low = np.where(active == 0, self.lower, np.where(saturated & up, self.upper, -np.inf))
        y_high = np.where(active == 0, self.upper, np.where(saturated & low, self.lower, np.inf))
        lam_low = np.where(held, np.where(equal | low, -self.w, 0), -np.inf)
        lam_high = np.where(held, np.where(equal | up, self.w, 0), np.inf)
        A = np.concatenate((states.A, Y, -Y, L, -L))
        b = np.concatenate((states.b, y_high - y_0, y_0 - y_low, lam_high - l_0, l_0 - lam_low))
        terms = np.concatenate((np.abs(states.A).sum(1), size, size, 1 + 0 * size, 1 + 0 * size))
        kept = np.isfinite(b) & (np.abs(A).sum(1) > CONSTANT * terms)
        body = facets(A[kept], b[kept])
        if body is None:
            return None
        polytope = Polytope(body.A, body.b, body.vertices.min(0), body.vertices.max(0))
        # V = v_free + lam'Q lam / 2 + sum over saturated rows of lam (y - bound)
        S = saturated
        P = self.P + L.T @ self.Q @ L
        g = self.g + L.T @ self.Q @ l_0 + Y[S].T @ l_0[S]
        c = self.c + l_0 @ self.Q @ l_0 / 2 + l_0[S] @ (y_0 - bound)[S]
        K, k = self.K - self.F @ L, self.k - self.F @ l_0
        return Region(polytope, body.vertices, K, k, P, g, float(c), active)
