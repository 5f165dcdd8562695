"""``task=short_horizon``: a horizon too short for a tight input, learned with the exact model."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

from omegaconf import DictConfig

from torch_qpmpc.envs import TripleIntegrator
from torch_qpmpc.envs.closed_loop import plant_loop
from torch_qpmpc.envs.linear_system import float64
from torch_qpmpc.experiment.fields import Positive
from torch_qpmpc.experiment.rivals.heavier import heavier
from torch_qpmpc.experiment.tasks.registry import (
    Task,
    TaskSettings,
    named,
    plant_layout,
    plant_scheme,
    register,
)
from torch_qpmpc.mpc.model import Model
from torch_qpmpc.mpc.scheme import Scheme

#: Closed loops of an evaluation.
STARTS = 256
#: Factor of the weight of the action in MPC that is tuned by hand: the best of 10, 100 and 1000.
HEAVIER = 100.0
#: The horizon of the true scheme, beyond which a longer one costs the same.
LONG = 30


class ShortHorizonSettings(TaskSettings):
    """The keys of `TripleIntegrator`."""

    #: Bound of the absolute action.
    a_max: Positive


def make_plant(cfg: DictConfig) -> TripleIntegrator:
    bound = cfg.task.a_max
    return TripleIntegrator(horizon=cfg.task.horizon, lb_a=float64(-bound)(), ub_a=float64(bound)())


def wrong_scheme(cfg: DictConfig, plant: TripleIntegrator) -> Scheme:
    """Return MPC with the true model and cost, which is optimal while no bound is active."""
    return plant_scheme(cfg, plant, Model(plant.A, plant.B), plant.W)


def true_scheme(cfg: DictConfig, plant: TripleIntegrator) -> Scheme:
    """Return the same scheme without discount, with the horizon `LONG`."""
    return replace(wrong_scheme(cfg, plant), layout=plant_layout(plant, LONG), gamma=1.0)


register(
    Task(
        "short_horizon",
        make_plant,
        wrong_scheme,
        true_scheme,
        closed_loop=partial(plant_loop, starts=STARTS),
        rivals=heavier(HEAVIER),
        nominal_scheme=wrong_scheme,
        episode=named(("position", "velocity", "acceleration"), ("jerk",)),
        settings=ShortHorizonSettings,
        defaults=None,
    )
)
