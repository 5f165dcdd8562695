"""Logs of plants under random actions, from which models are identified."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase

from torch_qpmpc.envs.plant import Plant


def uniform_log(plant: Plant, steps: int, seed: int, episodes: int = 1) -> TensorDictBase:
    """Return ``episodes`` episodes of ``steps`` steps, ``(episodes, steps)``.

    The actions are uniform within their bounds; ``seed`` seeds them, the signals and the starts.
    """
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        env = plant.vectorised(episodes, steps, seed, episodes=episodes)
        return env.rollout(steps)
