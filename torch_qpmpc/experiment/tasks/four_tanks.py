"""``task=four_tanks``: tanks whose noisy outputs are driven to a set point, learned from a log."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from omegaconf import DictConfig
from torch import Tensor

from torch_qpmpc.envs import FourTanks
from torch_qpmpc.envs.closed_loop import plant_loop
from torch_qpmpc.experiment.fields import Count
from torch_qpmpc.experiment.rivals.tanks import FOUR_TANKS_RIVALS
from torch_qpmpc.experiment.tasks.registry import Task, TaskSettings, priced, register
from torch_qpmpc.experiment.tracking import set_point_scheme, window_model
from torch_qpmpc.mpc.model import Model
from torch_qpmpc.mpc.scheme import Scheme

#: Largest errors of the wrong model: of an entry on A's diagonal, and of a pump's relative gain.
WRONG_LEAK, WRONG_GAIN = 0.04, 0.3


class FourTanksSettings(TaskSettings):
    """The keys of `FourTanks`."""

    #: Number of outputs in the window.
    past: Count


def make_plant(cfg: DictConfig) -> FourTanks:
    return FourTanks(horizon=cfg.task.horizon, past=cfg.task.past)


def wrong_scheme(cfg: DictConfig, plant: FourTanks) -> Scheme:
    """Draw the wrong model by ``cfg.seed``."""
    rng = np.random.default_rng(cfg.seed)
    leaks = torch.as_tensor(rng.uniform(-WRONG_LEAK, WRONG_LEAK, 4))
    gains = torch.as_tensor(rng.uniform(1 - WRONG_GAIN, 1 + WRONG_GAIN, 2))
    A, B = plant.A + torch.diag(leaks), plant.B * gains
    return _scheme(cfg, plant, A, B, cfg.task.gamma)


def true_scheme(cfg: DictConfig, plant: FourTanks) -> Scheme:
    """Return the scheme with the best prediction from the window, without discount."""
    return _scheme(cfg, plant, plant.A, plant.B, gamma=1.0)


def _scheme(cfg: DictConfig, plant: FourTanks, A: Tensor, B: Tensor, gamma: float) -> Scheme:
    model = Model(*window_model(A, B, *plant.measurement(), plant.past))
    scheme = set_point_scheme(plant, model, gamma)
    return replace(scheme, bounds=priced(cfg, scheme.bounds))


def episode(plant: FourTanks, d: Tensor) -> dict[str, Any]:
    """Show the set point of the measured levels."""
    return {
        "outputs": ["level 1", "level 2"],
        "actions": ["pump 1", "pump 2"],
        "references": plant.r.expand(len(d), -1),
    }


register(
    Task(
        "four_tanks",
        make_plant,
        wrong_scheme,
        true_scheme,
        closed_loop=plant_loop,
        rivals=FOUR_TANKS_RIVALS,
        episode=episode,
        settings=FourTanksSettings,
        defaults=None,
    )
)
