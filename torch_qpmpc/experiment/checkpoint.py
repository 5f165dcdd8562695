"""Checkpoints: written atomically, and read without running code."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import torch

from torch_qpmpc.errors import QPError
from torch_qpmpc.experiment.config import load_config
from torch_qpmpc.files import read_tensors, write_whole
from torch_qpmpc.mpc.module import QPMPC

#: The newest state of a run in its folder.
CHECKPOINT = "checkpoint.pt"
#: The policy that the gate keeps, written by `QPMPC.save`.
BEST = "best.pt"


def save_checkpoint(path: str | Path, state: dict[str, Any]) -> None:
    """Write ``state`` to ``path`` atomically; an `OSError` leaves the old file as it is."""
    buffer = io.BytesIO()
    torch.save(state, buffer)
    write_whole(Path(path), buffer.getbuffer())


def load_checkpoint(path: str | Path) -> dict[str, Any]:
    """Read a checkpoint with ``weights_only=True``."""
    path = Path(path)
    try:
        return read_tensors(path)
    except FileNotFoundError as error:
        raise QPError.expected("checkpoint", f"{path}, which does not exist", "a file") from error
    except Exception as error:  # damaged files raise errors of any type
        got = f"{path}, which cannot be read ({type(error).__name__})"
        remedy = "It may be damaged, or hold more than tensors and numbers; use another one."
        wanted = "a checkpoint that train.py wrote"
        raise QPError.expected("checkpoint", got, wanted, remedy) from error


def learned_qp(folder: str | Path) -> QPMPC:
    """Load the QP that the run in ``folder`` has learned and, with a gate, kept."""
    cfg = load_config(Path(folder) / "config.yaml")
    return QPMPC.load(Path(folder) / (BEST if cfg.gate else CHECKPOINT))
