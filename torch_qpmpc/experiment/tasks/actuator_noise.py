"""``task=actuator_noise``: noise that multiplies the action, learned from the model of the mean."""

from __future__ import annotations

from functools import partial

from omegaconf import DictConfig
from torch import Tensor

from torch_qpmpc.envs import ActuatorNoise
from torch_qpmpc.envs.closed_loop import plant_loop
from torch_qpmpc.envs.linear_system import float64
from torch_qpmpc.experiment.fields import NonNegative, Positive
from torch_qpmpc.experiment.tasks.registry import Task, TaskSettings, named, plant_scheme, register
from torch_qpmpc.mpc.model import Model
from torch_qpmpc.mpc.riccati import noisy_stage_weight
from torch_qpmpc.mpc.scheme import Scheme

#: Closed loops of an evaluation; costs under this noise have heavy tails.
STARTS = 256


class ActuatorNoiseSettings(TaskSettings):
    """The keys of `ActuatorNoise`."""

    #: Standard deviation of the factor of the action.
    actuator_std: NonNegative
    #: Bound of the absolute action.
    a_max: Positive


def make_plant(cfg: DictConfig) -> ActuatorNoise:
    task = cfg.task
    return ActuatorNoise(
        horizon=task.horizon,
        lb_a=float64(-task.a_max)(),
        ub_a=float64(task.a_max)(),
        actuator_std=task.actuator_std,
    )


def wrong_scheme(cfg: DictConfig, plant: ActuatorNoise) -> Scheme:
    """Return MPC with the true mean and the plant's cost: certainty equivalence."""
    return _scheme(cfg, plant, plant.W)


def true_scheme(cfg: DictConfig, plant: ActuatorNoise) -> Scheme:
    """Return the same scheme with the weight of the noise, optimal while no bound is active."""
    A, B, _ = plant.true_model()
    std = A.new_tensor([plant.actuator_std])
    return _scheme(cfg, plant, noisy_stage_weight(A, B, plant.W, cfg.task.gamma, std))


def _scheme(cfg: DictConfig, plant: ActuatorNoise, weight: Tensor) -> Scheme:
    A, B, _ = plant.true_model()
    return plant_scheme(cfg, plant, Model(A, B), weight)


register(
    Task(
        "actuator_noise",
        make_plant,
        wrong_scheme,
        true_scheme,
        closed_loop=partial(plant_loop, starts=STARTS),
        nominal_scheme=wrong_scheme,
        episode=named(("position", "velocity"), ("acceleration",)),
        settings=ActuatorNoiseSettings,
        defaults=None,
    )
)
