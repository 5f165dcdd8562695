"""Steady states of closed loops of random plants, beside an independent search for the nearest.

The slow tests draw 8 plants, in Python and in C, and 200 with
``PLANTS=200 pytest -m slow tests/control/test_offset.py``.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import torch_qpmpc as qm
from tests.control.controllers import Plant, designed, drawn, load

#: The inputs for outputs and set-points.
Step = Callable[[np.ndarray, np.ndarray], Any]
PLANTS = int(os.environ.get("PLANTS", "8"))
#: The loop has settled when no state moves by more; it is cut off after so many steps.
STILL, STEPS = 1e-11, 3000
OFFSET = 1e-6


def compiled(controller: qm.Controller, folder: Path) -> Step:
    """Return the step of the controller in C."""
    twin = load(controller.export_c(folder).files, controller)

    def step(y: np.ndarray, r: np.ndarray) -> np.ndarray:
        u, code = twin.step(y, r)
        assert code == 0
        return u

    return step


def settled(plant: Plant, step: Step) -> np.ndarray:
    """Return the outputs where the closed loop of the plant settles."""
    x = np.zeros(len(plant.A))
    for k in range(STEPS):
        u = step(plant.C @ x + plant.bias, plant.r)
        before, x = x, plant.A @ x + plant.B @ (u + plant.load)
        if k > 50 and np.abs(x - before).max() < STILL:
            break
    return plant.C @ x + plant.bias


def check(seed: int, folder: Path | None = None) -> None:
    """Compare the outputs where a loop settles; that of C if there is a folder for it."""
    plant = drawn(seed)
    nearest, controller = plant.nearest(), designed(plant, seed)
    assert nearest is not None, "the loads are smaller than the bounds"
    outputs = settled(plant, compiled(controller, folder) if folder else controller.step)
    assert np.abs(outputs - nearest).max() < OFFSET * max(1.0, np.abs(plant.r).max()), seed


@pytest.mark.parametrize("seed", range(5))
def test_the_loop_settles_at_the_set_point_or_the_nearest_outputs(seed):
    check(seed)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5, PLANTS))
def test_the_loops_of_many_plants_settle_there(seed):
    check(seed)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(PLANTS))
def test_the_loops_in_c_settle_there(seed, tmp_path):
    check(seed, tmp_path)
