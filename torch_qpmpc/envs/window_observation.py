"""A Gymnasium wrapper whose observation is a window of past outputs and actions."""

from __future__ import annotations

from collections import deque
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box

from torch_qpmpc.checks import check_whole


class WindowObservation(gymnasium.Wrapper):
    """An environment that observes [y_{k+1-L}, u_{k+1-L}, .., y_{k-1}, u_{k-1}, y_k].

    Each episode begins by waiting: a reset takes L - 1 steps with zero action, clipped into its
    bounds, so that the first window is one that the plant has had. The sum of their rewards is
    ``info["waited"]`` of the reset, and in no step's reward. If the episode ends while it waits,
    the first step ends it with a reward of zero, and its action is not applied.

    Args:
        env: an environment whose observations and actions are Box spaces of one dimension.
        past: L, the number of outputs in the window, at least 1.

    Raises:
        QPError: ``past`` is no such number.

    Example:
        >>> import gymnasium
        >>> env = WindowObservation(gymnasium.make("Pendulum-v1"), 3)
        >>> env.reset(seed=0)[0].shape  # 3 outputs of 3 entries, and 2 actions of 1
        (11,)
    """

    def __init__(self, env: gymnasium.Env[Any, Any], past: int) -> None:
        check_whole("past", past, 1)
        super().__init__(env)
        y, u = env.observation_space, env.action_space
        assert isinstance(y, Box)
        assert isinstance(u, Box)
        self._zero = np.clip(np.zeros_like(u.low), u.low, u.high)
        parts: deque[np.ndarray] = deque(maxlen=2 * past - 1)
        self._parts = parts
        bounds = ((y.low, u.low), (y.high, u.high))
        low, high = (np.concatenate([*pair] * (past - 1) + [pair[0]]) for pair in bounds)
        self.observation_space = Box(low, high, dtype=np.result_type(y.dtype, u.dtype).type)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode, and wait until the window is full."""
        y, info = self.env.reset(seed=seed, options=options)
        self._parts.clear()
        self._parts.append(y)
        waited, self._over = 0.0, False
        while len(self._parts) < (self._parts.maxlen or 1):
            if self._over:  # an ended environment stays where it is
                self._parts.extend((self._zero, self._parts[-1]))
                continue
            y, reward, terminated, truncated, info = self.env.step(self._zero)
            self._ends = terminated, truncated
            self._over = any(self._ends)
            waited += float(reward)
            self._parts.extend((self._zero, y))
        return self._window(), {**info, "waited": waited}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Take a step, or end an episode that ended while it waited."""
        if self._over:
            return self._window(), 0.0, self._ends[0], self._ends[1], {}
        y, reward, terminated, truncated, info = self.env.step(action)
        self._parts.extend((action, y))
        return self._window(), float(reward), terminated, truncated, info

    def _window(self) -> np.ndarray:
        return np.concatenate([*self._parts]).astype(self.observation_space.dtype)
