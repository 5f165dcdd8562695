"""``task=house``: leap-c's room, heated by price, learned from its planner's wrong model."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from omegaconf import DictConfig
from torch import Tensor
from torch.nn.functional import pad

from torch_qpmpc.envs import House
from torch_qpmpc.envs.closed_loop import plant_loop
from torch_qpmpc.envs.heated_house import DAY, DT, LOWER, OUTDOOR, PRICE, UPPER, HeatedHouse
from torch_qpmpc.experiment.fields import Count, NonNegative
from torch_qpmpc.experiment.heating import heating_scheme, known_model
from torch_qpmpc.experiment.rivals.houses import HOUSE_RIVALS
from torch_qpmpc.experiment.tasks.registry import (
    Task,
    TaskSettings,
    plant_layout,
    priced,
    register,
)
from torch_qpmpc.mpc.banded import band_distance
from torch_qpmpc.mpc.model import Model
from torch_qpmpc.mpc.scheme import Scheme

#: The resistance that the tutorial's planner assumes, in K/kW.
WRONG_R = 2.0
#: Typical cost of a day in EUR, for the initial c.
COST = 21.0


class HeatingSettings(TaskSettings):
    """The keys of the heated houses."""

    #: Number of outputs in the window.
    past: Count
    #: Distance to the lower comfort bound, in K, at which the planned violation begins.
    margin: NonNegative


def make_plant(cfg: DictConfig) -> House:
    return House(horizon=cfg.task.horizon, past=cfg.task.past)


def wrong_scheme(cfg: DictConfig, plant: House) -> Scheme:
    return learned_scheme(cfg, plant, lagged_model(replace(plant, R=WRONG_R)), COST)


def true_scheme(cfg: DictConfig, plant: House) -> Scheme:
    """Return the scheme with the true model, without discount; it does not see the gain."""
    scheme = heating_scheme(plant, lagged_model(plant))
    return replace(scheme, bounds=priced(cfg, scheme.bounds))


def lagged_model(plant: House) -> Model:
    """Return the known model, with coefficients of zero for the earlier lags of the window."""
    model, lags = known_model(plant), (0, plant.past - 1)
    return replace(model, A=pad(model.A, lags), B=pad(model.B, lags))


def learned_scheme(cfg: DictConfig, plant: HeatedHouse, model: Model, cost: float) -> Scheme:
    """Make the scheme that learns, whose c is the part of a typical cost that lies beyond N."""
    gamma = cfg.task.gamma
    c = gamma**plant.horizon / (1 - gamma) * cost / DAY if gamma < 1 else 0.0
    scheme = heating_scheme(plant, model, gamma=gamma, margin=cfg.task.margin, c=c)
    return replace(scheme, bounds=priced(cfg, scheme.bounds))


def masks(cfg: DictConfig, plant: HeatedHouse) -> dict[str, Tensor]:
    """Make the masks of q and of a free C, which keeps the zeros above its band.

    The learned entries of q are those of the forecasts, in which V and Q become linear: others
    would be prices of the plan, and that of y_N is not bounded.
    """
    layout = plant_layout(plant, plant.horizon)
    masks = {"q": torch.arange(layout.n_z) < layout.n_preview}
    if cfg.constraint.structure == "free":
        masks["C"] = band_distance(layout) <= 0
    return masks


def episode(plant: HeatedHouse, d: Tensor) -> dict[str, Any]:
    """Show the comfort band, the price and the weather over the hours of a day."""
    return {
        "times": DT * torch.arange(len(d)),
        "xlabel": "hour",
        "outputs": ["air, °C"],
        "actions": ["heating, kW"],
        "band": (d[:, LOWER : LOWER + 1], d[:, UPPER : UPPER + 1]),
        "signals": {"price, EUR/kWh": d[:, PRICE], "outdoors, °C": d[:, OUTDOOR]},
    }


register(
    Task(
        "house",
        make_plant,
        wrong_scheme,
        true_scheme,
        masks,
        closed_loop=plant_loop,
        rivals=HOUSE_RIVALS,
        episode=episode,
        unit=(DAY, "days"),
        settings=HeatingSettings,
        defaults=None,
    )
)
