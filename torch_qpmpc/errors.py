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
    """Return ``text`` without characters that control a terminal, which a file may have brought.

    Example:
        >>> printable("a\\x1b[31mb")
        'a\\\\x1b[31mb'
    """
    return "".join(
        x if x.isprintable() or x in "\n\t" else x.encode("unicode_escape").decode() for x in text
    )


class SolverError(RuntimeError):
    """A QP has no certified solution: it is infeasible, unbounded, or not solved to tolerance.

    Example:
        >>> import torch, torch_qpmpc as qm
        >>> bounds = {"state_bounds": ([-1.0], [1.0]), "state_slack": torch.inf}
        >>> mpc = qm.QPMPC.of(1, 1, 3, **bounds)
        >>> mpc.value(torch.tensor([2.0]))  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        ...
        torch_qpmpc.errors.SolverError: 1 of 1 QPs have no certified solution. 1 INFEASIBLE: ...
    """
