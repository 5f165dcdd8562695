"""The closed loop of a policy and a plant: one generator for evaluation, simulation and checks."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple


class Step(NamedTuple):
    """The outcome of a step of a plant.

    Attributes:
        known: what the policy sees next.
        action: the action, as the plant applied it.
        cost: the cost of the step, None if it is computed from all steps later.
    """

    known: Any
    action: Any
    cost: Any = None


def run_loop(
    policy: Callable[[Any], Any],
    known: Any,
    step: Callable[[Any], Step],
    steps: int,
    ends: type[Exception] | tuple[type[Exception], ...] = (),
) -> Iterator[Step]:
    """Yield (known, action, cost) of each step.

    Args:
        policy: maps what it sees to an action.
        known: what it sees first.
        step: moves the plant by an action.
        steps: the largest number of steps.
        ends: errors of the policy that end the loop.

    Example:
        >>> x = 1.0
        >>> def step(a):
        ...     global x
        ...     x, cost = 0.5 * x + a, x * x
        ...     return Step(x, a, cost)
        >>> [s.cost for s in run_loop(lambda x: -0.25 * x, x, step, 3)]
        [1.0, 0.0625, 0.00390625]
    """
    for _ in range(steps):
        try:
            action = policy(known)
        except ends:
            return
        stepped = step(action)
        known = stepped.known
        yield stepped
