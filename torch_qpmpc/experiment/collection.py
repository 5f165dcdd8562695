"""Collection of transitions: TorchRL's collector and the replay."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from omegaconf import DictConfig
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torchrl.collectors import Collector
from torchrl.modules import AdditiveGaussianModule

from torch_qpmpc.experiment.tasks import AnyPlant
from torch_qpmpc.learning.operators import POLICY_ACTIVE_SET, preview_key
from torch_qpmpc.learning.replay import Replay
from torch_qpmpc.mpc.module import QPMPC


def make_collector(cfg: DictConfig, physics: AnyPlant, actor: TensorDictModuleBase) -> Collector:
    """Make the collector of ``actor``'s vectorised episodes with Gaussian exploration."""
    env = physics.vectorised(cfg.num_envs, cfg.task.episode_steps, seed=cfg.seed)
    exploration = AdditiveGaussianModule(
        env.action_spec, sigma_init=cfg.exploration_std, sigma_end=cfg.exploration_std
    )
    policy = TensorDictSequential([actor, exploration])
    options: Any = {"auto_register_policy_transforms": False}
    frames = cfg.num_envs * cfg.steps_per_update
    return Collector(env, policy, frames_per_batch=frames, total_frames=-1, **options)


def make_run_replay(cfg: DictConfig, mpc: QPMPC) -> Replay:
    """Make a run's replay of transitions and, for the SI penalty, of windows."""
    si = cfg.constraint.si
    return Replay(
        cfg.replay_capacity,
        cfg.num_envs,
        cfg.batch_size,
        cfg.task.horizon,
        1 if si is None else si.windows,
        seed=cfg.seed,
        active_rows=len(mpc.G),
        preview_key=preview_key(mpc),
    )


def warm_up_batches(cfg: DictConfig) -> int:
    """Return the number of batches, of ``steps_per_update`` steps each, of a run's warm-up."""
    return -(-cfg.warmup_steps // cfg.steps_per_update)


def batches(collector: Collector) -> Iterator[TensorDictBase]:
    """Yield batches of ``(num_envs, steps_per_update)`` transitions under the newest theta.

    The policy's active sets are left out: only its next step uses them.
    """
    for batch in collector:
        yield batch.exclude(POLICY_ACTIVE_SET)
