"""Plants with known or hidden signals as Gymnasium environments."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import torch
from torch import Tensor

from torch_qpmpc.checks import check_kind, check_whole
from torch_qpmpc.envs.linear_system import checked_action
from torch_qpmpc.envs.past_window import first_window, next_window
from torch_qpmpc.envs.plant import Plant
from torch_qpmpc.errors import QPError


class PlantGymEnv(gymnasium.Env):
    """A Gymnasium environment of a `Plant`, whose observation is p, as `QPMPC.predict` reads it.

    That is the known signals d_k, .., d_{k+N} and the window of past outputs and applied actions,
    float32 ``(n_p,)``. An episode is truncated after ``max_steps`` and never terminates. Its seed
    gives the signals and the start that it gives in `torch_qpmpc.envs.closed_loop.plant_loop`.

    Args:
        plant: the plant.
        max_steps: steps of an episode.

    Raises:
        QPError: the plant is of another kind, or ``max_steps`` is below 1.
    """

    metadata = {"render_modes": []}  # noqa: RUF012 (Gymnasium's own convention)

    def __init__(self, plant: Plant, max_steps: int) -> None:
        check_kind("plant", plant, Plant)
        check_whole("max_steps", max_steps, 1)
        self.plant, self.max_steps = plant, max_steps
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (plant.n_p,))
        low, high = (bound.float().numpy() for bound in (plant.lb_a, plant.ub_a))
        self.action_space = gymnasium.spaces.Box(low, high)
        self._k: int | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode; return its observation and its ``violation``."""
        super().reset(seed=seed)
        plant, length = self.plant, self.max_steps + self.plant.horizon + 1
        self._w = plant.signals(self.np_random, 1, length)[0]
        self._x, self._k = plant.starts(self.np_random, 1)[0], 0
        y = plant.output(self._x, self._w[0])
        self._window = first_window(y, plant.past, torch.zeros_like(plant.lb_a))
        return self._observed()

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Apply ``action`` ``(n_u,)``, clipped; return the observation, the reward and the flags.

        Raises:
            QPError: no episode runs, or the action does not fit or is not finite.
        """
        if self._k is None or self._k == self.max_steps:
            raise QPError.expected("step", "no episode", "one that runs", "Call reset() first.")
        plant, w = self.plant, self._w[self._k]
        u = plant.applied(checked_action(action, self.action_space))
        reward = -plant.cost(self._x, u, w).item()
        self._x, self._k = plant.step(self._x, u, w), self._k + 1
        y = plant.output(self._x, self._w[self._k])
        self._window = next_window(self._window, u, y)
        observation, info = self._observed()
        return observation, reward, False, self._k == self.max_steps, info

    def _observed(self) -> tuple[np.ndarray, dict[str, Any]]:
        assert self._k is not None
        plant, ahead = self.plant, self._w[self._k : self._k + self.plant.horizon + 1]
        p: Tensor = torch.cat((ahead[:, : plant.n_d].flatten(), self._window))
        info = {"violation": plant.violation(self._x, ahead[0]).item()}
        return p.numpy().astype(np.float32), info
