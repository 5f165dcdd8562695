"""A run's configuration, checked, loaded and compared.

`model` and `groups` have its keys, and `messages` makes sentences of pydantic's errors.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from pydantic import ValidationError

from torch_qpmpc.experiment.config.messages import first_of, flatten
from torch_qpmpc.experiment.config.model import Config

__all__ = ["check_config", "differences", "flatten", "load_config", "settings"]

#: The keys that configurations of earlier versions lack, with what those versions did.
LATER = {key: info.default for key, info in Config.model_fields.items() if not info.is_required()}


def check_config(cfg: DictConfig) -> None:
    """Raise `QPError` on the first unknown or missing key or impossible value of ``cfg``."""
    try:
        Config.model_validate(OmegaConf.to_container(cfg, resolve=True))
    except ValidationError as error:
        raise first_of(error) from None


def load_config(file: Path) -> DictConfig:
    """Load the configuration that a run has saved, and complete one of an earlier version."""
    cfg = OmegaConf.load(file)
    assert isinstance(cfg, DictConfig)
    for key, value in LATER.items():
        if key not in cfg:
            cfg[key] = value
    return cfg


def settings(cfg: DictConfig) -> dict[str, Any]:
    """Return every setting by its dotted key, as on the command line."""
    return flatten(OmegaConf.to_container(cfg, resolve=True))


def differences(then: Mapping[str, Any], now: Mapping[str, Any]) -> tuple[str, str] | None:
    """List the `settings` in which two differ, as ``key=value`` of either, for a message."""
    then, now = {**LATER, **then}, {**LATER, **now}
    changed = [key for key in {**then, **now} if then.get(key) != now.get(key)]
    if not changed:
        return None
    before, after = (", ".join(f"{key}={of.get(key)}" for key in changed) for of in (then, now))
    return before, after
