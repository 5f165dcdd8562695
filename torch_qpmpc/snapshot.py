"""All that a run needs to go on as if it had never stopped, as tensors and plain numbers.

Exact for one collector in this process over a `LinearSystem`: its episodes, and every random
number, continue. Other environments cannot be saved, and start new episodes.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDict
from torchrl.collectors import BaseCollector, Collector

from torch_qpmpc.checkpoint import CHECKPOINT, load_checkpoint
from torch_qpmpc.envs import LinearSystemEnv
from torch_qpmpc.errors import QPError
from torch_qpmpc.experiment import Learner
from torch_qpmpc.mpc import QPMPC
from torch_qpmpc.replay import Replay
from torch_qpmpc.solvers.chain import SolveLog


@dataclass
class Tally:
    """What a run adds up.

    Attributes:
        update: how many there have been.
        costs: the mean cost of a step, of each update.
        violation: of the states' bounds, summed over all steps.
        qps: what has been solved since the last row of metrics; ``unsolved``, before that.
        seconds: of training.
    """

    update: int = 0
    costs: list[float] = field(default_factory=list)
    violation: float = 0.0
    qps: SolveLog = field(default_factory=SolveLog)
    unsolved: int = 0
    seconds: float = 0.0

    def summary(self) -> dict[str, float]:
        """What learning itself cost: over all updates, and over the last tenth of them."""
        last = self.costs[-max(1, len(self.costs) // 10) :]
        return {
            "train_seconds": self.seconds,
            "train_cost": sum(self.costs) / len(self.costs),
            "train_cost_last_tenth": sum(last) / len(last),
            "train_violation": self.violation,
            "unsolved": self.unsolved + self.qps.unsolved,
        }


def snapshot(
    mpc: QPMPC, learner: Learner, collector: BaseCollector, replay: Replay, tally: Tally
) -> dict[str, Any]:
    """The state of a run between two updates, for `checkpoint.save_checkpoint`."""
    return {
        "update": tally.update,
        "structure": mpc.structure,
        "mpc": mpc.state_dict(),
        "loss_module": learner.loss_module.state_dict(),
        "optimizer": learner.optimizer.state_dict(),
        "schedule": {"last_epoch": learner.schedule.last_epoch},
        "replay": replay.state_dict() if len(replay) else None,
        "collector": _collector_state(collector),
        "tally": asdict(tally),
        "rng": torch.get_rng_state(),
    }


def restore(
    state: dict[str, Any],
    mpc: QPMPC,
    learner: Learner,
    collector: BaseCollector,
    replay: Replay,
) -> Tally:
    """Bring the parts of a new run, made from the same configuration, to a `snapshot`."""
    learner.loss_module.load_state_dict(state["loss_module"])
    mpc.load_state_dict(state["mpc"])
    learner.optimizer.load_state_dict(state["optimizer"])
    learner.schedule.last_epoch = state["schedule"]["last_epoch"]
    if state["replay"] is not None:
        replay.load_state_dict(state["replay"])
    _restore_collector(collector, state["collector"])
    torch.set_rng_state(state["rng"])
    tally = dict(state["tally"])
    return Tally(**(tally | {"qps": SolveLog(**tally["qps"])}))


def resumed(path: str | Path, overrides: Collection[str]) -> tuple[DictConfig, dict | None]:
    """The configuration of a run that was stopped, and its last state; None before the first.

    Args:
        path: the run's folder, or one of its checkpoints.
        overrides: what train.py was called with.

    Raises:
        QPError: there is no run to go on with, or something else was asked for, too.
    """
    if others := [override for override in overrides if not override.startswith("resume=")]:
        remedy = "A run goes on with its own configuration."
        raise QPError.expected("resume", f"{', '.join(others)}, too", "nothing else", remedy)
    if not isinstance(path, str | Path):
        raise QPError.expected("resume", repr(path), "a path")
    path = Path(path)
    checkpoint = path / CHECKPOINT if path.is_dir() else path
    config = checkpoint.with_name("config.yaml")
    if not config.exists():
        raise QPError.expected("resume", f"{path}, without config.yaml", "a folder of train.py's")
    if checkpoint.with_name("summary.json").exists():
        raise QPError.expected("resume", f"{path}, which is finished", "a run that was stopped")
    cfg = OmegaConf.load(config)
    assert isinstance(cfg, DictConfig)
    early = path.is_dir() and not checkpoint.exists()
    return cfg, None if early else load_checkpoint(checkpoint)


def folder_of(resume: str | None, fresh: str) -> str:
    """Where a run writes: into the folder that it goes on with, or into a ``fresh`` one."""
    if resume is None:
        return fresh
    return str(Path(resume) if Path(resume).is_dir() else Path(resume).parent)


def _collector_state(collector: BaseCollector) -> dict[str, Any] | None:
    if not isinstance(collector, Collector) or not isinstance(collector.env, LinearSystemEnv):
        return None
    # TorchRL's own state of a collector has neither where its episodes are nor whose they are.
    return {
        "episodes": collector._carrier.to_dict(),
        "trajectories": collector._traj_pool.state_dict(),
        "rng": collector.env.get_rng_state(),
    }


def _restore_collector(collector: BaseCollector, state: dict[str, Any] | None) -> None:
    if state is None:
        return
    assert isinstance(collector, Collector)
    assert isinstance(collector.env, LinearSystemEnv)
    episodes = TensorDict(state["episodes"], batch_size=collector._carrier.batch_size)
    collector._carrier.update(episodes)
    collector._traj_pool.load_state_dict(state["trajectories"])
    collector.env.set_rng_state(state["rng"])
