"""The experiment's environments; importing this registers ``torch_qpmpc/PointMass-v0``."""

from __future__ import annotations

import gymnasium

from torch_qpmpc.envs.point_mass import PointMass, PointMassEnv, PointMassGymEnv

__all__ = ["PointMass", "PointMassEnv", "PointMassGymEnv"]

# Registering an id twice warns, and a reload or a spawned worker imports this again.
if "torch_qpmpc/PointMass-v0" not in gymnasium.registry:
    gymnasium.register(
        id="torch_qpmpc/PointMass-v0",
        entry_point="torch_qpmpc.envs.point_mass:PointMassGymEnv",
        max_episode_steps=50,
    )
