"""Configurations for the tests, composed as by train.py and small enough to run in a second."""

import copy
import functools
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from hydra import compose, initialize_config_dir
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from omegaconf import DictConfig

import train
from torch_qpmpc import QPMPC
from torch_qpmpc.envs import LinearSystem
from torch_qpmpc.experiment.config import Config
from torch_qpmpc.experiment.tasks import make_physics, make_true_mpc

CONFIGS = Path(__file__).parents[1] / "configs"
#: Overrides of a small run, without figures and rivals, which would take most of its time.
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
    "gate=false",
    "rivals=false",
)


def make_config(*overrides: str) -> Any:  # whose parts are narrower than those of each Config
    return Config.of(compose_config(*overrides))


def compose_config(*overrides: str) -> DictConfig:
    """Compose configs/ with overrides; the last override of a key counts.

    Composing takes long: Hydra composes each choice of groups, and keys of its own, once, and then
    sets values in copies.
    """
    latest = {override.partition("=")[0]: override for override in overrides}
    groups = [
        override
        for key, override in latest.items()
        if key.startswith("hydra.") or (CONFIGS / key.strip("+~")).is_dir()
    ]
    cfg = copy.deepcopy(composed(*groups))
    values = [_parsed(x) for x in latest.values() if x not in groups]
    ConfigLoaderImpl._apply_overrides_to_config(values, cfg)
    return cfg


@functools.cache
def composed(*groups: str) -> DictConfig:
    """Compose configs/; whoever registers another task of the same name clears the cache."""
    with initialize_config_dir(version_base="1.3", config_dir=str(CONFIGS)):
        return compose("config", overrides=list(groups))


@functools.cache
def _parsed(override: str) -> Override:
    return OverridesParser.create().parse_override(override)


def run_command(*arguments: str) -> None:
    """Run ``python train.py ..`` in this process.

    Hydra finds the folder of configurations only for a script, not for an imported module.
    """
    quiet = ("hydra/job_logging=disabled", "hydra/hydra_logging=disabled")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["train.py", "--config-path", str(CONFIGS), *arguments, *quiet])
        train.main()


def ended(*words: object, cwd: Path = CONFIGS.parent, **environment: str) -> Any:
    """Run a command of another process to its end, which is a success."""
    as_text: dict[str, Any] = {"capture_output": True, "text": True, "timeout": 1200}
    command, variables = [*map(str, words)], os.environ | environment
    process = subprocess.run(command, cwd=cwd, env=variables, check=False, **as_text)
    assert process.returncode == 0, f"{process.stdout[-2000:]}\n{process.stderr[-3000:]}"
    return process


def choices(group: str) -> list[str]:
    return sorted(path.stem for path in (CONFIGS / group).glob("*.yaml"))


def linear_system(cfg: Config) -> LinearSystem:
    physics = make_physics(cfg)
    assert isinstance(physics, LinearSystem)
    return physics


def true_mpc(cfg: Config, physics: LinearSystem) -> QPMPC:
    mpc = make_true_mpc(cfg, physics)
    assert mpc is not None
    return mpc
