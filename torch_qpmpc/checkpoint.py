"""Checkpoints: written so that a crash leaves the previous one, read without running code."""

from __future__ import annotations

import os
import pickle
import shutil
import zipfile
from pathlib import Path
from typing import Any

import torch

from torch_qpmpc.errors import QPError

#: The newest checkpoint of a run's folder, and the one before.
CHECKPOINT, PREVIOUS = "checkpoint.pt", "checkpoint-previous.pt"


def save_checkpoint(path: str | Path, state: dict[str, Any]) -> None:
    """Write ``state`` to ``path`` atomically, and keep what was there as `PREVIOUS` beside it.

    Raises:
        OSError: it cannot be written, as on a full disk; both files are as they were.
    """
    path = Path(path)
    partial = path.with_suffix(".partial")
    with partial.open("wb") as file:
        torch.save(state, file)
        file.flush()
        os.fsync(file.fileno())
    if path.exists():
        # A second name for the old file, so that at no time there is none under the first.
        second = path.with_suffix(".second")
        second.unlink(missing_ok=True)
        try:
            os.link(path, second)
        except OSError:  # a file system without links
            shutil.copyfile(path, second)
        second.replace(path.with_name(PREVIOUS))
    partial.replace(path)


def load_checkpoint(path: str | Path) -> dict[str, Any]:
    """Read a checkpoint with ``weights_only=True``.

    Raises:
        QPError: it is missing, damaged, or holds something other than tensors and numbers.
    """
    path = Path(path)
    try:
        with zipfile.ZipFile(path) as file:  # torch.load does not look at the checksums
            if damaged := file.testzip():
                raise zipfile.BadZipFile(damaged)
        return torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError as error:
        raise QPError.expected("checkpoint", f"{path}, which is not there", "a file") from error
    except (*_UNREADABLE, RuntimeError) as error:
        remedy = "It may be truncated, or hold something other than tensors"
        previous = path.with_name(PREVIOUS)
        found = path.name != PREVIOUS and previous.exists()
        raise QPError.expected(
            "checkpoint",
            f"{path}, which cannot be read ({type(error).__name__})",
            "a checkpoint that train.py wrote",
            f"{remedy}; use {f'the one before, {previous}' if found else 'another one'}.",
        ) from error


_UNREADABLE = (EOFError, OSError, pickle.UnpicklingError, zipfile.BadZipFile, KeyError, ValueError)
