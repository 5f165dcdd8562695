"""Plants that no package has: a swing-up, two stocks in a row, and two of known optimum."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import product
from typing import Any, NamedTuple

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
        s, cost = swing(self.s, np.clip(action, -10.0, 10.0)[0])
        self.s = np.array(s)
        return self._observed(), -float(cost), False, False, {}

    def _observed(self) -> np.ndarray:
        x, v, angle, rate = self.s
        return np.array([x, v, np.cos(angle), np.sin(angle), rate], np.float32)


def swing(s: Any, force: Any) -> tuple[tuple[Any, ...], Any]:
    """Return the next states of cart-poles, and the costs of the step."""
    x, v, angle, rate = s
    for _ in range(5):
        cos, sin = np.cos(angle), np.sin(angle)
        push = (force + 0.05 * rate**2 * sin) / 1.1
        turn = (9.8 * sin - cos * push) / (0.5 * (4 / 3 - 0.1 * cos**2 / 1.1))
        x, v = x + 0.01 * v, v + 0.01 * (push - 0.05 * turn * cos / 1.1)
        angle, rate = angle + 0.01 * rate, rate + 0.01 * turn
    cost = 1 - np.cos(angle) + 0.1 * x**2 + 1e-3 * force**2
    return (x, v, angle, rate), cost


def pendulum(s: Any, torque: Any) -> tuple[tuple[Any, ...], Any]:
    """Return the next states of Gymnasium's ``Pendulum-v1``, and the costs of the step."""
    angle, rate = s
    away = np.arctan2(np.sin(angle), np.cos(angle))
    cost = away**2 + 0.1 * rate**2 + 1e-3 * torque**2
    rate = np.fmin(np.fmax(rate + 0.05 * (15 * np.sin(angle) + 3 * torque), -8.0), 8.0)
    return (angle + 0.05 * rate, rate), cost


def cross_entropy(seed: int, episodes: int = 32) -> float:
    """Return J of the cart-pole's cross-entropy method, which knows the plant."""
    rng, env, starts = np.random.default_rng(seed), CartPole(), []
    for i in range(episodes):
        env.reset(seed=seed + i)
        starts.append(env.s)
    s, J = np.transpose(starts), np.zeros(episodes)
    mean = np.zeros((episodes, AHEAD))
    for _ in range(100):
        width = np.full_like(mean, 6.0)
        for _ in range(ITERATIONS):
            noise = rng.standard_normal((SAMPLES, episodes, AHEAD))
            plans = np.clip(mean + width * noise, -10.0, 10.0)
            plans[0] = np.clip(mean, -10.0, 10.0)
            at, cost = s, 0.0
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


class Known(NamedTuple):
    """A plant x+ = f(x) + G(x) u + noise of known optimum, with the cost x'Qx + u'Ru, Q = share P.

    Attributes:
        P: V(x) = x'Px and a constant, or its diagonal.
        share: Q as a share of P.
        R: the weight of each action.
        gamma: the discount.
        noise: standard deviations of the state's noise.
        G: the matrix of the actions ``(n, m)`` at x.
        turns: planes (i, j) of the state, and the angles by which f turns them at x.
        starts: the states that episodes begin with are uniform within plus and minus these.
        limit: of the actions; the optimal ones are within it.
        steps: of an episode.
    """

    P: np.ndarray
    share: float
    R: float
    gamma: float
    noise: np.ndarray
    G: Callable[[np.ndarray], np.ndarray]
    turns: Callable[[np.ndarray], Sequence[tuple[int, int, float]]]
    starts: np.ndarray
    limit: float
    steps: int

    def f(self, x: np.ndarray) -> np.ndarray:
        """Return H^(-1/2) S sqrt(P - Q) x with a rotation S: min_u of V at x+ is (P - Q)'s form."""
        P, G, y = self.P, self.G(x), _root((1 - self.share) * self.P) @ x
        for i, j, angle in self.turns(x):
            cos, sin = np.cos(angle), np.sin(angle)
            y[[i, j]] = cos * y[i] - sin * y[j], sin * y[i] + cos * y[j]
        H = self.gamma * np.linalg.inv(np.linalg.inv(P) + self.gamma / self.R * G @ G.T)
        return np.linalg.solve(_root(H), y)

    def optimum(self, x: np.ndarray) -> np.ndarray:
        G = self.G(x)
        curvature = self.R * np.eye(G.shape[1]) + self.gamma * G.T @ self.P @ G
        return -self.gamma * np.linalg.solve(curvature, G.T @ self.P @ self.f(x))

    def cost(self, x: np.ndarray, u: np.ndarray) -> float:
        return float(self.share * x @ self.P @ x + self.R * u @ u)

    def V(self, x: np.ndarray) -> float:
        constant = self.gamma / (1 - self.gamma) * self.noise**2 @ self.P.diagonal()
        return float(x @ self.P @ x + constant)


def _root(M: np.ndarray) -> np.ndarray:
    values, vectors = np.linalg.eigh(M)
    return (vectors * np.sqrt(values)) @ vectors.T


def _inputs(dt: float, n: int, m: int) -> np.ndarray:
    return dt * np.eye(n)[:, n - m :]


#: Of Ibrahim et al., 2026, "Benchmarking Reinforcement Learning via Stochastic Converse Optimality"
#: (arXiv 2603.17631), without disturbances that V does not know.
CONVERSE = {
    "Unicycle": Known(
        P=np.diag([1 / 9, 1 / 9, 1, 1, 1]),
        share=0.63,
        R=1 / 256,
        gamma=0.98,
        noise=np.array([0.01, 0.01, 0.005, 0.02, 0.02]),
        G=lambda x: _inputs(0.1, 5, 2),
        turns=lambda x: (
            (0, 1, x[2]),
            (0, 3, angle := 0.28 * np.tanh(1.2 * x[3])),
            (1, 3, angle),
            (3, 4, 0.25 * np.tanh(1.5 * x[3] * x[4])),
        ),
        starts=np.array([3.0, 3.0, np.pi, 1.0, 1.0]),
        limit=10.0,
        steps=20,
    ),
    "Two-link manipulator": Known(
        P=np.diag([np.pi**-2, np.pi**-2, 1, 1]),
        share=0.5265,
        R=9e-4,
        gamma=0.99,
        noise=np.array([0.0, 0.0, 2e-4, 2e-4]) ** 0.5,
        G=lambda x: _inputs(0.05, 4, 2),
        turns=lambda x: (
            (0, 2, 0.35 * np.tanh(x[0] * x[2]) + 0.5 * np.sin(x[0])),
            (1, 3, 0.35 * np.tanh(x[1] * x[3]) + 0.5 * np.sin(x[1])),
            (2, 3, 0.3 * np.tanh(x[1] - x[0])),
        ),
        starts=np.array([2.0, 2.0, 1.0, 1.0]),
        limit=25.0,
        steps=20,
    ),
}


class Converse(gymnasium.Env):
    def __init__(self, name: str) -> None:
        self.plant = CONVERSE[name]
        n, m = self.plant.G(self.plant.starts).shape
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (n,), np.float64)
        limit = self.plant.limit
        self.action_space = gymnasium.spaces.Box(-limit, limit, (m,), np.float64)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self.x = self.np_random.uniform(-self.plant.starts, self.plant.starts)
        return self.x, {}

    def step(self, action: Any) -> Any:
        plant, u = self.plant, np.asarray(action)
        reward = -plant.cost(self.x, u)
        noise = plant.noise * self.np_random.standard_normal(len(self.x))
        self.x = plant.f(self.x) + plant.G(self.x) @ u + noise
        return self.x, reward, False, False, {}
