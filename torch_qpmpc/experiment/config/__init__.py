"""A run's configuration: checking, loading and comparing it.

`model` and `groups` define its keys; `messages` turns pydantic's errors into sentences.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from pydantic import ValidationError

from torch_qpmpc.errors import QPError
from torch_qpmpc.experiment.config.messages import first_error, flatten
from torch_qpmpc.experiment.config.model import Config
from torch_qpmpc.files import damaged

__all__ = ["check_config", "differences", "flatten", "load_config", "settings"]


def check_config(cfg: DictConfig) -> None:
    """Raise `QPError` on the first unknown key, missing key or invalid value of ``cfg``."""
    try:
        Config.model_validate(OmegaConf.to_container(cfg, resolve=True))
    except ValidationError as error:
        raise first_error(error) from None


def load_config(file: Path) -> DictConfig:
    """Load a run's saved configuration as plain values.

    Raises:
        QPError: the file is missing or damaged, or has interpolations such as ``${oc.env:HOME}``,
            which would read this computer's environment.
    """
    try:
        cfg = OmegaConf.load(file)
        tree = OmegaConf.to_container(cfg, resolve=False)
        if not isinstance(cfg, DictConfig) or not isinstance(tree, dict):
            raise ValueError("it is a list")
        for key, info in Config.model_fields.items():
            if info.is_required() and key not in tree:
                raise KeyError(key)
        if not isinstance(tree["task"], dict):
            raise ValueError("its task is not a mapping")
    except Exception as error:  # damaged files raise errors of any type
        raise damaged(file, error, "the configuration that a run wrote") from error
    for key, value in flatten(tree).items():
        if isinstance(value, list | str) and "${" in str(value):
            remedy = "Interpolations of a saved configuration are not resolved: write the value."
            got = f"{key}={value!r} in {file}"
            raise QPError.expected("config.yaml", got, "values, as train.py writes them", remedy)
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
