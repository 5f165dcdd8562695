"""The package's two exceptions: invalid input, and a QP without a certified solution."""

from __future__ import annotations


class QPError(ValueError):
    """Invalid input. The message names the argument, what it got, what it expected, and a remedy.

    Example:
        >>> import torch_qpmpc as qm
        >>> qm.QPMPC.of(2, 1, horizon=0)
        Traceback (most recent call last):
        ...
        torch_qpmpc.errors.QPError: horizon: got 0, expected a whole number >= 1.
    """

    @classmethod
    def expected(cls, name: str, got: object, expected: str, remedy: str = "") -> QPError:
        """Return the error ``{name}: got {got}, expected {expected}. {remedy}``."""
        tail = f" {remedy}" if remedy else ""
        return cls(printable(f"{name}: got {got}, expected {expected}.{tail}"))


def printable(text: str) -> str:
    """Return ``text`` without characters that control a terminal, which a file may have brought."""
    return "".join(
        x if x.isprintable() or x in "\n\t" else x.encode("unicode_escape").decode() for x in text
    )


class SolverError(RuntimeError):
    """A QP has no certified solution: it is infeasible, unbounded, or not solved to tolerance."""
