"""Checkpoints: written atomically, with the previous one kept, and read without running code."""

from __future__ import annotations

import contextlib
import io
import os
import shutil
from pathlib import Path
from typing import Any

import torch

from torch_qpmpc.errors import QPError
from torch_qpmpc.experiment.config import load_config
from torch_qpmpc.files import read_tensors, write_whole
from torch_qpmpc.mpc.module import QPMPC

#: The newest checkpoint of a run's folder, and the one before.
CHECKPOINT, PREVIOUS = "checkpoint.pt", "checkpoint-previous.pt"
#: The policy that the gate keeps, written by `QPMPC.save`.
BEST = "best.pt"
#: Temporary second link to the newest checkpoint, later renamed to `PREVIOUS`.
SECOND = "checkpoint.second"


def save_checkpoint(path: str | Path, state: dict[str, Any]) -> None:
    """Write ``state`` to ``path`` atomically, and keep the old checkpoint as `PREVIOUS`.

    Raises:
        OSError: writing failed, as on a full disk; both files are unchanged.
    """
    path = Path(path)
    buffer = io.BytesIO()
    torch.save(state, buffer)
    second = path.with_name(SECOND)
    second.unlink(missing_ok=True)
    try:
        if path.exists():
            try:
                os.link(path, second)
            except OSError:  # the file system has no hard links
                shutil.copyfile(path, second)
        write_whole(path, buffer.getbuffer())
    except OSError:
        _remove(second)
        raise
    # Only after the write: PREVIOUS may be the only readable checkpoint until then.
    if second.exists():
        second.replace(path.with_name(PREVIOUS))


def drop_previous(path: str | Path) -> None:
    """Remove the other checkpoints beside ``path``, which a finished run no longer needs."""
    for name in (PREVIOUS, SECOND):
        _remove(Path(path).with_name(name))


def _remove(path: Path) -> None:
    with contextlib.suppress(OSError):
        path.unlink()


def load_checkpoint(path: str | Path) -> dict[str, Any]:
    """Read a checkpoint with ``weights_only=True``.

    Raises:
        QPError: the file is missing or damaged, or holds more than tensors and numbers.
    """
    path = Path(path)
    try:
        return read_tensors(path)
    except FileNotFoundError as error:
        raise QPError.expected("checkpoint", f"{path}, which does not exist", "a file") from error
    except Exception as error:  # damaged files raise errors of any type
        reason = "It may be damaged, or hold more than tensors and numbers"
        previous = path.with_name(PREVIOUS)
        usable = path.name != PREVIOUS and previous.exists()
        raise QPError.expected(
            "checkpoint",
            f"{path}, which cannot be read ({type(error).__name__})",
            "a checkpoint that train.py wrote",
            f"{reason}; use {f'the previous one, {previous}' if usable else 'another one'}.",
        ) from error


def learned_qp(folder: str | Path) -> QPMPC:
    """Load the QP that the run in ``folder`` has learned and, with a gate, kept.

    Raises:
        QPError: its configuration or its file is missing or damaged.
    """
    cfg = load_config(Path(folder) / "config.yaml")
    return QPMPC.load(Path(folder) / (BEST if cfg.gate else CHECKPOINT))
