"""Plants, and their TorchRL environments."""

from __future__ import annotations

from torch_qpmpc.envs.gros_zanon import GrosZanonLTI
from torch_qpmpc.envs.gymnasium_plant import GymnasiumPlant
from torch_qpmpc.envs.kalman_filter import KalmanFilter
from torch_qpmpc.envs.linear_system import LinearSystem, LinearSystemEnv
from torch_qpmpc.envs.plant import Plant, PlantEnv
from torch_qpmpc.envs.point_mass import PointMass, PointMassEnv

__all__ = [
    "GrosZanonLTI",
    "GymnasiumPlant",
    "KalmanFilter",
    "LinearSystem",
    "LinearSystemEnv",
    "Plant",
    "PlantEnv",
    "PointMass",
    "PointMassEnv",
]
