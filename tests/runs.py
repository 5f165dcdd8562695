"""Configurations for the tests: composed as train.py does, and small enough to run in a second."""

from __future__ import annotations

import copy
import functools
import itertools
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig

import train
from torch_qpmpc import QPMPC
from torch_qpmpc.envs import LinearSystem
from torch_qpmpc.experiment.tasks import make_physics, make_true_mpc

CONFIGS = Path(__file__).parents[1] / "configs"
#: Everything shrinks but the point mass itself, and nothing is drawn: figures are most of the time
#: of a small run.
SMALL = (
    "optimizer=adam",
    "solver=daqp",
    "updates=4",
    "batch_size=8",
    "num_envs=4",
    "warmup_steps=4",
    "replay_capacity=400",
    "eval_interval=2",
    "log_interval=1",
    "task.horizon=3",
    "task.episode_steps=12",
    "task.eval_steps=10",
    "figures=false",
)


def make_config(*overrides: str) -> DictConfig:
    """configs/ with overrides as on the command line, of which the last for a key counts."""
    latest = {override.partition("=")[0]: override for override in overrides}
    return copy.deepcopy(_composed(*latest.values()))


@functools.cache
def _composed(*overrides: str) -> DictConfig:
    with initialize_config_dir(version_base="1.3", config_dir=str(CONFIGS)):
        return compose("config", overrides=list(overrides))


def run_command(*arguments: str) -> None:
    """``python train.py ..`` in this process.

    Hydra finds the folder by itself only for a script, not for an imported module.
    """
    quiet = ("hydra/job_logging=disabled", "hydra/hydra_logging=disabled")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["train.py", "--config-path", str(CONFIGS), *arguments, *quiet])
        train.main()


def covering(combinations: Iterable[tuple[str, ...]]) -> list[tuple[str, ...]]:
    """A few of the combinations that have every pair of choices which one of them has."""

    def pairs(combination: tuple[str, ...]) -> set[Any]:
        return set(itertools.combinations(enumerate(combination), 2))

    given, chosen = list(combinations), []
    left = set().union(*map(pairs, given))
    while left:
        chosen.append(max(given, key=lambda combination: len(pairs(combination) & left)))
        left -= pairs(chosen[-1])
    return chosen


def choices(group: str) -> list[str]:
    """The names that a group can be set to."""
    return sorted(path.stem for path in (CONFIGS / group).glob("*.yaml"))


def linear_system(cfg: DictConfig) -> LinearSystem:
    """A plant that has a true model."""
    physics = make_physics(cfg)
    assert isinstance(physics, LinearSystem)
    return physics


def true_mpc(cfg: DictConfig, physics: LinearSystem) -> QPMPC:
    """The MPC that knows the plant."""
    mpc = make_true_mpc(cfg, physics)
    assert mpc is not None
    return mpc
