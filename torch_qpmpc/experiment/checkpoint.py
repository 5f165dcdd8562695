"""Checkpoints: written so that a crash leaves the previous one, read without running code."""

from __future__ import annotations

import contextlib
import io
import os
import shutil
import zipfile
from pathlib import Path
from typing import Any

import torch

from torch_qpmpc.errors import QPError

#: The newest checkpoint of a run's folder, and the one before.
CHECKPOINT, PREVIOUS = "checkpoint.pt", "checkpoint-previous.pt"
#: What the newest one is also called while it becomes the one before.
SECOND = "checkpoint.second"


def write_whole(path: Path, data: bytes | memoryview) -> None:
    """Write ``data`` to ``path`` so that at all times the file is the old one or the new one.

    Raises:
        OSError: it cannot be written, as on a full disk; the file is as it was.
    """
    partial = path.with_name(f"{path.name}.partial")
    try:
        with partial.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    except OSError:
        _remove(partial)
        raise


def save_checkpoint(path: str | Path, state: dict[str, Any]) -> None:
    """Write ``state`` to ``path`` atomically, and keep what was there as `PREVIOUS` beside it.

    Raises:
        OSError: it cannot be written, as on a full disk; both files are as they were.
    """
    path = Path(path)
    buffer = io.BytesIO()
    torch.save(state, buffer)
    second = path.with_name(SECOND)
    second.unlink(missing_ok=True)
    try:
        if path.exists():
            _duplicate(path, second)
        write_whole(path, buffer.getbuffer())
    except OSError:
        _remove(second)
        raise
    # Only now: until there is a newer one, the one before may be the only one that can be read.
    if second.exists():
        second.replace(path.with_name(PREVIOUS))


def drop_previous(path: str | Path) -> None:
    """Leave of the checkpoints beside ``path`` only that one, as nobody goes back from the end."""
    for name in (PREVIOUS, SECOND):
        _remove(Path(path).with_name(name))


def _duplicate(path: Path, second: Path) -> None:
    try:
        os.link(path, second)
    except OSError:  # a file system without links
        shutil.copyfile(path, second)


def _remove(path: Path) -> None:
    with contextlib.suppress(OSError):
        path.unlink()


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
    except Exception as error:  # a damaged file can make its readers raise anything
        remedy = "It may be damaged, or hold something other than tensors and numbers"
        previous = path.with_name(PREVIOUS)
        found = path.name != PREVIOUS and previous.exists()
        raise QPError.expected(
            "checkpoint",
            f"{path}, which cannot be read ({type(error).__name__})",
            "a checkpoint that train.py wrote",
            f"{remedy}; use {f'the one before, {previous}' if found else 'another one'}.",
        ) from error
