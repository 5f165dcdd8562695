"""Plants of `outside` that no package has: a cart-pole's swing-up, and two stocks in a row."""

from __future__ import annotations

from itertools import product
from typing import Any

import gymnasium
import numpy as np

#: The cross-entropy method: samples of a plan, the best of them, iterations, and steps ahead.
SAMPLES, BEST, ITERATIONS, AHEAD = 300, 30, 5, 30


class CartPole(gymnasium.Env):
    """A pole on a cart, hanging at first, with a force of at most 10 N on the cart.

    The pole has .1 kg and 1 m, the cart 1 kg; a step takes .05 s. Observations are the cart's place
    and speed, cosine and sine of the pole's angle from upright, and its rate. A hanging pole costs
    2 in each of 100 steps.
    """

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (5,))
    action_space = gymnasium.spaces.Box(-10.0, 10.0, (1,))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self.s = np.array([0.0, 0.0, np.pi, 0.0]) + self.np_random.uniform(-0.1, 0.1, 4)
        return self._observed(), {}

    def step(self, action: Any) -> Any:
        self.s, cost = swing(self.s, np.clip(action, -10.0, 10.0)[0])
        return self._observed(), -float(cost), False, False, {}

    def _observed(self) -> np.ndarray:
        x, v, angle, rate = self.s
        return np.array([x, v, np.cos(angle), np.sin(angle), rate], np.float32)


def swing(s: np.ndarray, force: Any) -> tuple[np.ndarray, Any]:
    """Return the next states ``(*batch, 4)`` of cart-poles, and the costs of the step."""
    x, v, angle, rate = np.moveaxis(s, -1, 0)
    for _ in range(5):
        cos, sin = np.cos(angle), np.sin(angle)
        push = (force + 0.05 * rate**2 * sin) / 1.1
        turn = (9.8 * sin - cos * push) / (0.5 * (4 / 3 - 0.1 * cos**2 / 1.1))
        x, v = x + 0.01 * v, v + 0.01 * (push - 0.05 * turn * cos / 1.1)
        angle, rate = angle + 0.01 * rate, rate + 0.01 * turn
    cost = 1 - np.cos(angle) + 0.1 * x**2 + 1e-3 * force**2
    return np.stack(np.broadcast_arrays(x, v, angle, rate), -1), cost


def cross_entropy(seed: int, episodes: int = 32) -> float:
    """Return J of the cart-pole's cross-entropy method, which knows the plant."""
    rng, env, starts = np.random.default_rng(seed), CartPole(), []
    for i in range(episodes):
        env.reset(seed=seed + i)
        starts.append(env.s)
    s, J = np.array(starts), np.zeros(episodes)
    mean = np.zeros((episodes, AHEAD))
    for _ in range(100):
        width = np.full_like(mean, 6.0)
        for _ in range(ITERATIONS):
            noise = rng.standard_normal((SAMPLES, episodes, AHEAD))
            plans = np.clip(mean + width * noise, -10.0, 10.0)
            plans[0] = np.clip(mean, -10.0, 10.0)
            at, cost = np.broadcast_to(s, (SAMPLES, episodes, 4)), 0.0
            for k in range(AHEAD):
                at, own = swing(at, plans[..., k])
                cost = cost + own
            best = np.argsort(cost, 0)[:BEST, :, None]
            kept = np.take_along_axis(plans, best, 0)
            mean, width = kept.mean(0), kept.std(0) + 0.05
        s, cost = swing(s, kept[0, :, 0])
        J, mean = J + cost, np.concatenate((mean[:, 1:], mean[:, -1:]), 1)
    return float(J.mean())


class TwoStocks(gymnasium.Env):
    """A warehouse that supplies a shop, with random demand, 5 a day in the mean.

    Orders, of at most 15, take a day each. Observations are the warehouse's stock, what it gets
    next, the shop's stock, negative if demand waits, and what that gets next. What the warehouse
    lacks is not delivered later. A piece a day costs .5 in the warehouse, 1 in the shop, and 9 if a
    buyer waits for it.
    """

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (4,))
    action_space = gymnasium.spaces.Box(0.0, 15.0, (2,))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self.s = np.array([10.0, 5.0, 5.0, 5.0])
        return self.s.astype(np.float32), {}

    def step(self, action: Any) -> Any:
        demand = self.np_random.gamma(4.0, 5.0 / 4.0)
        self.s, cost = supply(self.s, np.clip(action, 0.0, 15.0), demand)
        return self.s.astype(np.float32), -float(cost), False, False, {}


def supply(s: np.ndarray, orders: np.ndarray, demand: Any) -> tuple[np.ndarray, Any]:
    """Return the next stocks ``(*batch, 4)``, and the costs of the day."""
    stock, coming, shop, sent = np.moveaxis(s, -1, 0)
    ordered, wanted = np.moveaxis(orders, -1, 0)
    sending = np.minimum(wanted, stock + coming)
    stock, shop = stock + coming - sending, shop + sent - demand
    cost = 0.5 * stock + np.maximum(shop, 0) + 9 * np.maximum(-shop, 0)
    return np.stack(np.broadcast_arrays(stock, ordered, shop, sending), -1), cost


def base_stocks(seed: int, episodes: int = 32) -> float:
    """Return J of the best base stocks of both, which 1,000 other episodes of the plant choose."""

    def costs(levels: tuple[float, float], demand: np.ndarray) -> np.ndarray:
        s, J = np.tile([10.0, 5.0, 5.0, 5.0], (len(demand), 1)), 0.0
        for d in demand.T:
            at_shop = s[:, 2] + s[:, 3]  # and echelon stock: all that is below the warehouse
            wanted = np.clip(levels[1] - at_shop, 0.0, 15.0)
            ordered = np.clip(levels[0] - at_shop - s[:, 0] - s[:, 1], 0.0, 15.0)
            s, cost = supply(s, np.stack((ordered, wanted), -1), d)
            J = J + cost
        return np.asarray(J)

    other = np.random.default_rng(0).gamma(4.0, 5.0 / 4.0, (1000, 100))
    grid = product(np.arange(10.0, 32.0, 0.5), np.arange(5.0, 24.0, 0.5))
    levels = min(grid, key=lambda x: costs(x, other).mean())
    env, demand = TwoStocks(), np.empty((episodes, 100))
    for i in range(episodes):
        env.reset(seed=seed + i)
        demand[i] = [env.np_random.gamma(4.0, 5.0 / 4.0) for _ in range(100)]
    return float(costs(levels, demand).mean())
