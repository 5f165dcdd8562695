"""Learners of each algorithm, with batches of random transitions."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase

from tests.runs import SMALL, make_config
from torch_qpmpc import QPMPC, QPActorValueOperator
from torch_qpmpc.experiment.algorithms import Learner, make_learner
from torch_qpmpc.experiment.tasks import make_mpc, make_physics


def make(*overrides: str, seed: int = 0, done: int = 0) -> tuple[Learner, QPMPC, TensorDictBase]:
    """Make a learner, its actor's QP, and a batch of random transitions."""
    torch.manual_seed(seed)
    cfg = make_config(*SMALL, "constraint=free", *overrides)
    physics = make_physics(cfg)
    mpc = make_mpc(cfg, physics)
    learner = make_learner(cfg, QPActorValueOperator(mpc), done=done)
    env = physics.vectorised(4, 12, seed=seed)
    batch: TensorDictBase = env.rollout(3).reshape(-1)
    env.close()
    return learner, mpc, batch
