"""A run's configuration: checking, loading and comparing it.

`model` and `groups` define its keys; `messages` turns pydantic's errors into sentences.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from pydantic import ValidationError

from torch_qpmpc.experiment.config.messages import first_error, flatten
from torch_qpmpc.experiment.config.model import Config

__all__ = ["check_config", "differences", "flatten", "load_config", "settings"]


def check_config(cfg: DictConfig) -> None:
    """Raise `QPError` on the first unknown key, missing key or invalid value of ``cfg``."""
    try:
        Config.model_validate(OmegaConf.to_container(cfg, resolve=True))
    except ValidationError as error:
        raise first_error(error) from None


def load_config(file: Path) -> DictConfig:
    """Load a run's saved configuration."""
    cfg = OmegaConf.load(file)
    assert isinstance(cfg, DictConfig)
    return cfg


def settings(cfg: DictConfig) -> dict[str, Any]:
    """Return every setting by its dotted key."""
    return flatten(OmegaConf.to_container(cfg, resolve=True))


def differences(then: Mapping[str, Any], now: Mapping[str, Any]) -> tuple[str, str] | None:
    """Return the differing `settings` of both as ``key=value, ..``; None if all are equal."""
    changed = [key for key in {**then, **now} if then.get(key) != now.get(key)]
    if not changed:
        return None
    before, after = (", ".join(f"{key}={of.get(key)}" for key in changed) for of in (then, now))
    return before, after
