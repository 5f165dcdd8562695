"""Closed-loop evaluation, with the same starts and noise for every policy."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import singledispatch
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torch_qpmpc.checks import check_number, check_seed, check_tensor, check_whole, class_name
from torch_qpmpc.envs.gymnasium_plant import GymnasiumPlant
from torch_qpmpc.envs.kalman_filter import KalmanFilter
from torch_qpmpc.envs.linear_system import LinearSystem
from torch_qpmpc.envs.plant import Plant
from torch_qpmpc.errors import QPError

POLICY_REMEDY = "Map a batch of states to a batch of actions."
#: A plant of any kind.
AnyPlant = LinearSystem | GymnasiumPlant | Plant
#: The steps of an episode of a plant that has no length of its own, the number of starts, a seed.
STEPS, STARTS, SEED = 50, 32, 123


@dataclass(frozen=True, eq=False)
class ClosedLoop:
    """Trajectories of one policy in float64, and its cumulative costs.

    Attributes:
        known: p, what the policy saw, ``(steps + 1, starts, n_p)``.
        actions: ``(steps, starts, n_u)``, as applied: clipped to their bounds.
        costs: ``(steps, starts)``, L(s_k, a_k).
        n_x: the last n_x entries of p are the state, or what the policy sees of it.
        lengths: the numbers of steps of the episodes, ``(starts,)``.
        raised: True for the episodes that an exception of the plant ended, ``(starts,)``: J leaves
            them out.
    """

    known: Tensor
    actions: Tensor
    costs: Tensor
    n_x: int
    lengths: Tensor
    raised: Tensor

    @property
    def states(self) -> Tensor:
        """The states ``(steps + 1, starts, n_x)``, or the outputs or estimates of a `Plant`."""
        return self.known[..., -self.n_x :]

    @property
    def J(self) -> float:
        """The mean over the starts of the sum of costs."""
        return self._mean(self.costs.sum(0))

    def discounted(self, gamma: float) -> float:
        """Return the mean over the starts of the sum of gamma^k L(s_k, a_k)."""
        check_number("gamma", gamma, lambda x: 0 <= x <= 1, "a discount factor in [0, 1]")
        weights = gamma ** torch.arange(len(self.costs)).to(self.costs)
        return self._mean(weights @ self.costs)

    def _mean(self, total: Tensor) -> float:
        return total[~self.raised | self.raised.all()].mean().item()


@torch.no_grad()
def closed_loop(
    policy: Callable[[Tensor], Tensor],
    plant: AnyPlant,
    *,
    steps: int | None = None,
    starts: int = STARTS,
    seed: int = SEED,
) -> ClosedLoop:
    """Run ``policy`` from ``starts`` fixed starts side by side, without gradients.

    ``numpy.random.default_rng(seed)`` draws the starts of a `LinearSystem`, then each step's noise,
    or the signals of a `Plant` ``(starts, steps + N + 1, n_w)``, then its starts. Start i of a
    Gymnasium environment has seed + i; after an episode's end its state stays constant, at no cost.

    Args:
        policy: maps what it sees, ``(starts, n_p)`` in float64, to actions ``(starts, n_u)``. On a
            `Plant` its method ``begin(plant, x, w)``, if it has one, is called first, with the true
            start states x and all signals w.
        plant: the true system.
        steps: the number of steps; None for those of the environment's own episodes, or 50.
        starts: the number of starts.
        seed: seed of the starts and the noise.

    Raises:
        QPError: if ``policy`` returns another shape, or an argument does not fit.

    Example:
        >>> from torch_qpmpc.envs import PointMass
        >>> loop = closed_loop(lambda s: -s[:, :2] - s[:, 2:], PointMass(), steps=20, starts=4)
        >>> tuple(loop.states.shape), bool(loop.costs[-1].mean() < loop.costs[0].mean())
        ((21, 4, 4), True)
    """
    if not callable(policy):
        remedy = "Pass a function of states, such as mpc.policy."
        raise QPError.expected("policy", type(policy).__name__, "a function", remedy)
    length = getattr(plant, "max_steps", STEPS) if steps is None else steps
    check_whole("steps", length, 1)
    check_whole("starts", starts, 1)
    check_seed(seed)
    episodes = _begun(plant, policy, length, starts, seed)
    lengths, known, done, action = np.zeros(starts), episodes.known, [], torch.zeros(())
    # A result of shape (starts,) or (n_u,) would broadcast silently.
    options = {"batched": False, "remedy": POLICY_REMEDY}
    for _ in range(length):
        if not episodes.over.all():
            action = check_tensor("policy(s)", policy(known), starts, len(plant.lb_a), **options)
        lengths += ~episodes.over
        known, *_ = step = episodes.step(action)
        done.append(step)
    episodes.close()
    seen, actions, costs = map(torch.stack, zip(*done, strict=True))
    seen, raised = torch.cat((episodes.known[None], seen)), torch.as_tensor(episodes.raised)
    return ClosedLoop(seen, actions, costs, plant.n_x, _float64(lengths), raised)


class _Episodes(NamedTuple):
    """Episodes that have begun: what the policy sees first, and their step.

    A step maps actions to what the policy sees next, the applied actions and the costs. It marks
    the episodes that are ``over``, and those that have ``raised``.
    """

    known: Tensor
    step: Callable[[Tensor], tuple[Tensor, Tensor, Tensor]]
    over: np.ndarray
    raised: np.ndarray
    close: Callable[[], object] = lambda: None


@singledispatch
def _begun(plant: object, policy: object, steps: int, starts: int, seed: int) -> _Episodes:
    """Begin episodes of a plant of any kind."""
    want = "a LinearSystem, a Plant or a GymnasiumPlant"
    raise QPError.expected("plant", class_name(plant), want)


@_begun.register
def _(plant: LinearSystem, policy: object, steps: int, starts: int, seed: int) -> _Episodes:
    rng = np.random.default_rng(seed)
    s = plant.starts(rng, starts)
    nu, never = torch.zeros_like(s), np.zeros(starts, dtype=bool)

    def step(a: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        nonlocal s, nu
        a = plant.applied(a)
        cost = plant.cost(s, a)
        nu = plant.noise(nu, plant.draw(rng, starts))
        s = plant.step(s, a, nu)
        return s, a, cost

    return _Episodes(s, step, never, never)


@_begun.register
def _(plant: Plant, policy: object, steps: int, starts: int, seed: int) -> _Episodes:
    rng = np.random.default_rng(seed)
    w = plant.signals(rng, starts, steps + plant.horizon + 1)
    x = plant.starts(rng, starts)
    if (begin := getattr(policy, "begin", None)) is not None:
        begin(plant, x, w)
    observer = None if plant.observer is None else KalmanFilter(plant.observer)
    k, y = 0, plant.output(x, w[:, 0])
    seen = y if observer is None else observer.first(y)

    def known() -> Tensor:
        ahead = w[:, k : k + plant.horizon + 1, : plant.n_d]
        return torch.cat((ahead.flatten(1), seen), -1)

    def step(a: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        nonlocal k, x, seen
        u = plant.applied(a)
        cost = plant.cost(x, u, w[:, k])
        x = plant.step(x, u, w[:, k])
        k, d, y = k + 1, w[:, k, : plant.n_d], plant.output(x, w[:, k + 1])
        seen = y if observer is None else observer.following(seen, u, d, y, k)
        return known(), u, cost

    never = np.zeros(starts, dtype=bool)
    return _Episodes(known(), step, never, never)


@_begun.register
def _(plant: GymnasiumPlant, policy: object, steps: int, starts: int, seed: int) -> _Episodes:
    envs = [plant.make(steps) for _ in range(starts)]
    y = np.stack([env.reset(seed=seed + i)[0] for i, env in enumerate(envs)])
    observer = None if plant.observer is None else KalmanFilter(plant.observer)
    s = _float64(y) if observer is None else observer.first(_float64(y))
    (over, raised), k = np.zeros((2, starts), dtype=bool), 0
    low, high = plant.lb_a.numpy(), plant.ub_a.numpy()

    def step(a: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        nonlocal s, y, k
        applied = a.numpy().clip(low, high)
        y, cost, going, k = y.copy(), np.zeros(starts), torch.as_tensor(~over)[:, None], k + 1
        for i in np.flatnonzero(~over):
            before = len(plant.raised)
            y[i], reward, terminated, truncated, _ = envs[i].step(applied[i].astype(low.dtype))
            raised[i] |= len(plant.raised) > before
            cost[i] = -float(reward)
            over[i] = terminated or truncated
        u, now = _float64(applied), _float64(y)
        if observer is not None:
            now = observer.following(s, u, s[:, :0], now, k)
        s = torch.where(going, now, s)
        return s, u, _float64(cost)

    return _Episodes(s, step, over, raised, lambda: [env.close() for env in envs])


def _float64(x: np.ndarray) -> Tensor:
    return torch.as_tensor(x, dtype=torch.float64)
