"""A small plant with previews, hidden states and noise: a store that is filled by price."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass, field
from typing import Any

import torch
from torch import Tensor
from torchrl.envs import TransformedEnv

from torch_qpmpc import QPMPC, Bounds, Cost, Model, QPActorValueOperator, Scheme
from torch_qpmpc.envs import PastWindow, Plant, PlantEnv
from torch_qpmpc.envs.linear_system import Rng, float64, normal, uniform

LEARN = ("H", "H_f", "q", "c", "w", "C", "b", "G", "lb", "ub")


@dataclass(frozen=True, eq=False)
class Store(Plant):
    """A level l and a pump v, of which only l is measured, with prices and demands known ahead.

    v+ = 0.5 v + 0.5 u,    l+ = l + v - demand + noise,    y = l + noise

    w is [price, demand, noise of the level, noise of the output].
    """

    std: float = 0.01
    _: KW_ONLY
    lb_a: Tensor = field(default_factory=float64(0))
    ub_a: Tensor = field(default_factory=float64(1))
    n_y: int = 1
    n_d: int = 2
    horizon: int = 3
    past: int = 2

    def signals(self, rng: Rng, count: int, length: int) -> Tensor:
        known, noise = uniform(rng, count, length, 2), normal(rng, count, length, 2)
        return torch.cat((known, self.std * noise), -1)

    def starts(self, rng: Rng, count: int) -> Tensor:
        level = 1 + uniform(rng, count, 1)
        return torch.cat((level, torch.zeros_like(level)), -1)

    def output(self, x: Tensor, w: Tensor) -> Tensor:
        return x[..., :1] + w[..., 3:]

    def cost(self, x: Tensor, u: Tensor, w: Tensor) -> Tensor:
        return w[..., 0] * u[..., 0] + self.violation(x, w)

    def step(self, x: Tensor, u: Tensor, w: Tensor) -> Tensor:
        level, pump = x[..., 0], x[..., 1]
        level = level + pump - w[..., 1] + w[..., 2]
        return torch.stack((level, 0.5 * (pump + u[..., 0])), -1)

    def violation(self, x: Tensor, w: Tensor) -> Tensor:
        return (1 - x[..., 0]).relu() + (x[..., 0] - 2).relu()


def scheme(plant: Store, gamma: float = 0.9) -> Scheme:
    """Return an ARX model, prices in the cost, soft bounds and, with a window, rate limits."""
    lags, one = plant.past - 1, torch.ones(1, dtype=torch.float64)
    weight = 0.1 * torch.eye(4, dtype=torch.float64)
    weight[0, 3] = weight[3, 0] = 1.0
    A = torch.tensor([[1.5, *[-0.5][:lags], *[0.0] * (lags - 1)]], dtype=torch.float64)
    B = torch.tensor([[0.0, *[0.5][:lags], *[0.0] * (lags - 1)]], dtype=torch.float64)
    bounds = Bounds(
        state_bounds=(one, 2 * one),
        action_bounds=(plant.lb_a, plant.ub_a),
        rate_bounds=(-0.6 * one, 0.6 * one) if lags else None,
        state_slack=2.0,
        rate_slack=1.0 if lags else torch.inf,
    )
    model, cost = Model(A, B, E=[[0.0, -1.0]]), Cost(weight, hessian="block")
    return Scheme(model.layout(plant.horizon), model, cost, bounds, gamma)


def make_mpc(plant: Store | None = None) -> QPMPC:
    """Make the QP of a store's `scheme`, with all of theta learned."""
    plant = Store() if plant is None else plant
    return QPMPC(scheme(plant), learn=LEARN, solver="daqp", on_failure="mask")


def make_operator(plant: Store | None = None, **keys: Any) -> QPActorValueOperator:
    return QPActorValueOperator(make_mpc(plant), preview_key="preview", **keys)


def collect(count: int, steps: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> Any:
    """Collect ``(count, steps)`` transitions of random actions in episodes of 7 steps."""
    torch.manual_seed(seed)
    plant = Store()
    env = TransformedEnv(PlantEnv(plant, count, 7, dtype, seed=seed), PastWindow(plant.past))
    return env.rollout(steps, break_when_any_done=False)
