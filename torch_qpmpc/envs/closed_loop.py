"""Closed-loop evaluation, with the same starts and noise for every policy, and the closed gap."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from torch_qpmpc.checks import check_kind, check_number, check_seed, check_tensor, check_whole
from torch_qpmpc.envs.gymnasium_plant import GymnasiumPlant
from torch_qpmpc.envs.kalman_filter import KalmanFilter
from torch_qpmpc.envs.linear_system import LinearSystem
from torch_qpmpc.envs.plant import Plant
from torch_qpmpc.errors import QPError
from torch_qpmpc.loops import Step, run_loop

POLICY_REMEDY = "Map a batch of states to a batch of actions."


@dataclass(frozen=True, eq=False)
class ClosedLoop:
    """Trajectories of one policy in float64, and its cumulative costs.

    Attributes:
        known: p, what the policy saw, ``(steps + 1, starts, n_p)``.
        actions: ``(steps, starts, n_u)``, as applied: clipped to their bounds.
        costs: ``(steps, starts)``, L(s_k, a_k).
        gamma: the discount factor of ``J_discounted``.
        n_x: the last n_x entries of p are the state, or what the policy sees of it; None for all.
        lengths: the numbers of steps of the episodes, ``(starts,)``; None if none ends early.
        raised: True for the episodes that an exception of the plant ended, ``(starts,)``: J leaves
            them out.
    """

    known: Tensor
    actions: Tensor
    costs: Tensor
    gamma: float
    n_x: int | None = None
    lengths: Tensor | None = None
    raised: Tensor | None = None

    @property
    def states(self) -> Tensor:
        """The states ``(steps + 1, starts, n_x)``, or the outputs or estimates of a `Plant`."""
        return self.known[..., -(self.n_x or 0) :]

    @property
    def J(self) -> float:
        """The mean over the starts of the sum of costs."""
        return self._mean(self.costs.sum(0))

    @property
    def J_discounted(self) -> float:
        """The mean over the starts of the sum of gamma^k L(s_k, a_k)."""
        weights = self.gamma ** torch.arange(len(self.costs)).to(self.costs)
        return self._mean(weights @ self.costs)

    def _mean(self, total: Tensor) -> float:
        if self.raised is not None and not self.raised.all():
            total = total[~self.raised]
        return total.mean().item()


@torch.no_grad()
def closed_loop(
    policy: Callable[[Tensor], Tensor],
    physics: LinearSystem,
    *,
    steps: int = 50,
    starts: int = 32,
    seed: int = 123,
    gamma: float = 0.9,
) -> ClosedLoop:
    """Run ``policy`` from ``starts`` fixed starts side by side, without gradients.

    ``numpy.random.default_rng(seed)`` draws the starts, then each step's noise.

    Args:
        policy: maps states ``(starts, n_x)`` in float64 to actions ``(starts, n_u)``.
        physics: the true system, its noise and its start distribution.
        steps, starts: numbers of steps and of starts.
        seed: seed of the starts and the noise.
        gamma: the discount factor of ``J_discounted``.

    Raises:
        QPError: if ``policy`` returns another shape, or an argument does not fit.

    Example:
        >>> from torch_qpmpc.envs import PointMass
        >>> loop = closed_loop(lambda s: -s[:, :2] - s[:, 2:], PointMass(), steps=20, starts=4)
        >>> tuple(loop.states.shape), bool(loop.costs[-1].mean() < loop.costs[0].mean())
        ((21, 4, 4), True)
    """
    _check(policy, steps, starts, seed, gamma)
    check_kind("physics", physics, LinearSystem, "Use gymnasium_loop for a GymnasiumPlant.")
    rng = np.random.default_rng(seed)
    s = physics.starts(rng, starts)
    nu = torch.zeros_like(s)

    def step(a: Tensor) -> Step:
        nonlocal s, nu
        a = physics.applied(a)
        cost = physics.cost(s, a)
        nu = physics.noise(nu, physics.draw(rng, starts))
        s = physics.step(s, a, nu)
        return Step(s, a, cost)

    return _run(policy, s, step, steps, (starts, *physics.lb_a.shape), gamma)


@torch.no_grad()
def plant_loop(
    policy: Callable[[Tensor], Tensor],
    plant: Plant,
    *,
    steps: int = 96,
    starts: int = 32,
    seed: int = 123,
    gamma: float = 0.99,
) -> ClosedLoop:
    """Run ``policy`` as `closed_loop` does, on a `Plant`.

    ``numpy.random.default_rng(seed)`` draws the signals ``(starts, steps + N + 1, n_w)``, then the
    starts. ``policy`` maps p ``(starts, n_p)`` to actions. If it has a method ``begin(plant, x,
    w)``, that is called first, with the true start states x and all signals w.
    """
    _check(policy, steps, starts, seed, gamma)
    check_kind("plant", plant, Plant, "Use closed_loop for a LinearSystem.")
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

    def step(a: Tensor) -> Step:
        nonlocal k, x, seen
        u = plant.applied(a)
        cost = plant.cost(x, u, w[:, k])
        x = plant.step(x, u, w[:, k])
        k, d, y = k + 1, w[:, k, : plant.n_d], plant.output(x, w[:, k + 1])
        seen = y if observer is None else observer.following(seen, u, d, y, k)
        return Step(known(), u, cost)

    return _run(policy, known(), step, steps, (starts, plant.n_u), gamma, plant.n_x)


@torch.no_grad()
def gymnasium_loop(
    policy: Callable[[Tensor], Tensor],
    plant: GymnasiumPlant,
    *,
    steps: int | None = None,
    starts: int = 32,
    seed: int = 123,
    gamma: float = 0.99,
) -> ClosedLoop:
    """Run ``policy`` as `closed_loop` does, in a Gymnasium environment; start i has seed + i.

    After an episode's end its state stays constant, at no cost. ``steps`` is by default the length
    of the environment's own episodes.
    """
    check_kind("plant", plant, GymnasiumPlant, "Use closed_loop for a LinearSystem.")
    steps = plant.max_steps if steps is None else steps
    _check(policy, steps, starts, seed, gamma)
    envs = [plant.make(steps) for _ in range(starts)]
    y = np.stack([env.reset(seed=seed + i)[0] for i, env in enumerate(envs)])
    observer = None if plant.observer is None else KalmanFilter(plant.observer)
    s = _float64(y) if observer is None else observer.first(_float64(y))
    over, lengths, k = np.zeros(starts, dtype=bool), np.zeros(starts), 0
    raised = np.zeros(starts, dtype=bool)
    low, high = plant.lb_a.numpy(), plant.ub_a.numpy()

    def step(a: Tensor) -> Step:
        nonlocal s, y, k
        applied = a.numpy().clip(low, high)
        y, cost, going, k = y.copy(), np.zeros(starts), torch.as_tensor(~over)[:, None], k + 1
        lengths[~over] += 1
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
        return Step(s, u, _float64(cost))

    shape = starts, len(plant.lb_a)
    last = torch.zeros(shape, dtype=torch.float64)

    def act(p: Tensor) -> Tensor:
        nonlocal last
        last = last if over.all() else policy(p)
        return last

    loop = _run(act, s, step, steps, shape, gamma)
    for env in envs:
        env.close()
    return replace(loop, lengths=_float64(lengths), raised=torch.from_numpy(raised))


def _run(
    policy: Callable[[Tensor], Tensor],
    p: Tensor,
    step: Callable[[Tensor], Step],
    steps: int,
    shape: tuple[int, ...],
    gamma: float,
    n_x: int | None = None,
) -> ClosedLoop:
    """Run ``policy``, which sees p ``(starts, n_p)`` first and returns actions of this shape."""

    def act(p: Tensor) -> Tensor:
        # A result of shape (starts,) or (n_u,) would broadcast silently.
        return check_tensor("policy(s)", policy(p), *shape, batched=False, remedy=POLICY_REMEDY)

    known, actions, costs = zip(*run_loop(act, p, step, steps), strict=True)
    known = torch.stack((p, *known))
    return ClosedLoop(known, torch.stack(actions), torch.stack(costs), gamma, n_x)


def _float64(x: np.ndarray) -> Tensor:
    return torch.as_tensor(x, dtype=torch.float64)


def _check(policy: object, steps: int, starts: int, seed: int, gamma: float) -> None:
    """Raise `QPError` unless these arguments of the loops fit."""
    if not callable(policy):
        remedy = "Pass a function of states, such as mpc.policy."
        raise QPError.expected("policy", type(policy).__name__, "a function", remedy)
    check_whole("steps", steps, 1)
    check_whole("starts", starts, 1)
    check_seed(seed)
    check_number("gamma", gamma, lambda x: 0 <= x <= 1, "a discount factor in [0, 1]")
