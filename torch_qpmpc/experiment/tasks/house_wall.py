"""``task=house_wall``: leap-c's house with a hidden wall, learned from a model without one."""

from __future__ import annotations

from dataclasses import replace

import torch
from omegaconf import DictConfig

from torch_qpmpc.envs import HouseWall
from torch_qpmpc.envs.closed_loop import plant_loop
from torch_qpmpc.envs.heated_house import DAY, DT, GAIN, OUTDOOR
from torch_qpmpc.envs.house_wall import C_E, C_I, G_A, R_EA, R_IE, SUN
from torch_qpmpc.experiment.heating import heating_scheme
from torch_qpmpc.experiment.rivals.houses import HOUSE_WALL_RIVALS
from torch_qpmpc.experiment.tasks.house import (
    HeatingSettings,
    episode,
    learned_scheme,
    masks,
)
from torch_qpmpc.experiment.tasks.registry import Task, priced, register
from torch_qpmpc.experiment.tracking import window_model
from torch_qpmpc.mpc.model import Model
from torch_qpmpc.mpc.scheme import Scheme

#: Typical cost of a day in EUR, for the initial c.
COST = 5.0


def make_plant(cfg: DictConfig) -> HouseWall:
    return HouseWall(horizon=cfg.task.horizon, past=cfg.task.past)


def wrong_scheme(cfg: DictConfig, plant: HouseWall) -> Scheme:
    return learned_scheme(cfg, plant, one_mass(plant), COST)


def true_scheme(cfg: DictConfig, plant: HouseWall) -> Scheme:
    """Return the scheme with the best lags, without discount; its margin is that of the task."""
    scheme = heating_scheme(plant, best_lags(plant), margin=0.1)
    return replace(scheme, bounds=priced(cfg, scheme.bounds))


def one_mass(plant: HouseWall) -> Model:
    """Return the model of a house whose air has the wall's temperature."""
    A, E = plant.lb_a.new_zeros(1, plant.past), plant.lb_a.new_zeros(1, plant.n_d)
    B = torch.zeros_like(A)
    C, R = C_I + C_E, R_IE + R_EA
    A[0, 0], B[0, 0] = 1 - DT / (R * C), DT / C
    E[0, OUTDOOR], E[0, SUN] = DT / (R * C), DT * G_A / C
    return Model(A, B, E)


def best_lags(plant: HouseWall) -> Model:
    """Return the best prediction from the window, with the weather before a step as it is then.

    The gain is white noise with its mean square.
    """
    A, B, E = plant.model()
    gain = E[:, GAIN:]
    variance = plant.gain_std**2 + plant.evening_gain**2 * 4 / 24
    inputs = torch.cat((B, E[:, : plant.n_d]), -1)
    output, exact = A.new_tensor([[1.0, 0.0, 0.0]]), A.new_tensor([[1e-6]])
    A, lags = window_model(A, inputs, output, variance * gain @ gain.mT, exact, plant.past)
    u, d = lags.unflatten(-1, (plant.past, 1 + plant.n_d)).split((1, plant.n_d), -1)
    return Model(A, u.flatten(-2), d.sum(-2))


register(
    Task(
        "house_wall",
        make_plant,
        wrong_scheme,
        true_scheme,
        masks,
        closed_loop=plant_loop,
        rivals=HOUSE_WALL_RIVALS,
        episode=episode,
        unit=(DAY, "days"),
        settings=HeatingSettings,
        defaults=None,
    )
)
