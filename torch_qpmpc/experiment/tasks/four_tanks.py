"""``task=four_tanks``: tanks whose noisy outputs are driven to a set point, learned from a log."""

from __future__ import annotations

import numpy as np
import torch
from omegaconf import DictConfig
from torch import Tensor

from torch_qpmpc.envs import FourTanks
from torch_qpmpc.envs.closed_loop import plant_loop
from torch_qpmpc.experiment.fields import Count
from torch_qpmpc.experiment.tasks.registry import Scheme, Task, TaskSettings, register
from torch_qpmpc.experiment.tracking import INPUT_WEIGHT, set_point_options, window_model

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
    return _scheme(plant, A, B, cfg.task.gamma)


def true_scheme(plant: FourTanks) -> Scheme:
    """Return the scheme with the best prediction from the window, without discount."""
    return _scheme(plant, plant.A, plant.B, gamma=1.0)


def _scheme(plant: FourTanks, A: Tensor, B: Tensor, gamma: float) -> Scheme:
    options = set_point_options(plant, gamma, INPUT_WEIGHT)
    model = window_model(A, B, *plant.measurement(), plant.past)
    free = plant.r.new_full((plant.n_y,), torch.inf)
    return Scheme(*model, options["stage_weight"], -free, free, options=options)


register(
    Task(
        "four_tanks",
        make_plant,
        wrong_scheme,
        true_scheme,
        closed_loop=plant_loop,
        settings=FourTanksSettings,
        defaults=None,
    )
)
