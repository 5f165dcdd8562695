"""Designs as tensors and plain values, for files that run no code."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torch_qpmpc.control.design import Design
from torch_qpmpc.control.disturbance import Disturbances
from torch_qpmpc.control.state_space import StateSpace
from torch_qpmpc.control.steady import Steady


def stored_design(design: Design) -> dict[str, Any]:
    """Return a design without the steady states, which follow from the rest."""
    content = packed(design)
    del content["steady"]
    return content


def read_stored(content: Mapping[str, Any]) -> Design:
    """Return the design that `stored_design` made ``content`` of."""
    parts = unpacked(content)
    parts["plant"] = StateSpace(**parts["plant"])
    parts["disturbances"] = Disturbances(**parts["disturbances"])
    of = (parts[name] for name in ("plant", "disturbances", "Q", "R"))
    return Design(**parts, steady=Steady.of(*of))


def packed(value: Any) -> Any:
    """Return dataclasses and named tuples as dictionaries, and arrays as tensors."""
    if is_dataclass(value):
        value = {field.name: getattr(value, field.name) for field in fields(value)}
    if hasattr(value, "_asdict"):
        value = value._asdict()
    if isinstance(value, Mapping):
        return {name: packed(part) for name, part in value.items()}
    if isinstance(value, tuple):
        return [packed(part) for part in value]
    return torch.from_numpy(value.copy()) if isinstance(value, np.ndarray) else value


def unpacked(value: Any) -> Any:
    """Return tensors as arrays, and lists as tuples."""
    if isinstance(value, Mapping):
        return {name: unpacked(part) for name, part in value.items()}
    if isinstance(value, list):
        return tuple(unpacked(part) for part in value)
    return value.numpy() if isinstance(value, Tensor) else value
