"""A Gymnasium wrapper whose observation is a window of past outputs and actions."""

from __future__ import annotations

from collections import deque
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box

from torch_qpmpc.checks import check_whole
from torch_qpmpc.errors import QPError


class WindowObservation(gymnasium.Wrapper):
    """An environment that observes [y_{k+1-L}, u_{k+1-L}, .., y_{k-1}, u_{k-1}, y_k].

    Each episode begins by waiting: a reset takes L - 1 steps with zero action, clipped into its
    bounds, so that the first window is one that the plant has had; `PastWindow` repeats the first
    output instead. These steps count towards the length of an episode, and their rewards are in
    ``waited`` only. If the episode ends while it waits, the first step ends it with a reward of
    zero, and its action is not applied.

    Args:
        env: an environment whose observations and actions are Box spaces of one dimension.
        past: L, the number of outputs in the window, at least 1.

    Attributes:
        waited: the sum of the rewards of the last reset's steps.

    Raises:
        QPError: the environment has other spaces, or ``past`` is no such number.

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
        for space in (y, u):
            if not isinstance(space, Box) or len(space.shape) != 1:
                raise QPError.expected("env", f"the space {space}", "Box spaces of one dimension")
        assert isinstance(y, Box)
        assert isinstance(u, Box)
        self.past, self.waited = past, 0.0
        self._zero = np.clip(np.zeros_like(u.low), u.low, u.high)
        self._parts: deque[np.ndarray] = deque(maxlen=2 * past - 1)
        #: How the episode ended while it waited: terminated and truncated.
        self._end: tuple[bool, bool] | None = None
        bounds = ((y.low, u.low), (y.high, u.high))
        low, high = (np.concatenate([*pair] * (past - 1) + [pair[0]]) for pair in bounds)
        self.observation_space = Box(low, high, dtype=np.result_type(y.dtype, u.dtype).type)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode, and wait until the window is full."""
        y, info = self.env.reset(seed=seed, options=options)
        self.waited, self._end = 0.0, None
        self._parts.append(np.array(y))
        for _ in range(self.past - 1):
            if self._end is None:  # after its end it stays where it is
                y, reward, terminated, truncated, info = self.env.step(self._zero.copy())
                self.waited += float(reward)
                self._end = (terminated, truncated) if terminated or truncated else None
            self._add(self._zero, y)
        return self._window(), info

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Take a step, or end an episode that ended while it waited."""
        if self._end is not None:
            return self._window(), 0.0, *self._end, {}
        y, reward, terminated, truncated, info = self.env.step(action)
        self._add(action, y)
        return self._window(), float(reward), terminated, truncated, info

    def _add(self, u: np.ndarray, y: np.ndarray) -> None:
        """Add an action and an output: copies, as the environment may write into its own."""
        self._parts.extend((np.array(u), np.array(y)))

    def _window(self) -> np.ndarray:
        return np.concatenate([*self._parts]).astype(self.observation_space.dtype)
