"""Linear plants with disturbances of a polytope."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from torch_qpmpc.checks import check_kind
from torch_qpmpc.errors import QPError
from torch_qpmpc.proofs.polytope import Polytope

Array = np.ndarray


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
        A, B = np.array(A, float), np.array(B, float)
        n = len(A)
        offset = np.zeros(n) if offset is None else np.array(offset, float)
        n_d = 0 if disturbances is None else len(disturbances.lower)
        E = (np.eye(n) if n_d == n else np.zeros((n, 0))) if E is None else np.array(E, float)
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
