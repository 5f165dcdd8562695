"""Costs J of a run in numbers and words."""

from __future__ import annotations

import math


def closed_gap(J_start: float, J_final: float, J_true_model: float) -> float:
    """Return the share of the gap from the start to the true-model MPC that learning has closed.

    It is (J_start - J_final) / (J_start - J_true_model): 0 is no gain, 1 equals the true model. It
    is nan if the start is no worse than the true model, or a J is nan.

    Example:
        >>> closed_gap(J_start=100.0, J_final=60.0, J_true_model=50.0)
        0.8
    """
    gap = J_start - J_true_model
    return (J_start - J_final) / gap if gap > 0 else math.nan


def gap_text(
    gap: float, J_start: float, J_final: float, J_true_model: float, name: str = "J"
) -> str:
    """Return a closed gap to three decimals or, if it is nan, the reason and the change of J.

    Example:
        >>> gap_text(math.nan, 50.0, 62.3, 50.0)
        'no gap; J rose by 12.30'
    """
    if not math.isnan(gap):
        return f"{gap:.3f}"
    reason = "no true model" if math.isnan(J_true_model) else "no gap"
    change = J_final - J_start
    if not math.isfinite(change):
        return f"{reason}; {name} went from {cost_text(J_start)} to {cost_text(J_final)}"
    if cost_text(J_start) == cost_text(J_final):
        return f"{reason}; {name} did not change"
    return f"{reason}; {name} {'rose' if change > 0 else 'fell'} by {cost_text(abs(change))}"


def cost_text(J: float) -> str:
    """Return a cost with four significant digits, or all digits before the point.

    Example:
        >>> cost_text(20.9), cost_text(0.12345), cost_text(40827.4)
        ('20.90', '0.1235', '40827')
    """
    return f"{J:.0f}" if 999.95 <= abs(J) < math.inf else f"{J:#.4g}"
