"""Plants and environments; Gymnasium has them as ``torch_qpmpc/PointMass-v0`` and the like."""

from __future__ import annotations

from torch_qpmpc.envs.gros_zanon import GrosZanonLTI, GrosZanonLTIGymEnv
from torch_qpmpc.envs.gymnasium_plant import GymnasiumPlant
from torch_qpmpc.envs.linear_system import LinearSystem, LinearSystemEnv, LinearSystemGymEnv
from torch_qpmpc.envs.past_window import PastWindow
from torch_qpmpc.envs.plant import Plant, PlantEnv
from torch_qpmpc.envs.point_mass import PointMass, PointMassEnv, PointMassGymEnv
from torch_qpmpc.envs.window_observation import WindowObservation

__all__ = [
    "GrosZanonLTI",
    "GrosZanonLTIGymEnv",
    "GymnasiumPlant",
    "LinearSystem",
    "LinearSystemEnv",
    "LinearSystemGymEnv",
    "PastWindow",
    "Plant",
    "PlantEnv",
    "PointMass",
    "PointMassEnv",
    "PointMassGymEnv",
    "WindowObservation",
]
