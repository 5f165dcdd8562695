"""Any Gymnasium environment with continuous observations and actions as the plant of a task.

Unlike a `LinearSystem` it is a black box: it can only be reset and stepped.
"""

from __future__ import annotations

import copy
import math
import traceback
import warnings
from functools import partial
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box, Dict, Tuple
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import FlattenObservation
from torch import Tensor
from torchrl.envs import DoubleToFloat, EnvBase, GymWrapper, TransformedEnv

from torch_qpmpc.checks import check_kind, check_seed, check_whole
from torch_qpmpc.envs.kalman_filter import KalmanFilter
from torch_qpmpc.errors import QPError
from torch_qpmpc.identification.innovations import Innovations

#: The length of episodes of an environment that has no limit of its own.
STEPS = 200
#: The size of an action that is a solver's rounding, relative to its bounds.
ROUNDING = 1e-9


class GymnasiumPlant:
    """A Gymnasium environment as a plant: its observation is the state s, its reward -L.

    Args:
        id: id of a registered environment with Box spaces of one dimension. The parts of a Dict or
            a Tuple of observations become one vector, in the order of the space.
        kwargs: further arguments of `gymnasium.make`.

    Attributes:
        id, kwargs: the arguments.
        observer: the model whose estimated state takes the observation's place, see `observed`.
        lb_s, ub_s, lb_a, ub_a: the bounds of its spaces, ``(n_y,)`` and ``(n_u,)``.
        max_steps: the environment's own ``max_episode_steps``; 200 if it has none.
        raised: the exceptions that ended episodes, as text. The last step of such an episode has a
            reward of NaN, and is not learned from.

    Raises:
        QPError: if the environment cannot be made, or has other spaces.

    Example:
        >>> GymnasiumPlant("Pendulum-v1").ub_a
        tensor([2.], dtype=torch.float64)
    """

    def __init__(self, id: str, **kwargs: Any) -> None:
        check_kind("task.id", id, str)
        self.id, self.kwargs = id, kwargs
        self.raised: list[str] = []
        self.observer: Innovations | None = None
        try:
            env = self.make()
        except (gymnasium.error.Error, ImportError) as error:
            expected = "an environment that Gymnasium can make, as ID or MODULE:ID"
            raise QPError.expected("task.id", repr(id), expected, str(error)) from error
        except TypeError as error:
            if not kwargs:
                raise
            expected = f"arguments of {id!r}"
            raise QPError.expected("task.kwargs", repr(kwargs), expected, str(error)) from error
        self.lb_s, self.ub_s = self._bounds("observation", env.observation_space)
        self.lb_a, self.ub_a = self._bounds("action", env.action_space)
        self.max_steps = (env.spec and env.spec.max_episode_steps) or STEPS
        env.close()

    @property
    def n_x(self) -> int:
        """Entries of the state that a policy sees: the observation, or the model's state."""
        return len(self.lb_s if self.observer is None else self.observer.A)

    def observed(self, model: Innovations | None) -> GymnasiumPlant:
        """Return this plant with the estimate of the state of ``model`` as its observation."""
        plant = copy.copy(self)
        plant.observer = model
        return plant

    def make(self, max_steps: int | None = None) -> gymnasium.Env[Any, Any]:
        """Make one environment; ``max_steps`` replaces the length of its episodes.

        Actions are clipped to their bounds. Those smaller than 1e-9 of them become zero, because
        some plants react to the tiniest one.
        """
        env = gymnasium.make(self.id, max_episode_steps=max_steps, **self.kwargs)
        if isinstance(env.observation_space, Dict | Tuple):
            env = FlattenObservation(env)
        return _Guarded(env, self.raised)

    def _bounds(self, name: str, space: Any) -> tuple[Tensor, Tensor]:
        if not isinstance(space, Box) or len(space.shape) != 1:
            got = f"{self.id!r}, whose {name} space is {space}"
            remedy = "Choose an environment with real vectors as observations and actions."
            raise QPError.expected("task.id", got, "Box spaces of one dimension", remedy)
        if not np.issubdtype(space.dtype, np.floating):
            got, want = f"{self.id!r}, whose {name}s are {space.dtype}", "real numbers"
            remedy = f"Convert them by a Transform{name.title()} with a Box of floats."
            raise QPError.expected("task.id", got, want, remedy)
        low, high = (torch.as_tensor(x, dtype=torch.float64) for x in (space.low, space.high))
        return low, high

    def vectorised(self, num_envs: int, max_steps: int | None, seed: int) -> EnvBase:
        """Make a TorchRL environment of ``num_envs`` episodes of at most ``max_steps`` steps.

        None is the environment's own length. ``seed`` seeds all of them.
        """
        check_whole("num_envs", num_envs, 1)
        max_steps = self.max_steps if max_steps is None else max_steps
        check_whole("max_steps", max_steps, 1)
        check_seed(seed)
        # TorchRL resets by itself; Gymnasium's reset would lose an episode's last observation.
        makers = [partial(self.make, max_steps)] * num_envs
        envs = SyncVectorEnv(makers, autoreset_mode=AutoresetMode.DISABLED)
        env = TransformedEnv(GymWrapper(envs), DoubleToFloat())
        if self.observer is not None:
            env.append_transform(KalmanFilter(self.observer))
        env.set_seed(seed)
        return env


class _Guarded(gymnasium.Wrapper):
    """Bounds actions, checks observations, and notes in ``raised`` what ends an episode's step."""

    def __init__(self, env: gymnasium.Env[Any, Any], raised: list[str]) -> None:
        super().__init__(env)
        self._raised, self._last = raised, None

    def _seen(self, y: Any) -> Any:
        if np.shape(y) != (shape := self.observation_space.shape):
            got, want = f"an observation of shape {np.shape(y)}", f"{shape}, as in its space"
            raise QPError.expected("task.id", got, want)
        self._last = y
        return y

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        y, info = self.env.reset(**options)
        return self._seen(y), info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        space: Any = self.action_space
        size = np.nan_to_num(np.abs((space.low, space.high)), posinf=0.0).max(0)
        applied = np.where(np.abs(action) <= ROUNDING * size, 0, action).clip(space.low, space.high)
        try:
            y, reward, terminated, truncated, info = self.env.step(applied.astype(action.dtype))
            reward = np.asarray(reward, float).item()  # from an array of one, too
        except gymnasium.error.Error:  # of how the environment is used
            raise
        except Exception as error:
            at = traceback.extract_tb(error.__traceback__)[-1]
            text = f"{type(error).__name__}: {error} ({at.filename}, line {at.lineno})"
            self._raised.append(text)
            if len(self._raised) == 1:
                warnings.warn(f"The plant ends an episode by {text}.", stacklevel=2)
            return self._last, math.nan, False, True, {}
        return self._seen(y), reward, terminated, truncated, info
