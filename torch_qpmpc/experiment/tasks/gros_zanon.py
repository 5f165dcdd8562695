"""``task=gros_zanon``: Gros and Zanon's linear system, learned from their wrong model."""

import torch

from torch_qpmpc.envs import GrosZanonLTI
from torch_qpmpc.experiment.config import Config
from torch_qpmpc.experiment.rivals import Policy, tightened
from torch_qpmpc.experiment.tasks.registry import Task, plant_scheme, register
from torch_qpmpc.mpc.model import Model
from torch_qpmpc.mpc.scheme import Scheme

#: W of the cost 1/2 [x; u]' W [x; u].
WEIGHT = torch.tensor([1.0, 1.0, 0.5])


def wrong_scheme(cfg: Config, plant: GrosZanonLTI) -> Scheme:
    """Return their wrong model; as in the original, the first upper bound is too wide by one."""
    wide = plant.ub_s + torch.tensor([1.0, 0.0]).to(plant.ub_s)
    model = Model(A=[[1, 0.25], [0, 1]], B=[[0.0312], [0.25]])
    return plant_scheme(cfg, plant, model, WEIGHT, state_bounds=(plant.lb_s, wide))


def true_scheme(cfg: Config, plant: GrosZanonLTI) -> Scheme:
    A, B, offset = plant.true_model()
    return plant_scheme(cfg, plant, Model(A, B, offset=offset), WEIGHT)


def tightened_mpc(plant: GrosZanonLTI) -> Policy:
    """Make the rival that knows the model, and the noise by its mean and variance."""
    variance = torch.diag(plant.A.new_tensor([0.1**2 / 12, 0.0]))
    return tightened(plant, torch.diag(WEIGHT).to(plant.A), variance)


register(
    Task(
        "gros_zanon",
        lambda cfg: GrosZanonLTI(),
        wrong_scheme,
        true_scheme,
        noises=("uniform",),
        rivals={"tightened": tightened_mpc},
        defaults=None,
    )
)
