"""Plants and environments; importing this registers Gymnasium ids, as torch_qpmpc/PointMass-v0."""

from __future__ import annotations

import gymnasium

from torch_qpmpc.envs.gros_zanon import GrosZanonLTI, GrosZanonLTIEnv, GrosZanonLTIGymEnv
from torch_qpmpc.envs.gymnasium_plant import GymnasiumPlant
from torch_qpmpc.envs.linear_system import LinearSystem, LinearSystemEnv, LinearSystemGymEnv
from torch_qpmpc.envs.point_mass import PointMass, PointMassEnv, PointMassGymEnv

__all__ = [
    "GrosZanonLTI",
    "GrosZanonLTIEnv",
    "GrosZanonLTIGymEnv",
    "GymnasiumPlant",
    "LinearSystem",
    "LinearSystemEnv",
    "LinearSystemGymEnv",
    "PointMass",
    "PointMassEnv",
    "PointMassGymEnv",
]

for _name, _module, _steps in (
    ("PointMass", "point_mass", 50),
    ("GrosZanonLTI", "gros_zanon", 5000),
):
    # Registering an id twice warns, and a reload or a spawned worker runs this again.
    if f"torch_qpmpc/{_name}-v0" not in gymnasium.registry:
        gymnasium.register(
            id=f"torch_qpmpc/{_name}-v0",
            entry_point=f"torch_qpmpc.envs.{_module}:{_name}GymEnv",
            max_episode_steps=_steps,
        )
