"""Collection of transitions: TorchRL's collectors (one process, several, or Ray) and the replay."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from functools import partial
from typing import Any

from omegaconf import DictConfig
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torchrl.collectors import BaseCollector, Collector, MultiAsyncCollector, MultiSyncCollector
from torchrl.modules import AdditiveGaussianModule

from torch_qpmpc.errors import QPError
from torch_qpmpc.experiment.tasks import AnyPlant
from torch_qpmpc.learning.operators import POLICY_ACTIVE_SET, preview_key
from torch_qpmpc.learning.replay import Replay, make_replay
from torch_qpmpc.mpc.module import QPMPC

#: Number of frames for RayCollector, which does not accept -1 for endless collection.
ENDLESS = 2**62


def num_columns(cfg: DictConfig) -> int:
    """Return the number of environments in a batch: all, or one worker's if not synchronous."""
    asynchronous = cfg.collector.name != "single" and not cfg.collector.sync
    return cfg.num_envs // cfg.collector.workers if asynchronous else cfg.num_envs


def make_collector(
    cfg: DictConfig, physics: AnyPlant, actor: TensorDictModuleBase
) -> BaseCollector:
    """Make the collector of ``actor``'s vectorised episodes with Gaussian exploration.

    The environments are split evenly among the workers, each with a copy of the actor and, for
    worker i, the seed ``cfg.seed + i``.

    Raises:
        QPError: ``collector=ray`` but Ray is not installed.
    """
    name, steps = cfg.collector.name, cfg.steps_per_update
    workers = 1 if name == "single" else cfg.collector.workers
    make_env = partial(physics.vectorised, cfg.num_envs // workers, cfg.task.episode_steps)
    makers = [partial(make_env, seed=cfg.seed + worker) for worker in range(workers)]
    env = makers[0]()
    exploration = AdditiveGaussianModule(
        env.action_spec, sigma_init=cfg.exploration_std, sigma_end=cfg.exploration_std
    )
    policy = TensorDictSequential([actor, exploration])
    options: dict[str, Any] = {"auto_register_policy_transforms": False}
    if name == "single":
        return Collector(
            env, policy, frames_per_batch=cfg.num_envs * steps, total_frames=-1, **options
        )
    env.close()
    frames = num_columns(cfg) * steps
    if name == "multi":
        kind = MultiSyncCollector if cfg.collector.sync else MultiAsyncCollector
        return kind(makers, policy, frames_per_batch=frames, total_frames=-1, **options)
    if importlib.util.find_spec("ray") is None:
        remedy = "Install it: pip install -e '.[ray]'."
        raise QPError.expected("collector", "ray, which is not installed", "Ray", remedy)
    from torchrl.collectors.distributed import RayCollector

    return RayCollector(
        makers,
        policy,
        frames_per_batch=frames,
        total_frames=ENDLESS,
        sync=cfg.collector.sync,
        remote_configs={"num_cpus": cfg.collector.num_cpus},
        collector_kwargs=options,
    )


def make_run_replay(cfg: DictConfig, mpc: QPMPC) -> Replay:
    """Make a run's replay of transitions and, for the SI penalty, of windows."""
    si = cfg.constraint.si
    return make_replay(
        cfg.replay_capacity,
        num_columns(cfg),
        cfg.batch_size,
        cfg.task.horizon,
        1 if si is None else si.windows,
        seed=cfg.seed,
        active_rows=len(mpc.G) if cfg.warm_start else None,
        n_x=mpc.n_x,
        preview_key=preview_key(mpc),
    )


def batches(collector: BaseCollector) -> Iterator[TensorDictBase]:
    """Yield batches of ``(num_columns, steps_per_update)`` transitions under the newest theta.

    The policy's active sets are left out: only its next step uses them.
    """
    in_process = isinstance(collector, Collector)
    if not in_process:
        collector.update_policy_weights_()  # pyright: ignore[reportCallIssue]
    for collected in collector:
        batch = collected.exclude(POLICY_ACTIVE_SET)
        yield batch if in_process else batch.reshape(-1, batch.shape[-1])
        if not in_process:
            collector.update_policy_weights_()  # pyright: ignore[reportCallIssue]
