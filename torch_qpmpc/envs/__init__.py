"""Plants and environments; Gymnasium has the point mass as ``torch_qpmpc/PointMass-v0``."""

from torch_qpmpc.envs.gros_zanon import GrosZanonLTI
from torch_qpmpc.envs.gymnasium_plant import GymnasiumPlant
from torch_qpmpc.envs.kalman_filter import KalmanFilter
from torch_qpmpc.envs.linear_system import LinearSystem, LinearSystemEnv, LinearSystemGymEnv
from torch_qpmpc.envs.plant import Plant, PlantEnv
from torch_qpmpc.envs.point_mass import PointMass, PointMassGymEnv

__all__ = [
    "GrosZanonLTI",
    "GymnasiumPlant",
    "KalmanFilter",
    "LinearSystem",
    "LinearSystemEnv",
    "LinearSystemGymEnv",
    "Plant",
    "PlantEnv",
    "PointMass",
    "PointMassGymEnv",
]
