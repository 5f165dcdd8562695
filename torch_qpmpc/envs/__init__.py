"""Plants and environments; Gymnasium has them as ``torch_qpmpc/PointMass-v0`` and the like."""

from __future__ import annotations

from torch_qpmpc.envs.actuator_noise import ActuatorNoise
from torch_qpmpc.envs.arx_plant import ARXPlant
from torch_qpmpc.envs.four_tanks import FourTanks
from torch_qpmpc.envs.gros_zanon import GrosZanonLTI, GrosZanonLTIEnv, GrosZanonLTIGymEnv
from torch_qpmpc.envs.gymnasium_plant import GymnasiumPlant
from torch_qpmpc.envs.house import House
from torch_qpmpc.envs.house_wall import HouseWall
from torch_qpmpc.envs.inventory import Inventory
from torch_qpmpc.envs.linear_plant import LinearPlant
from torch_qpmpc.envs.linear_system import LinearSystem, LinearSystemEnv, LinearSystemGymEnv
from torch_qpmpc.envs.past_window import PastWindow
from torch_qpmpc.envs.plant import Plant, PlantEnv
from torch_qpmpc.envs.plant_gym import PlantGymEnv
from torch_qpmpc.envs.point_mass import PointMass, PointMassEnv, PointMassGymEnv
from torch_qpmpc.envs.tank_references import TankReferences
from torch_qpmpc.envs.triple_integrator import TripleIntegrator
from torch_qpmpc.envs.window_observation import WindowObservation

__all__ = [
    "ARXPlant",
    "ActuatorNoise",
    "FourTanks",
    "GrosZanonLTI",
    "GrosZanonLTIEnv",
    "GrosZanonLTIGymEnv",
    "GymnasiumPlant",
    "House",
    "HouseWall",
    "Inventory",
    "LinearPlant",
    "LinearSystem",
    "LinearSystemEnv",
    "LinearSystemGymEnv",
    "PastWindow",
    "Plant",
    "PlantEnv",
    "PlantGymEnv",
    "PointMass",
    "PointMassEnv",
    "PointMassGymEnv",
    "TankReferences",
    "TripleIntegrator",
    "WindowObservation",
]
