"""The two exceptions of the package: bad input, and a QP that could not be solved."""

from __future__ import annotations


class QPError(ValueError):
    """Bad input: names the argument, what came, what was expected, and the remedy."""

    @classmethod
    def expected(cls, name: str, got: object, expected: str, remedy: str = "") -> QPError:
        """The one form that every message about bad input takes."""
        tail = f" {remedy}" if remedy else ""
        return cls(f"{name}: got {got}, expected {expected}.{tail}")


class SolverError(RuntimeError):
    """A QP has no certified solution: infeasible, unbounded, or not solved to tolerance."""
