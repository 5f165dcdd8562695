"""Checkpoints: written so that a crash leaves the previous one, read without running code."""

from __future__ import annotations

import os
import pickle
from pathlib import Path
from typing import Any

import torch

from torch_qpmpc.errors import QPError


def save_checkpoint(path: str | Path, state: dict[str, Any]) -> None:
    """Write ``state`` to ``path`` atomically: to a file beside it, then renamed."""
    path = Path(path)
    partial = path.with_suffix(".partial")
    with partial.open("wb") as file:
        torch.save(state, file)
        file.flush()
        os.fsync(file.fileno())
    partial.replace(path)


def load_checkpoint(path: str | Path) -> dict[str, Any]:
    """Read a checkpoint with ``weights_only=True``; `QPError` if it is missing or damaged."""
    try:
        return torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError as error:
        raise QPError.expected("checkpoint", f"{path}, which is not there", "a file") from error
    except (RuntimeError, EOFError, OSError, pickle.UnpicklingError) as error:
        raise QPError.expected(
            "checkpoint",
            f"{path}, which cannot be read ({type(error).__name__})",
            "a checkpoint that train.py wrote",
            "It may be truncated, or hold something other than tensors; use another one.",
        ) from error
