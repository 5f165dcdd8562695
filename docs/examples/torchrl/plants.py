"""The start of each script: the paper's point mass or a Gymnasium environment, and a first QP."""

import argparse
import sys
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from tensordict.nn import TensorDictModule
from torchrl.envs import EnvBase

import torch_qpmpc as qm
from torch_qpmpc.envs.closed_loop import closed_loop
from torch_qpmpc.experiment.start import Exploration


class Start(NamedTuple):
    """Sixteen environments, the QP that learns, J of a policy, and the bounds of its actions."""

    env: EnvBase
    mpc: qm.QPMPC
    J: Callable[[Any], float]
    bounds: tuple[torch.Tensor, torch.Tensor]


def start(id: str | None, seed: int) -> Start:
    """Make the point mass with a wrong model and a random cost, or ``id`` with a log's."""
    torch.manual_seed(seed)
    sys.path.append("")  # for MODULE:ID of the current folder
    plant: Any = qm.envs.PointMass() if id is None else qm.envs.GymnasiumPlant(id)
    bounds = plant.lb_a, plant.ub_a
    options: Any = {"action_bounds": bounds, "learn": ("H", "c", "C"), "solver": "daqp"}
    if id is None:
        A, B, weight = plant.corrupted(seed)
        weight = torch.cat((weight, torch.tensor([0.1, 0.1])))
        mpc = qm.QPMPC.from_model(A, B, 10, stage_weight=weight, gamma=0.9, **options)
        env = plant.vectorised(16, 50, seed=seed)
        return Start(env, mpc, lambda policy: closed_loop(policy, plant).J, bounds)
    env = plant.vectorised(16, None, seed=seed)
    random = Exploration(*bounds, hold=4, seed=seed)  # 4 steps on average
    module = TensorDictModule(random, ["observation"], ["action"])
    log = env.rollout(125, module, break_when_any_done=False)
    mpc = qm.QPMPC.from_data(log, 10, gamma=0.98, **options)
    bounds = plant.lb_a.to(env.action_spec.dtype), plant.ub_a.to(env.action_spec.dtype)
    return Start(env, mpc, lambda policy: closed_loop(policy, plant, starts=8).J, bounds)


def options() -> dict[str, Any]:
    """Read the command line."""
    parser = argparse.ArgumentParser(argument_default=argparse.SUPPRESS)
    parser.add_argument("--id", help="a Gymnasium environment, as Pendulum-v1 or MODULE:ID")
    parser.add_argument("--updates", type=int)
    parser.add_argument("--seed", type=int)
    return vars(parser.parse_args())
