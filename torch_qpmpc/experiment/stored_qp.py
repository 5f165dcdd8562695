"""The QP of a run's folder, which is made without the run's task."""

from __future__ import annotations

from pathlib import Path

from torch_qpmpc.errors import QPError
from torch_qpmpc.experiment.checkpoint import CHECKPOINT, load_checkpoint
from torch_qpmpc.experiment.config import load_config
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


def check_alone(folder: str | Path) -> None:
    """Check that the policy of the run in ``folder`` is its QP, without a network for theta.

    Raises:
        QPError: it is not.
    """
    config = Path(folder) / "config.yaml"
    if config.exists() and load_config(config).algo.get("actor") == "scheduled":
        got = f"{folder}, a run of algo.actor=scheduled, whose theta comes from a network"
        remedy = "Its QP alone is another policy. train.py resume=FOLDER goes on with both."
        raise QPError.expected("policy", got, "a run whose policy is a QP", remedy)
