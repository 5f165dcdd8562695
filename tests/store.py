"""A small plant with previews and noise: a store that is filled by price."""

from dataclasses import KW_ONLY, dataclass, field
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from torch_qpmpc import QPMPC, Bounds, Cost, Model, QPActorValueOperator, Scheme
from torch_qpmpc.envs import Plant, PlantEnv
from torch_qpmpc.envs.linear_system import Rng, float64, normal, uniform

LEARN = ("H", "H_f", "q", "c", "w", "C", "b", "G", "lb", "ub")


@dataclass(frozen=True, eq=False)
class Store(Plant):
    """A level l and a pump v, with prices and demands known ahead.

    v+ = 0.5 v + 0.5 u,    l+ = l + v - demand + noise,    y = [l + noise, v]

    w is [price, demand, noise of the level, noise of the output].
    """

    std: float = 0.01
    _: KW_ONLY
    lb_a: Tensor = field(default_factory=float64(0))
    ub_a: Tensor = field(default_factory=float64(1))
    n_y: int = 2
    n_d: int = 2
    horizon: int = 3

    def signals(self, rng: Rng, count: int, length: int) -> Tensor:
        known, noise = uniform(rng, count, length, 2), normal(rng, count, length, 2)
        return torch.cat((known, self.std * noise), -1)

    def starts(self, rng: Rng, count: int) -> Tensor:
        level = 1 + uniform(rng, count, 1)
        return torch.cat((level, torch.zeros_like(level)), -1)

    def output(self, x: Tensor, w: Tensor) -> Tensor:
        return torch.cat((x[..., :1] + w[..., 3:], x[..., 1:]), -1)

    def cost(self, x: Tensor, u: Tensor, w: Tensor) -> Tensor:
        return w[..., 0] * u[..., 0] + self.violation(x, w)

    def step(self, x: Tensor, u: Tensor, w: Tensor) -> Tensor:
        level, pump = x[..., 0], x[..., 1]
        level = level + pump - w[..., 1] + w[..., 2]
        return torch.stack((level, 0.5 * (pump + u[..., 0])), -1)

    def violation(self, x: Tensor, w: Tensor) -> Tensor:
        return (1 - x[..., 0]).relu() + (x[..., 0] - 2).relu()


def scheme(plant: Store, gamma: float = 0.9) -> Scheme:
    """Return the true model, prices in the cost and soft bounds of the level.

    An observer's further states have a small weight, and nothing moves them.
    """
    n, rest = plant.n_x, plant.n_x - 2
    weight = 0.1 * torch.eye(2 + n + 1, dtype=torch.float64)
    weight[0, -1] = weight[-1, 0] = 1.0
    low = torch.full((n,), -torch.inf, dtype=torch.float64)
    high = -low
    low[0], high[0] = 1.0, 2.0
    bounds = Bounds(
        state_bounds=(low, high), action_bounds=(plant.lb_a, plant.ub_a), state_slack=2.0
    )
    A, B, E = (
        torch.tensor(matrix, dtype=torch.float64)
        for matrix in ([[1.0, 1.0], [0.0, 0.5]], [[0.0], [0.5]], [[0.0, -1.0], [0.0, 0.0]])
    )
    below = (0, 0, 0, rest)
    model = Model(F.pad(A, (0, rest, 0, rest)), F.pad(B, below), E=F.pad(E, below))
    cost = Cost(weight, hessian="block")
    return Scheme(model.layout(plant.horizon), model, cost, bounds, gamma)


def make_mpc(plant: Store | None = None) -> QPMPC:
    plant = Store() if plant is None else plant
    return QPMPC(scheme(plant), learn=LEARN, solver="daqp", on_failure="mask")


def make_operator(plant: Store | None = None, **keys: Any) -> QPActorValueOperator:
    return QPActorValueOperator(make_mpc(plant), preview_key="preview", **keys)


def collect(count: int, steps: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> Any:
    """Collect ``(count, steps)`` transitions of random actions in episodes of 7 steps."""
    torch.manual_seed(seed)
    plant = Store()
    env = PlantEnv(plant, count, 7, dtype, seed=seed)
    return env.rollout(steps, break_when_any_done=False)
