"""The QP of a run's folder, which is made without the run's task."""

from __future__ import annotations

from pathlib import Path

from torch_qpmpc.experiment.checkpoint import CHECKPOINT, load_checkpoint
from torch_qpmpc.mpc.module import QPMPC

#: The file of the policy that is kept, in a run's folder; `QPMPC.save` wrote it if it is a QP.
BEST = "best.pt"


def learned_qp(folder: str | Path) -> QPMPC:
    """Load the QP that the run in ``folder`` has learned and kept.

    Raises:
        QPError: there is no checkpoint, it is damaged, or the policy is a network.
    """
    best, checkpoint = Path(folder) / BEST, Path(folder) / CHECKPOINT
    if not best.exists():
        state = load_checkpoint(checkpoint)
        if not isinstance(state, dict) or state.get("gate") is None:
            return QPMPC.load(checkpoint)  # which has the entries of such a file, too
    return QPMPC.load(best)
