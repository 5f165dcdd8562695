"""Bounded polytopes: sets of states and of disturbances."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import linprog
from scipy.spatial import HalfspaceIntersection, QhullError

from torch_qpmpc.errors import QPError

Array = np.ndarray
#: Radius of the largest ball in a set that counts as flat, relative to the ball's place.
FLAT = 1e-9
#: Vertices are enumerated up to this dimension, not counting entries that a box fixes.
MOST_DIMENSIONS = 8


def support(A: Array, b: Array, row: Array) -> float:
    """Return the support function, max row'x with A x <= b; -inf if empty, nan if undecided."""
    result = linprog(-row, A_ub=A, b_ub=b, bounds=(None, None), method="highs")
    return -result.fun if result.status == 0 else {2: -np.inf, 3: np.inf}.get(result.status, np.nan)


class Body(NamedTuple):
    """Facets ``A x <= b`` with rows of length 1, and vertices ``(count, n)``."""

    A: Array
    b: Array
    vertices: Array


def facets(A: Array, b: Array) -> Body | None:
    """Return the facets and vertices of the bounded set ``A x <= b``; None if it is flat or empty.

    Rows are not zero.
    """
    length, n = np.linalg.norm(A, axis=1), A.shape[1]
    A, b = A / length[:, None], b / length
    # Of rows with the same normal the tightest is kept.
    order = np.lexsort((b, *A.round(9).T))
    A, b = A[order], b[order]
    first = np.append(True, (np.diff(A.round(9), axis=0) != 0).any(1))
    A, b = A[first], b[first]
    bounds, with_radius = [(None, None)] * n + [(0, None)], np.column_stack((A, np.ones(len(b))))
    inner = linprog([0] * n + [-1], with_radius, b, bounds=bounds, method="highs")
    if inner.status != 0 or inner.x[-1] <= FLAT * (1 + np.abs(inner.x[:n]).max()):
        return None
    if n == 1:
        ends = [np.flatnonzero(A[:, 0] > 0), np.flatnonzero(A[:, 0] < 0)]
        kept = np.array([i[b[i].argmin()] for i in ends])
        return Body(A[kept], b[kept], (b[kept] * A[kept, 0])[:, None])
    cut = HalfspaceIntersection(np.column_stack((A, -b)), inner.x[:n])
    kept = np.unique(np.concatenate(cut.dual_facets))
    return Body(A[kept], b[kept], np.unique(cut.intersections.round(14), axis=0))


@dataclass(frozen=True, eq=False)
class Polytope:
    """The points x with ``A x <= b``, a bounded set.

    Attributes:
        A, b: ``(m, n)`` and ``(m,)``.
        lower, upper: the bounding box, ``(n,)`` each.

    Raises:
        QPError: the shapes do not fit, entries are not finite, or the set is empty or unbounded.
    """

    A: Array
    b: Array
    lower: Array
    upper: Array

    @classmethod
    def of(cls, A: Any, b: Any) -> Polytope:
        """Make ``{x: A x <= b}``."""
        A, b = np.array(A, float), np.array(b, float)
        if A.ndim != 2 or b.shape != A.shape[:1]:
            got = f"shapes {A.shape} and {b.shape}"
            raise QPError.expected("A and b of the polytope", got, "(m, n) and (m,)")
        if not (np.isfinite(A).all() and np.isfinite(b).all()):
            raise QPError.expected("A and b of the polytope", "NaN or inf", "finite entries")
        ends = [
            support(A, b, row) for row in np.concatenate((np.eye(A.shape[1]), -np.eye(A.shape[1])))
        ]
        for end in ends:
            if not np.isfinite(end):
                kind = {-np.inf: "an empty", np.inf: "an unbounded"}.get(end, "an undecided")
                raise QPError.expected("A and b of the polytope", f"{kind} set", "a bounded one")
        upper, lower = np.array(ends[: A.shape[1]]), -np.array(ends[A.shape[1] :])
        return cls(A, b, lower, upper)

    @classmethod
    def box(cls, lower: Any, upper: Any) -> Polytope:
        """Make ``{x: lower <= x <= upper}``."""
        lower, upper = np.array(lower, float), np.array(upper, float)
        if lower.ndim != 1 or lower.shape != upper.shape:
            got = f"shapes {lower.shape} and {upper.shape}"
            raise QPError.expected("lower and upper", got, "(n,) each")
        if not (np.isfinite(lower).all() and np.isfinite(upper).all() and (lower <= upper).all()):
            raise QPError.expected(
                "lower and upper", f"{lower} and {upper}", "finite entries with lower <= upper"
            )
        eye = np.eye(len(lower))
        return cls(np.concatenate((eye, -eye)), np.concatenate((upper, -lower)), lower, upper)

    def is_box(self) -> bool:
        """Return True if the set is its bounding box."""
        return bool(((self.A != 0).sum(1) <= 1).all())

    def vertices(self) -> Array:
        """Return the vertices, ``(count, n)``.

        Raises:
            QPError: more than 8 entries vary, or the set has no interior and is no box.
        """
        n, ends = len(self.lower), [sorted({*x}) for x in zip(self.lower, self.upper, strict=True)]
        if (varying := sum(len(x) - 1 for x in ends)) > MOST_DIMENSIONS:
            got, want = f"{varying} dimensions", f"at most {MOST_DIMENSIONS}"
            raise QPError.expected("the set", got, want)
        if self.is_box():
            return np.array(list(itertools.product(*ends)))
        length = np.linalg.norm(self.A, axis=1)
        with_radius = np.column_stack((self.A, length))
        bounds = [(None, None)] * n + [(0, None)]
        inner = linprog([0] * n + [-1], with_radius, self.b, bounds=bounds, method="highs")
        try:
            cut = HalfspaceIntersection(np.column_stack((self.A, -self.b)), inner.x[:n])
        except QhullError as error:
            raise QPError.expected("the set", "a flat polytope", "one with an interior") from error
        return cut.intersections[np.isfinite(cut.intersections).all(1)]
