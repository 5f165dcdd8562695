"""``task=gros_zanon``: Gros and Zanon's linear system, learned from their wrong model."""

from __future__ import annotations

import torch
from omegaconf import DictConfig

from torch_qpmpc.envs import GrosZanonLTI
from torch_qpmpc.experiment.rivals import tightened
from torch_qpmpc.experiment.rivals.rival import Rival
from torch_qpmpc.experiment.tasks.registry import Scheme, Task, register


def wrong_scheme(cfg: DictConfig, plant: GrosZanonLTI) -> Scheme:
    """Return their wrong model; as in the original, the first upper bound is too wide by one."""
    wide = plant.ub_s + torch.tensor([1.0, 0.0]).to(plant.ub_s)
    return Scheme(*plant.wrong_model(), true_scheme(plant).stage_weight, plant.lb_s, wide)


def true_scheme(plant: GrosZanonLTI) -> Scheme:
    return Scheme.true(plant, plant.A.new_tensor([1.0, 1.0, 0.5]))


register(
    Task(
        "gros_zanon",
        lambda cfg: GrosZanonLTI(),
        wrong_scheme,
        true_scheme,
        noises=("uniform",),
        rivals={"tightened": Rival(tightened.gros_zanon)},
        defaults=None,
    )
)
