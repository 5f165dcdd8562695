"""A controller that learned ones are compared with, as a task's file names it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

#: The name of `zero_action` among a task's rivals.
ZERO_ACTION = "zero action"
#: The name of MPC with the model of all of a run's transitions, a rival of each task.
IDENTIFICATION = "identification"
#: Maps p ``(starts, n_p)`` to actions ``(starts, n_u)``; see `plant_loop`.
Policy = Callable[[Tensor], Tensor]


@dataclass(frozen=True)
class Rival:
    """How to make a policy for a task's plant.

    Attributes:
        make: makes the policy for the plant that it sees.
        sees: fields in which that plant differs from the task's, such as a longer ``horizon``.
        slow: True if ``rivals=true`` leaves it out, because its closed loop takes many seconds.
    """

    make: Callable[[Any], Policy]
    sees: Mapping[str, int] = field(default_factory=dict)
    slow: bool = False

    def of(self, plant: Any) -> tuple[Policy, Any]:
        """Return the policy, and the plant that it sees."""
        seen = replace(plant, **self.sees) if self.sees else plant
        return self.make(seen), seen


def zero_action(plant: Any) -> Policy:
    """Make the policy that applies zero or, if the bounds exclude it, the nearest action."""
    action = torch.zeros_like(plant.lb_a).clamp(plant.lb_a, plant.ub_a)
    return lambda s: action.expand(len(s), -1)
