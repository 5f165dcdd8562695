"""Autocast is kept out: a matrix product in half precision is too coarse for a QP's data."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext

import torch
from torch import Tensor


def to_dtype(tensor: Tensor, dtype: torch.dtype) -> Tensor:
    """``tensor.to(dtype)``, sooner where there is nothing to do."""
    return tensor if tensor.dtype == dtype else tensor.to(dtype)


def full_precision(like: Tensor) -> AbstractContextManager[object]:
    """A block without autocast on the device of ``like``."""
    device = like.device.type
    if device == "meta" or not torch.is_autocast_enabled(device):
        return nullcontext()
    return torch.autocast(device, enabled=False)
