"""A mixed-integer linear program that grows by variables and rows; HiGHS solves it."""

from __future__ import annotations

import copy
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import milp
from scipy.sparse import csr_array, vstack

from torch_qpmpc.checks import check_number
from torch_qpmpc.errors import SolverError

Array = np.ndarray
#: The status that scipy gives to an outcome of HiGHS without a name.
UNKNOWN = 4


@dataclass(frozen=True, eq=False)
class Affine:
    """``matrix x[columns] + constant`` with ``(m, k)``, ``(k,)``, ``(m,)``; x are variables."""

    columns: Array
    matrix: Array
    constant: Array

    def __add__(self, other: Affine) -> Affine:
        columns = np.concatenate((self.columns, other.columns))
        matrix = np.concatenate((self.matrix, other.matrix), axis=1)
        return Affine(columns, matrix, self.constant + other.constant)

    def times(self, left: Array) -> Affine:
        """Multiply by a matrix ``(l, m)`` from the left."""
        return Affine(self.columns, left @ self.matrix, left @ self.constant)

    def part(self, rows: Array | list[int]) -> Affine:
        """Return some of the rows."""
        return Affine(self.columns, self.matrix[rows], self.constant[rows])

    def plus(self, constant: Array) -> Affine:
        """Add a constant ``(m,)``."""
        return Affine(self.columns, self.matrix, self.constant + constant)

    def at(self, x: Array) -> Array:
        """Return the value ``(m,)`` at x."""
        return self.matrix @ x[self.columns] + self.constant


@dataclass(frozen=True, eq=False)
class Maximum:
    """The outcome of a maximisation."""

    value: float  # the objective at ``x``; -inf if no point was reached
    bound: float  # no point has a larger objective, but for the solver's tolerances
    x: Array  # the variables
    nodes: int  # nodes of the branch-and-bound tree


class Program:
    """Variables x with ``lower <= x <= upper``, some of them 0 or 1, and rows over them.

    It and its copies have so many ``seconds`` from now on.
    """

    def __init__(self, seconds: Any = np.inf) -> None:
        check_number("seconds", seconds, lambda x: x > 0, "a number of seconds > 0, or inf")
        self.until = time.perf_counter() + seconds
        self.lower, self.upper, self.binary = (np.zeros(0) for _ in range(3))
        self._rows: list[tuple[Affine, Array, Array]] = []
        self._built: tuple[csr_array, Array, Array] | None = None

    def copy(self) -> Program:
        """Return a program with the same variables and rows."""
        other = copy.copy(self)
        other._rows = list(self._rows)
        return other

    @property
    def binaries(self) -> int:
        """The number of binary variables."""
        return int(self.binary.sum())

    def add(self, lower: Array, upper: Array, *, binary: bool = False) -> Affine:
        """Add variables within bounds ``(m,)``."""
        m, start, self._built = len(lower), len(self.lower), None
        self.lower = np.concatenate((self.lower, lower))
        self.upper = np.concatenate((self.upper, upper))
        self.binary = np.concatenate((self.binary, np.full(m, float(binary))))
        return Affine(np.arange(start, start + m), np.eye(m), np.zeros(m))

    def constrain(self, rows: Affine, lower: Any = -np.inf, upper: Any = np.inf) -> None:
        """Add rows ``lower <= rows <= upper``."""
        m, self._built = len(rows.constant), None
        self._rows.append((rows, np.broadcast_to(lower, m), np.broadcast_to(upper, m)))

    def maximise(self, objective: Affine, *, relaxed: bool = False) -> Maximum:
        """Maximise one affine function; ``relaxed`` lets binaries lie between 0 and 1.

        The bound is infinite if HiGHS gives none in time.

        Raises:
            SolverError: the program is infeasible.
        """
        cost, relaxed = np.zeros(len(self.lower)), relaxed or not self.binaries
        np.add.at(cost, objective.columns, -objective.matrix[0])
        size = np.abs(cost).max(initial=0.0) or 1.0  # HiGHS' tolerances are absolute
        for presolve in (True, False):  # by presolve's round-off HiGHS can miss an optimum
            left = max(self.until - time.perf_counter(), 0.0)
            result = milp(
                cost / size,
                integrality=np.zeros(len(cost)) if relaxed else self.binary,
                bounds=(self.lower, self.upper),
                constraints=self._constraints(),
                options={"mip_rel_gap": 0.0, "time_limit": left, "presolve": presolve},
            )
            if result.status != UNKNOWN:
                break
        if result.status not in (0, 1):
            raise SolverError(f"HiGHS gave no bound of the worst case: {result.message}")
        bound = result.fun if relaxed else result.get("mip_dual_bound")
        bound, constant = -np.inf if bound is None else bound, float(objective.constant[0])
        value = -np.inf if result.fun is None else constant - size * result.fun
        x = result.x if result.x is not None else np.full(len(cost), np.nan)
        return Maximum(value, constant - size * bound, x, int(result.get("mip_node_count") or 0))

    def _constraints(self) -> tuple[csr_array, Array, Array]:
        if self._built is None:
            size, empty = len(self.lower), np.zeros(0)
            parts = [_sparse(affine, size) for affine, _, _ in self._rows]
            matrix = csr_array(vstack([csr_array((0, size)), *parts]))
            lower = [low - affine.constant for affine, low, _ in self._rows]
            upper = [up - affine.constant for affine, _, up in self._rows]
            self._built = matrix, np.concatenate([empty, *lower]), np.concatenate([empty, *upper])
        return self._built


def _sparse(affine: Affine, size: int) -> csr_array:
    """Return the matrix over ``size`` variables; columns that repeat add up."""
    m, k = affine.matrix.shape
    indices = np.repeat(np.arange(m), k), np.tile(affine.columns, m)
    matrix = csr_array((affine.matrix.ravel(), indices), (m, size))
    matrix.eliminate_zeros()
    return matrix
