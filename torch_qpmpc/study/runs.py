"""Finished runs: what they wrote, as one table, and the QP that each has learned.

What is read from a learned C here does not depend on its gauge.
"""

from __future__ import annotations

import contextlib
import json
import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, cast

import numpy as np
import pandas as pd
import torch
from omegaconf import DictConfig

from torch_qpmpc.analysis.model_error import one_step_error, second_moment
from torch_qpmpc.analysis.report import predictions
from torch_qpmpc.analysis.structure import Model, nearest_model
from torch_qpmpc.envs import GymnasiumPlant, LinearSystem
from torch_qpmpc.errors import QPError
from torch_qpmpc.experiment.checkpoint import CHECKPOINT, load_checkpoint
from torch_qpmpc.experiment.config import check_config, load_config, settings
from torch_qpmpc.experiment.run_folder import read_metrics
from torch_qpmpc.experiment.tasks import make_mpc, make_physics, make_true_mpc, true_model
from torch_qpmpc.mpc.banded import band_distance
from torch_qpmpc.mpc.module import QPMPC

#: The paper's, in its order.
CASES = ("fixed", "free", "deviation", "si", "combined")
#: The least J_start - J_true_model of a run whose closed gap says something.
REAL_GAP = 50.0
#: What differs between runs of one kind, or does not bear on what is learned.
_NO_SETTING = ("seed", "figures", "threads", "log_interval", "eval_interval", "logger")


@dataclass(frozen=True, eq=False)
class FinishedRun:
    """A run's folder, read again.

    Attributes:
        folder: with config.yaml and checkpoint.pt.
    """

    folder: Path

    @cached_property
    def cfg(self) -> DictConfig:
        """Its settings.

        Raises:
            QPError: they are not those of today's configs/.
        """
        cfg = load_config(self.folder / "config.yaml")
        try:
            check_config(cfg)
        except QPError as error:
            raise QPError.expected(
                str(self.folder),
                f"a run with other keys ({error})",
                "one of this version",
                "Repeat it, or move it away.",
            ) from None
        return cfg

    @cached_property
    def physics(self) -> LinearSystem | GymnasiumPlant:
        return make_physics(self.cfg)

    @cached_property
    def start(self) -> QPMPC:
        """The QP that learning started from."""
        return make_mpc(self.cfg, self.physics)

    @cached_property
    def true(self) -> QPMPC | None:
        """The QP with the true model, if there is one."""
        return make_true_mpc(self.cfg, self.physics)

    @cached_property
    def learned(self) -> QPMPC:
        """The QP that was learned."""
        state = load_checkpoint(self.folder / CHECKPOINT)
        mpc = make_mpc(self.cfg, self.physics)
        if state["structure"] != mpc.structure:
            mpc.release(state["structure"])
        mpc.load_state_dict(state["mpc"])
        return mpc

    @property
    def metrics(self) -> pd.DataFrame:
        """metrics.csv by update."""
        return read_metrics(self.folder)

    def readings(self) -> dict[str, float]:
        """What the learned constraints say.

        The model read from them is the time-invariant one whose predictions are nearest. Its error
        is the root mean square of ``A x + B u`` minus the true one's, over start states x and
        actions u drawn uniformly from their bounds.

        Returns:
            ``zeros_above``, the share of C's entries above the band that are exactly zero;
            ``prediction_error`` and, of the model at the start, ``prediction_error_start``: nan
            where the constraints do not determine the states, or the plant has no such model.
        """
        mpc = self.learned
        above = band_distance(mpc.n_x, mpc.n_u, mpc.horizon) > 0
        readings = {
            "zeros_above": (mpc.C[above] == 0).double().mean().item(),
            "prediction_error": math.nan,
            "prediction_error_start": math.nan,
        }
        if true_model(self.physics) is not None:
            physics = cast(LinearSystem, self.physics)  # no other plant has a true model
            with contextlib.suppress(QPError):
                learned, start = (nearest_model(predictions(m)) for m in (mpc, self.start))
                readings["prediction_error"] = prediction_error(learned, physics)
                readings["prediction_error_start"] = prediction_error(start, physics)
        return readings


def has_real(frame: pd.DataFrame) -> bool:
    """Whether any of `collect`'s runs had a gap worth closing."""
    return any(frame["real"])


def prediction_error(model: Model, physics: LinearSystem) -> float:
    """`one_step_error` over start states and uniform actions, in units of the state."""
    rng = np.random.default_rng(123)
    s = physics.starts(rng, 1024)
    share = torch.as_tensor(rng.random((1024, physics.B.shape[1])))
    a = physics.lb_a + (physics.ub_a - physics.lb_a) * share
    return one_step_error(model, *physics.true_model(), moment=second_moment(s, a)).item()


def collect(folder: str | Path) -> pd.DataFrame:
    """Every finished run below ``folder``: summary.json, what is read from the learned QP, and

    ``run``, a `FinishedRun`; ``sweep``, the folder that it is in; ``label``, its case, and its
    ablation or in what settings it differs from others of the same case in that sweep; ``real``,
    whether there was a gap worth closing.

    Raises:
        QPError: there is none.
    """
    folder = Path(folder)
    files = sorted(folder.rglob("summary.json"))
    if not files:
        raise QPError.expected(
            "RUNS_FOLDER", f"{folder}, without a finished run", "a folder that train.py wrote to"
        )
    rows = []
    for file in files:
        run = FinishedRun(file.parent)
        summary = json.loads(file.read_text(encoding="utf-8"))
        where = "." if file.parent == folder else str(file.parent.parent.relative_to(folder))
        sweep = folder.resolve().name if where == "." else where
        rows.append({**summary, "run": run, "sweep": sweep, **run.readings()})
    frame = pd.DataFrame(rows)
    for name in ("closed_gap", "J_true_model", "J_discounted_true_model", "canonical_distance"):
        # JSON's null where there is no gap, no true model or no QP.
        frame[name] = frame[name].astype(float) if name in frame else math.nan
    frame["real"] = frame["J_start"] - frame["J_true_model"] >= REAL_GAP
    frame["label"] = ""
    for _, sweep in frame.groupby("sweep"):
        frame.loc[sweep.index, "label"] = _labels(sweep)
    order = [*CASES, *sorted({*frame["constraint"]} - {*CASES})]
    rank = frame["constraint"].map(order.index)
    keys = ["sweep", "noise", "rank", "label", "seed"]
    return frame.assign(rank=rank).sort_values(keys, ignore_index=True).drop(columns="rank")


def _labels(sweep: pd.DataFrame) -> list[str]:
    kinds = [_kind(run.cfg) for run in sweep["run"]]
    values: dict[tuple[str, str], set[str]] = {}
    for case, of_run in zip(sweep["constraint"], kinds, strict=True):
        for key, value in of_run.items():
            values.setdefault((case, key), set()).add(str(value))
    labels = []
    for case, of_run in zip(sweep["constraint"], kinds, strict=True):
        varied = [key for key in of_run if len(values[case, key]) > 1]
        told = [f"{key.split('.')[-1]}={of_run[key]}" for key in varied]
        if of_run["ablation"] is not None:
            told = [of_run["ablation"]]
        labels.append(", ".join([case, *told]))
    return labels


def _kind(cfg: DictConfig) -> dict[str, Any]:
    return {
        key: value
        for key, value in settings(cfg).items()
        if key not in _NO_SETTING and not key.startswith("noise.")
    }
