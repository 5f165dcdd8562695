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
    """Make the learned QP of the run in ``folder``, which acts.

    Raises:
        QPError: there is no checkpoint, it is damaged, or the policy is a network.
    """
    file = _file(folder)
    state = load_checkpoint(file)
    mpc = _make(file, state, {})
    try:
        mpc.load_state_dict(state["mpc"])
    except Exception as error:  # damaged files raise errors of any type
        raise damaged(file, error, EXPECTED) from error
    return mpc


def start_qp(folder: str | Path, structure: str) -> QPMPC:
    """Make the QP that the run in ``folder`` started from, with its ``structure`` at the start."""
    file = _file(folder)
    return _make(file, load_checkpoint(file), {"structure": structure})


def _file(folder: str | Path) -> Path:
    """Return the file of the policy that is kept: without a gate, the checkpoint."""
    best = Path(folder) / BEST
    return best if best.exists() else Path(folder) / CHECKPOINT


def _make(file: Path, state: Mapping[str, Any], changed: Mapping[str, Any]) -> QPMPC:
    try:
        return QPMPC(**{**state["arguments"], **changed})
    except Exception as error:  # damaged files raise errors of any type
        raise damaged(file, error, EXPECTED) from error
