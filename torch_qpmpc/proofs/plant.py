"""Linear plants with bounded disturbances, and the polytopes of their states and disturbances."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import linprog
from scipy.spatial import HalfspaceIntersection, QhullError

from torch_qpmpc.checks import check_kind
from torch_qpmpc.errors import QPError
from torch_qpmpc.mpc.validation import as_tensor

Array = np.ndarray
#: Vertices are enumerated up to this dimension, not counting entries that a box fixes.
MOST_DIMENSIONS = 8


def _array(name: str, value: Any) -> Array:
    return as_tensor(name, value).detach().numpy().copy()


def positive(x: Array, otherwise: Any = 1.0) -> Array:
    """Return the entries of x, and ``otherwise`` where they are zero."""
    return np.where(x > 0, x, otherwise)


def support(A: Array, b: Array, row: Array) -> float:
    """Return the support function, max row'x with A x <= b; -inf if empty, nan if undecided."""
    result = linprog(-row, A, b, bounds=(None, None), options={"presolve": False})  # it may err
    return -result.fun if result.status == 0 else {2: -np.inf, 3: np.inf}.get(result.status, np.nan)


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
        A, b = _array("A", A), _array("b", b)
        if A.ndim != 2 or b.shape != A.shape[:1]:
            got = f"shapes {A.shape} and {b.shape}"
            raise QPError.expected("A and b of the polytope", got, "(m, n) and (m,)")
        eye = np.eye(A.shape[1])
        upper, lower = (np.array([support(A, b, row) for row in rows]) for rows in (eye, -eye))
        for end in (*upper, *lower):
            if not np.isfinite(end):
                kind = {-np.inf: "an empty", np.inf: "an unbounded"}.get(end, "an undecided")
                raise QPError.expected("A and b of the polytope", f"{kind} set", "a bounded one")
        return cls(A, b, -lower, upper)

    @classmethod
    def box(cls, lower: Any, upper: Any) -> Polytope:
        """Make ``{x: lower <= x <= upper}``."""
        lower, upper = _array("lower", lower), _array("upper", upper)
        if lower.ndim != 1 or lower.shape != upper.shape:
            got = f"shapes {lower.shape} and {upper.shape}"
            raise QPError.expected("lower and upper", got, "(n,) each")
        if (lower > upper).any():
            raise QPError.expected("lower and upper", f"{lower} and {upper}", "lower <= upper")
        eye = np.eye(len(lower))
        return cls(np.concatenate((eye, -eye)), np.concatenate((upper, -lower)), lower, upper)

    @property
    def size(self) -> Array:
        """The largest absolute value of each entry, ``(n,)``."""
        return np.maximum(np.abs(self.lower), np.abs(self.upper))

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
            raise QPError.expected("the set", f"{varying} dimensions", f"at most {MOST_DIMENSIONS}")
        if self.is_box():
            return np.array(list(itertools.product(*ends)))
        with_radius = np.column_stack((self.A, np.linalg.norm(self.A, axis=1)))
        inner = linprog([0] * n + [-1], with_radius, self.b, bounds=(None, None), method="highs")
        try:
            cut = HalfspaceIntersection(np.column_stack((self.A, -self.b)), inner.x[:n])
        except QhullError as error:
            raise QPError.expected("the set", "a flat polytope", "one with an interior") from error
        return cut.intersections[np.isfinite(cut.intersections).all(1)]


@dataclass(frozen=True, eq=False)
class Plant:
    """``x+ = A x + B u + offset + E d`` with any d of a polytope.

    Attributes:
        A, B: ``(n, n)`` and ``(n, n_u)``; x is all that the policy knows, p.
        offset: ``(n,)``.
        E: ``(n, n_d)``.
        disturbances: the set of d.
    """

    A: Array
    B: Array
    offset: Array
    E: Array
    disturbances: Polytope | None

    @classmethod
    def of(
        cls,
        A: Any,
        B: Any,
        *,
        offset: Any = None,
        E: Any = None,
        disturbances: Polytope | None = None,
    ) -> Plant:
        """Make a plant; E is the identity, and there are no disturbances, by default.

        Raises:
            QPError: the shapes do not fit.
        """
        A, B = _array("A", A), _array("B", B)
        n = len(A)
        offset = np.zeros(n) if offset is None else _array("offset", offset)
        n_d = 0
        if disturbances is not None:
            check_kind("disturbances", disturbances, Polytope, "Make one with Polytope.box.")
            n_d = len(disturbances.lower)
        E = (np.eye(n) if n_d == n else np.zeros((n, 0))) if E is None else _array("E", E)
        shapes = A.shape, B.shape[:1], B.ndim, offset.shape, E.shape
        if shapes != ((n, n), (n,), 2, (n,), (n, n_d)):
            got = f"shapes {A.shape}, {B.shape}, {offset.shape} and {E.shape}"
            want = f"(n, n), (n, n_u), (n,) and (n, {n_d})"
            raise QPError.expected("A, B, offset and E", got, want)
        return cls(A, B, offset, E, disturbances)


def check_plants(plant: Plant | Sequence[Plant], n_p: int, n_u: int) -> list[Plant]:
    """Return the plants; raise unless there is one, and each fits the policy."""
    plants = list(plant) if isinstance(plant, Sequence) else [plant]
    if not plants:
        raise QPError.expected("plant", "an empty list", "at least one Plant")
    for one in plants:
        check_kind("plant", one, Plant, "Make one with Plant.of(A, B).")
        if one.B.shape != (n_p, n_u):
            want = f"({n_p}, {n_u}), for p and u"
            raise QPError.expected("plant.B", f"shape {one.B.shape}", want)
    return plants
