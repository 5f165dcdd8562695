"""Steady states of closed loops of random plants, beside an independent search for the nearest.

``PLANTS=200 pytest tests/control/test_offset.py`` draws more; `tests.campaign.units` has C, too.
"""

import os
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from tests.control.controllers import Plant, designed, drawn

#: The inputs for outputs and set-points.
Step = Callable[[np.ndarray, np.ndarray], Any]
PLANTS = int(os.environ.get("PLANTS", "5"))
#: The loop has settled when no state moves by more; it is cut off after so many steps.
STILL, STEPS = 1e-11, 3000
OFFSET = 1e-6


def settled(plant: Plant, step: Step) -> np.ndarray:
    x = np.zeros(len(plant.A))
    for k in range(STEPS):
        u = step(plant.C @ x + plant.bias, plant.r)
        before, x = x, plant.A @ x + plant.B @ (u + plant.load)
        if k > 50 and np.abs(x - before).max() < STILL:
            break
    return plant.C @ x + plant.bias


@pytest.mark.parametrize("seed", range(PLANTS))
def test_the_loop_settles_at_the_set_point_or_the_nearest_outputs(seed):
    plant = drawn(seed)
    nearest, controller = plant.nearest(), designed(plant, seed)
    assert nearest is not None, "the loads are smaller than the bounds"
    outputs = settled(plant, controller.step)
    assert np.abs(outputs - nearest).max() < OFFSET * max(1.0, np.abs(plant.r).max())
