"""``task=tank_references``: tanks that track known references, learned from a wrong model."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from omegaconf import DictConfig
from torch import Tensor

from torch_qpmpc.envs import TankReferences
from torch_qpmpc.envs.closed_loop import plant_loop
from torch_qpmpc.experiment.fields import Flag, Whole
from torch_qpmpc.experiment.rivals.tanks import TANK_REFERENCES_RIVALS
from torch_qpmpc.experiment.tasks.registry import Task, TaskSettings, register
from torch_qpmpc.experiment.tracking import offset_free, reference_scheme
from torch_qpmpc.mpc.model import Model
from torch_qpmpc.mpc.scheme import Scheme

#: Standard deviation of the disturbed variant's noise.
NOISE_STD = 0.1
#: Scale of the wrong model's error, in units of the disturbed variant's largest one.
MODEL_ERROR = 5.0


class TankReferencesSettings(TaskSettings):
    """The keys of `TankReferences`."""

    #: Noise, and other leaks and pump gains in each episode, as in the original's second table.
    disturbed: Flag
    #: Number of model errors whose mean corrects the predictions (`offset_free`); 0 for none.
    memory: Whole


def make_plant(cfg: DictConfig) -> TankReferences:
    task = cfg.task
    return TankReferences(
        horizon=task.horizon,
        past=1 + task.memory,
        noise_std=NOISE_STD * task.disturbed,
        mismatch=float(task.disturbed),
    )


def wrong_scheme(cfg: DictConfig, plant: TankReferences) -> Scheme:
    """Draw the wrong model by ``cfg.seed``."""
    rng = np.random.default_rng(cfg.seed)
    w = replace(plant, mismatch=MODEL_ERROR).signals(rng, 1, 1)[0, 0]
    A, B, _ = plant.model(w)
    return _scheme(cfg, plant, A, B, cfg.task.gamma)


def true_scheme(cfg: DictConfig, plant: TankReferences) -> Scheme:
    """Return the scheme with the nominal model, without discount."""
    return _scheme(cfg, plant, plant.A, plant.B, gamma=1.0)


def _scheme(cfg: DictConfig, plant: TankReferences, A: Tensor, B: Tensor, gamma: float) -> Scheme:
    if plant.past > 1:
        A, B = offset_free(A, B, plant.past - 1)
    scheme = reference_scheme(plant, Model(A, B), gamma)
    # The plant has the price of its states.
    return replace(scheme, bounds=replace(scheme.bounds, action_slack=cfg.task.action_slack))


def episode(plant: TankReferences, d: Tensor) -> dict[str, Any]:
    """Show the references and the bounds of the levels."""
    return {
        "outputs": [f"level {i}" for i in range(1, 5)],
        "actions": ["pump 1", "pump 2"],
        "band": (plant.lb_x, plant.ub_x),
        "references": d,
    }


register(
    Task(
        "tank_references",
        make_plant,
        wrong_scheme,
        true_scheme,
        closed_loop=plant_loop,
        rivals=TANK_REFERENCES_RIVALS,
        episode=episode,
        settings=TankReferencesSettings,
        defaults=None,
    )
)
