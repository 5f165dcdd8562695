"""Configurations for the tests: composed as train.py does, and small enough to run in a second."""

from __future__ import annotations

from pathlib import Path

from hydra import compose, initialize_config_dir
from omegaconf import DictConfig

CONFIGS = Path(__file__).parents[1] / "configs"
#: Everything shrinks but the point mass itself.
SMALL = (
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
)


def make_config(*overrides: str) -> DictConfig:
    """configs/ with overrides as on the command line."""
    with initialize_config_dir(version_base="1.3", config_dir=str(CONFIGS)):
        return compose("config", overrides=list(overrides))


def choices(group: str) -> list[str]:
    """The names that a group can be set to."""
    return sorted(path.stem for path in (CONFIGS / group).glob("*.yaml"))
