"""Finished runs: their results as one table, and the QP that each has learned.

A run's folder is data. No code that its configuration names is run.
All readings of a learned C are independent of its gauge.
"""

from __future__ import annotations

import contextlib
import math
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from omegaconf import DictConfig

from torch_qpmpc.analysis.model_error import one_step_error, second_moment
from torch_qpmpc.analysis.report import predictions
from torch_qpmpc.analysis.structure import NearestModel, nearest_model
from torch_qpmpc.envs import GymnasiumPlant, LinearSystem
from torch_qpmpc.errors import QPError
from torch_qpmpc.experiment.config import check_config, load_config, settings
from torch_qpmpc.experiment.run_folder import read_metrics, read_summary
from torch_qpmpc.experiment.stored_qp import check_alone, learned_qp
from torch_qpmpc.experiment.tasks import AnyPlant, find_task, has_run, make_physics, make_true_mpc
from torch_qpmpc.mpc.banded import band_distance
from torch_qpmpc.mpc.module import QPMPC

#: The paper's cases, in its order.
CASES = ("fixed", "free", "deviation", "si", "combined")
#: Smallest J_start - J_true_model for which the closed gap is meaningful, as a share of J_start.
REAL_GAP = 0.5
#: Settings that labels leave out: they vary within a case, or do not affect learning.
_UNLABELLED = ("seed", "figures", "threads", "log_interval", "eval_interval", "logger", "rivals")


class FinishedRun:
    """A finished run, read from its folder; `torch_qpmpc.load_run` makes one.

    Args:
        folder: the run's folder, with config.yaml and checkpoint.pt.
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)

    @cached_property
    def cfg(self) -> DictConfig:
        """The run's configuration.

        Raises:
            QPError: it does not match this version's configs/.
        """
        cfg = load_config(self.folder / "config.yaml")
        try:
            check_config(cfg)
        except QPError as error:
            raise QPError.expected(
                str(self.folder),
                f"a run with other keys ({error})",
                "a run of this version",
                "Repeat it, or move it elsewhere.",
            ) from None
        return cfg

    @property
    def has_plant(self) -> bool:
        """False if the plant takes code that the configuration names, or a log that is not here."""
        task = self.cfg.task
        return has_run(task) and (find_task(task).log is None or Path(task.file).exists())

    @cached_property
    def physics(self) -> AnyPlant:
        """The plant, if `has_plant`."""
        plant = make_physics(self.cfg)
        if not isinstance(plant, GymnasiumPlant):
            return plant
        return plant.windowed(self.summary.get("past", plant.past))

    @cached_property
    def start(self) -> QPMPC:
        """The QP that learning started from."""
        return QPMPC(**{**self.qp.arguments, "structure": self.cfg.constraint.structure})

    @cached_property
    def true(self) -> QPMPC | None:
        """The QP with the true model; None if that is unknown."""
        return make_true_mpc(self.cfg, self.physics) if self.has_plant else None

    @cached_property
    def policy(self) -> QPMPC:
        """The learned policy, which the run has kept.

        Raises:
            QPError: the policy is a network or takes its theta from one, or the file is missing or
                damaged.
        """
        check_alone(self.folder)
        return self.qp

    @cached_property
    def qp(self) -> QPMPC:
        """The learned QP, for readings: `policy`, but without the network of theta, if any.

        Raises:
            QPError: the policy is a network without a QP, or the file is missing or damaged.
        """
        return learned_qp(self.folder)

    @property
    def summary(self) -> dict[str, Any]:
        """The content of summary.json, as ``J_start`` and ``J_best``."""
        return read_summary(self.folder)

    @property
    def metrics(self) -> pd.DataFrame:
        """The content of metrics.csv by update."""
        return read_metrics(self.folder)

    def readings(self) -> dict[str, float]:
        """Read zeros and model errors from the learned constraints.

        Their model is the time-invariant one with the nearest predictions. Its error is the root
        mean square difference of ``A x + B u`` from the true model's, over start states x and
        actions u drawn uniformly from their bounds.

        Returns:
            ``zeros_above``, the share of C's entries above the band that are exactly zero, and
            ``prediction_error`` and ``prediction_error_start`` of the learned and the initial
            model, nan if the constraints do not determine the states or the true model is unknown.
        """
        mpc = self.qp
        above = band_distance(mpc.layout) > 0
        readings = {
            "zeros_above": (mpc.C[above] == 0).double().mean().item(),
            "prediction_error": math.nan,
            "prediction_error_start": math.nan,
        }
        if self.has_plant and isinstance(physics := self.physics, LinearSystem):
            with contextlib.suppress(QPError):
                learned, start = (nearest_model(predictions(m)) for m in (mpc, self.start))
                readings["prediction_error"] = prediction_error(learned, physics)
                readings["prediction_error_start"] = prediction_error(start, physics)
        return readings


def has_real(frame: pd.DataFrame) -> bool:
    """Return True if any of `collect`'s runs has a real gap."""
    return any(frame["real"])


def chosen(frame: pd.DataFrame, **values: Any) -> pd.DataFrame:
    """Return the rows with these ``values`` by column, which pandas does not evaluate as code."""
    return frame.query(" and ".join(f"{name} == @{name}" for name in values), local_dict=values)


def prediction_error(model: NearestModel, physics: LinearSystem) -> float:
    """Compute `one_step_error` over start states and uniform actions, in units of the state."""
    rng = np.random.default_rng(123)
    s = physics.starts(rng, 1024)
    share = torch.as_tensor(rng.random((1024, physics.B.shape[1])))
    a = physics.lb_a + (physics.ub_a - physics.lb_a) * share
    return one_step_error(model, *physics.true_model(), moment=second_moment(s, a)).item()


def load_run(folder: str | Path) -> FinishedRun:
    """Return the run of train.py in ``folder``: its policy, summary, metrics and configuration.

    No code that the folder names is run.

    Raises:
        QPError: the folder has no run.
    """
    if not (Path(folder) / "config.yaml").exists():
        got = f"{folder}, without config.yaml"
        raise QPError.expected("folder", got, "the folder of a run of train.py")
    return FinishedRun(folder)


def collect(folder: str | Path) -> pd.DataFrame:
    """Collect every finished run below ``folder``.

    Returns:
        A row for each run: the entries of summary.json, `FinishedRun.readings`, ``run``, a
        `FinishedRun`, ``actor``, its kind of policy, ``sweep``, the folder that contains the run,
        ``label``, its case with its ablation or the settings that vary in the sweep, and ``real``,
        True if the gap is real.

    Raises:
        QPError: there is no finished run.
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
        summary = read_summary(file.parent)
        where = "." if file.parent == folder else str(file.parent.parent.relative_to(folder))
        sweep = folder.resolve().name if where == "." else where
        names = {name: run.cfg[name].name for name in ("constraint", "noise")}
        names |= {"seed": run.cfg.seed, "ablation": run.cfg.ablation}
        rows.append({**summary, **names, "run": run, "sweep": sweep, **run.readings()})
    frame = pd.DataFrame(rows)
    for name in ("closed_gap", "J_true_model", "J_discounted_true_model", "canonical_distance"):
        # These are null without a gap, a true model or a QP.
        frame[name] = frame[name].astype(float) if name in frame else math.nan
    gap = frame["J_start"] - frame["J_true_model"]
    frame["real"] = gap >= REAL_GAP * frame["J_start"].abs()
    frame["actor"] = [run.cfg.algo.get("actor", "qp") for run in frame["run"]]
    frame["label"] = ""
    for _, sweep in frame.groupby("sweep"):
        frame.loc[sweep.index, "label"] = _labels(sweep)
    order = [*CASES, *sorted({*frame["constraint"]} - {*CASES})]
    rank = frame["constraint"].map(order.index)
    keys = ["sweep", "noise", "rank", "label", "seed"]
    return frame.assign(rank=rank).sort_values(keys, ignore_index=True).drop(columns="rank")


def _labels(sweep: pd.DataFrame) -> list[str]:
    labelled = [_labelled_settings(run.cfg) for run in sweep["run"]]
    values: dict[tuple[str, str], set[str]] = {}
    for case, of_run in zip(sweep["constraint"], labelled, strict=True):
        for key, value in of_run.items():
            values.setdefault((case, key), set()).add(str(value))
    labels = []
    for case, of_run in zip(sweep["constraint"], labelled, strict=True):
        varied = [key for key in of_run if len(values[case, key]) > 1]
        details = [f"{key.split('.')[-1]}={of_run[key]}" for key in varied]
        if of_run["ablation"] is not None:
            details = [of_run["ablation"]]
        # Without $, which would begin mathematics in a figure.
        labels.append(", ".join(map(str, [case, *details])).replace("$", ""))
    return labels


def _labelled_settings(cfg: DictConfig) -> dict[str, Any]:
    return {
        key: value
        for key, value in settings(cfg).items()
        if key not in _UNLABELLED and not key.startswith("noise.")
    }
