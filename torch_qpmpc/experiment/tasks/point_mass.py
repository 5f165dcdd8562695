"""``task=point_mass``: the paper's plant, learned from a corrupted model and a random cost."""

import torch

from torch_qpmpc.envs import PointMass
from torch_qpmpc.envs.point_mass import NOISE_STD
from torch_qpmpc.experiment.config import Config
from torch_qpmpc.experiment.rivals import Policy, tightened
from torch_qpmpc.experiment.tasks.registry import Task, plant_scheme, register
from torch_qpmpc.mpc.model import Model
from torch_qpmpc.mpc.scheme import Scheme

#: Names of the signals, for figures.
NAMES = {
    "outputs": ("x", "y", "velocity in x", "velocity in y"),
    "actions": ("force in x", "force in y"),
}


def make_plant(cfg: Config) -> PointMass:
    return PointMass(noise_kind=cfg.noise.name, noise_std=cfg.noise.std)


def wrong_scheme(cfg: Config, plant: PointMass) -> Scheme:
    """Draw the corrupted model and the cost by ``cfg.seed``."""
    A, B, theta = plant.corrupted(cfg.seed)
    weight = torch.cat((theta, torch.zeros_like(plant.lb_a)))
    return plant_scheme(cfg, plant, Model(A, B), weight)


def true_scheme(cfg: Config, plant: PointMass) -> Scheme:
    A, B, offset = plant.true_model()
    weight = torch.cat((2 * plant.W.diagonal(), torch.zeros_like(plant.lb_a)))
    return plant_scheme(cfg, plant, Model(A, B, offset=offset), weight)


def tightened_mpc(plant: PointMass) -> Policy:
    """Make the rival that knows the model and the noise's covariance."""
    W = torch.diag(torch.cat((2 * plant.W.diagonal(), 0 * plant.lb_a)))
    unit = plant.std**2 * torch.eye(4).to(plant.A)
    return tightened(plant, W, unit, walk=plant.noise_kind == "brownian")


register(
    Task(
        "point_mass",
        make_plant,
        wrong_scheme,
        true_scheme,
        noises=tuple(NOISE_STD),
        episode=lambda plant, d: NAMES,
        takes_noise_std=True,
        rivals={"tightened": tightened_mpc},
        defaults=None,
    )
)
