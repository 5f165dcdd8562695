"""The QP in a checkpoint: its arguments and its state, from which it is made without a task."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch_qpmpc.experiment.checkpoint import CHECKPOINT, load_checkpoint
from torch_qpmpc.experiment.config import damaged
from torch_qpmpc.mpc.module import QPMPC

#: The file of the policy that is kept, in a run's folder.
BEST = "best.pt"
EXPECTED = "the policy of this run as a QP, not as a network"


def stored(mpc: QPMPC) -> dict[str, Any]:
    """Return the entries of a checkpoint from which `learned_qp` and `start_qp` are made."""
    return {
        "structure": mpc.structure,
        "arguments": mpc.arguments,
        "mpc": mpc.state_dict(),
    }


def learned_qp(folder: str | Path) -> QPMPC:
    """Make the QP that the run in ``folder`` has learned and kept.

    Raises:
        QPError: there is no checkpoint, it is damaged, or the policy is a network.
    """
    file, state = _read(folder)
    mpc = _make(file, state, {})
    try:
        mpc.load_state_dict(state["mpc"])
    except Exception as error:  # damaged files raise errors of any type
        raise damaged(file, error, EXPECTED) from error
    return mpc


def start_qp(folder: str | Path, structure: str) -> QPMPC:
    """Make the QP that the run in ``folder`` started from, with its ``structure`` at the start."""
    return _make(*_read(folder), {"structure": structure})


def _read(folder: str | Path) -> tuple[Path, dict[str, Any]]:
    """Read the file of the policy that is kept: without a gate, the checkpoint."""
    best, checkpoint = Path(folder) / BEST, Path(folder) / CHECKPOINT
    if not best.exists():
        state = load_checkpoint(checkpoint)
        if not isinstance(state, dict) or state.get("gate") is None:
            return checkpoint, state
    return best, load_checkpoint(best)


def _make(file: Path, state: Mapping[str, Any], changed: Mapping[str, Any]) -> QPMPC:
    try:
        return QPMPC(**{**state["arguments"], **changed})
    except Exception as error:  # damaged files raise errors of any type
        raise damaged(file, error, EXPECTED) from error
