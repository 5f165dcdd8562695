"""Closed-loop evaluation, with the same starts and noise for every policy, and the closed gap."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import gymnasium
import numpy as np
import torch
from torch import Tensor

from torch_qpmpc.checks import check_kind, check_number, check_tensor, check_whole
from torch_qpmpc.envs.gymnasium_plant import GymnasiumPlant
from torch_qpmpc.envs.linear_system import LinearSystem
from torch_qpmpc.errors import QPError

POLICY_REMEDY = "Map a batch of states to a batch of actions."


@dataclass(frozen=True, eq=False)
class ClosedLoop:
    """Trajectories of one policy in float64, and its cumulative costs.

    Attributes:
        states: ``(steps + 1, starts, n_x)``.
        actions: ``(steps, starts, n_u)``, as applied: clipped to their bounds.
        costs: ``(steps, starts)``, L(s_k, a_k).
        gamma: the discount factor of ``J_discounted``.
    """

    states: Tensor
    actions: Tensor
    costs: Tensor
    gamma: float

    @property
    def J(self) -> float:
        """The mean over the starts of the sum of costs."""
        return self.costs.sum(0).mean().item()

    @property
    def J_discounted(self) -> float:
        """The mean over the starts of the sum of gamma^k L(s_k, a_k)."""
        weights = self.gamma ** torch.arange(len(self.costs)).to(self.costs)
        return (weights @ self.costs).mean().item()


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

    The seed determines the experiment: ``numpy.random.default_rng(seed)`` draws the starts, then at
    each step the numbers ``(starts, n_noise)`` of the noise.

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
    expected = starts, physics.B.shape[1]
    states, actions, costs = [s], [], []
    for _ in range(steps):
        # A result of shape (starts,) or (n_u,) would broadcast silently.
        a = check_tensor("policy(s)", policy(s), *expected, batched=False, remedy=POLICY_REMEDY)
        a = physics.applied(a)
        costs.append(physics.cost(s, a))
        nu = physics.noise(nu, physics.draw(rng, starts))
        s = physics.step(s, a, nu)
        states.append(s)
        actions.append(a)
    return ClosedLoop(torch.stack(states), torch.stack(actions), torch.stack(costs), gamma)


@torch.no_grad()
def gymnasium_loop(
    policy: Callable[[Tensor], Tensor],
    plant: GymnasiumPlant,
    *,
    steps: int = 200,
    starts: int = 32,
    seed: int = 123,
    gamma: float = 0.99,
) -> ClosedLoop:
    """Run ``policy`` as `closed_loop` does, in a Gymnasium environment; start i has seed + i.

    After an episode's end its state stays constant, at no cost.

    Raises:
        QPError: as in `closed_loop`.
    """
    _check(policy, steps, starts, seed, gamma)
    check_kind("plant", plant, GymnasiumPlant, "Use closed_loop for a LinearSystem.")
    expected = starts, len(plant.lb_a)
    envs = [gymnasium.make(plant.id, max_episode_steps=steps) for _ in range(starts)]
    s = np.stack([env.reset(seed=seed + i)[0] for i, env in enumerate(envs)])
    states, actions, costs = [s], [], []
    over = np.zeros(starts, dtype=bool)
    low, high = plant.lb_a.numpy(), plant.ub_a.numpy()
    for _ in range(steps):
        a = policy(torch.as_tensor(s, dtype=torch.float64))
        check_tensor("policy(s)", a, *expected, batched=False, remedy=POLICY_REMEDY)
        a = a.numpy().clip(low, high)
        s, cost = s.copy(), np.zeros(starts)
        for i in np.flatnonzero(~over):
            s[i], reward, terminated, truncated, _ = envs[i].step(a[i].astype(low.dtype))
            cost[i], over[i] = -float(reward), terminated or truncated
        states.append(s)
        actions.append(a)
        costs.append(cost)
    for env in envs:
        env.close()
    s, a, L = (torch.as_tensor(np.stack(x), dtype=torch.float64) for x in (states, actions, costs))
    return ClosedLoop(s, a, L, gamma)


def closed_gap(J_start: float, J_final: float, J_true_model: float) -> float:
    """Return the share of the gap from the start to the true-model MPC that learning has closed.

    It is (J_start - J_final) / (J_start - J_true_model): 0 is no gain, 1 equals the true model. It
    is nan if the start is no worse than the true model, or a J is nan.

    Raises:
        QPError: if a J is not a number.

    Example:
        >>> closed_gap(J_start=100.0, J_final=60.0, J_true_model=50.0)
        0.8
    """
    for name, J in (("J_start", J_start), ("J_final", J_final), ("J_true_model", J_true_model)):
        check_number(name, J, lambda _: True, "a number, or nan")
    gap = J_start - J_true_model
    return (J_start - J_final) / gap if gap > 0 else math.nan


def gap_text(
    gap: float, J_start: float, J_final: float, J_true_model: float, name: str = "J"
) -> str:
    """Return a closed gap to three decimals or, if it is nan, the reason and the change of J.

    Args:
        gap: `closed_gap` of the three J.
        J_start, J_final, J_true_model: the costs.
        name: name of J in the text.

    Example:
        >>> gap_text(math.nan, 50.0, 62.3, 50.0)
        'no gap; J rose by 12.3'
    """
    if not math.isnan(gap):
        return f"{gap:.3f}"
    reason = "no true model" if math.isnan(J_true_model) else "no gap"
    change = J_final - J_start
    if not math.isfinite(change):
        return f"{reason}; {name} went from {J_start:.1f} to {J_final:.1f}"
    if f"{abs(change):.1f}" == "0.0":
        return f"{reason}; {name} did not change"
    return f"{reason}; {name} {'rose' if change > 0 else 'fell'} by {abs(change):.1f}"


def _check(policy: object, steps: int, starts: int, seed: int, gamma: float) -> None:
    """Raise `QPError` unless these arguments of both loops fit."""
    if not callable(policy):
        remedy = "Pass a function of states, such as mpc.policy."
        raise QPError.expected("policy", type(policy).__name__, "a function", remedy)
    check_whole("steps", steps, 1)
    check_whole("starts", starts, 1)
    check_whole("seed", seed, 0)
    check_number("gamma", gamma, lambda x: 0 <= x <= 1, "a discount factor in [0, 1]")
