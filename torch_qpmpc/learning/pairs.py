"""Visited pairs (s, a) that an update can learn from."""

from __future__ import annotations

import warnings

from torch import Tensor


def usable(solved: Tensor, target: Tensor) -> tuple[Tensor, tuple[int, int]]:
    """Return which pairs have a solution and a finite target, and how many lack each.

    A pair that lacks both counts for its solution. If none is left, a `RuntimeWarning` says so.

    Args:
        solved: True for a pair with a solution, ``(B,)``.
        target: ``(B,)``.
    """
    use = solved & target.isfinite()
    unsolved = int((~solved).sum())
    left_out = unsolved, len(use) - unsolved - int(use.sum())
    if sum(left_out) == len(use):
        message = (
            f"None of the {len(use)} pairs is usable: {unsolved} without a QP solution, "
            f"{left_out[1]} without a finite target. Theta stays unchanged."
        )
        warnings.warn(message, RuntimeWarning, stacklevel=3)
    return use, left_out
