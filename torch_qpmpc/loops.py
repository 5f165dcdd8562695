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
    policy: Callable[[Any], Any], known: Any, step: Callable[[Any], Step], steps: int
) -> Iterator[Step]:
    """Yield (known, action, cost) of each of at most ``steps`` steps.

    ``policy`` maps what it sees, first ``known``, to an action, and ``step`` moves the plant by it.
    """
    for _ in range(steps):
        stepped = step(policy(known))
        known = stepped.known
        yield stepped
