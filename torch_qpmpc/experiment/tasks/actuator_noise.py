"""``task=actuator_noise``: noise that multiplies the action, learned from the model of the mean.

With ``task.hidden_velocity=true`` only the position is measured, and the policy sees a window.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

from omegaconf import DictConfig
from torch import Tensor

from torch_qpmpc.envs.actuator_noise import ActuatorNoise, HiddenVelocity
from torch_qpmpc.envs.closed_loop import plant_loop
from torch_qpmpc.envs.linear_system import float64
from torch_qpmpc.experiment.fields import Flag, NonNegative, Positive
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
from torch_qpmpc.mpc.riccati import noisy_stage_weight
from torch_qpmpc.mpc.scheme import Scheme

#: Closed loops of an evaluation; costs under this noise have heavy tails.
STARTS = 256
#: Factors of the action's weight in MPC that is tuned by hand: the better ones of 3, 10 and 30.
HEAVIER = 10.0, 30.0
#: The least horizon of a window's true scheme, whose terminal weight is the position's alone.
LONG = 30


class ActuatorNoiseSettings(TaskSettings):
    """The keys of `ActuatorNoise` and `HiddenVelocity`."""

    #: Standard deviation of the factor of the action.
    actuator_std: NonNegative
    #: Bound of the absolute action.
    a_max: Positive
    #: Only the position is measured.
    hidden_velocity: Flag


def make_plant(cfg: DictConfig) -> ActuatorNoise:
    task = cfg.task
    kind = HiddenVelocity if task.hidden_velocity else ActuatorNoise
    return kind(
        horizon=task.horizon,
        lb_a=float64(-task.a_max)(),
        ub_a=float64(task.a_max)(),
        actuator_std=task.actuator_std,
    )


def wrong_scheme(cfg: DictConfig, plant: ActuatorNoise) -> Scheme:
    """Return MPC with the true mean and the plant's cost: certainty equivalence."""
    return _scheme(cfg, plant, plant.W)


def true_scheme(cfg: DictConfig, plant: ActuatorNoise) -> Scheme:
    """Return the same scheme with the weight of the noise, optimal while no bound is active.

    That of a window has the horizon `LONG` or more.
    """
    std, delay = plant.A.new_tensor([plant.actuator_std]), plant.past - 1
    weight = noisy_stage_weight(plant.A, plant.B, plant.W, cfg.task.gamma, std, delay)
    scheme = _scheme(cfg, plant, weight)
    if not delay:
        return scheme
    return replace(scheme, layout=plant_layout(plant, max(LONG, plant.horizon)))


def _scheme(cfg: DictConfig, plant: ActuatorNoise, weight: Tensor) -> Scheme:
    A, B, _ = plant.true_model()
    seen = [*range(plant.n_y), -1]  # of the position, the velocity and the action
    scheme = plant_scheme(cfg, plant, Model(A, B), weight[seen][:, seen])
    if plant.past == 1:
        return scheme
    return replace(scheme, cost=replace(scheme.cost, terminal_weight=weight[:1, :1]))


register(
    Task(
        "actuator_noise",
        make_plant,
        wrong_scheme,
        true_scheme,
        closed_loop=partial(plant_loop, starts=STARTS),
        rivals=heavier(*HEAVIER),
        nominal_scheme=wrong_scheme,
        episode=named(("position", "velocity"), ("acceleration",)),
        settings=ActuatorNoiseSettings,
        defaults=None,
    )
)
