"""Finished runs: their results as one table, and the QP that each has learned.

A run's folder is data: no code that its configuration names is run. All readings of a learned C are
independent of its gauge.
"""

import contextlib
import math
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch

from torch_qpmpc.analysis.policy import local_gain, spectral_radius
from torch_qpmpc.analysis.structure import (
    NearestModel,
    nearest_model,
    one_step_error,
    predictions,
    second_moment,
)
from torch_qpmpc.checks import check_tensor
from torch_qpmpc.envs import KalmanFilter, LinearSystem
from torch_qpmpc.errors import QPError
from torch_qpmpc.experiment.config import Config
from torch_qpmpc.experiment.run_folder import (
    BEST,
    NUMBERS,
    read_config,
    read_metrics,
    read_summary,
)
from torch_qpmpc.experiment.start import read_observer
from torch_qpmpc.experiment.tasks import AnyPlant, make_physics, make_true_mpc
from torch_qpmpc.experiment.tasks.code import has_run
from torch_qpmpc.identification.innovations import Innovations
from torch_qpmpc.learning.operators import warm_policy
from torch_qpmpc.mpc.layout import band_distance
from torch_qpmpc.mpc.module import QPMPC
from torch_qpmpc.mpc.validation import read_numbers

#: The paper's cases, in its order.
CASES = ("fixed", "free", "deviation", "si", "combined")
NEW = "Pass begins=True to begin other episodes."
#: Smallest J_start - J_true_model for which the closed gap is meaningful, as a share of J_start.
REAL_GAP = 0.5
#: Settings that labels leave out: they vary within a case, or do not affect learning.
_UNLABELLED = ("seed", "figures", "threads", "log_interval", "eval_interval", "rivals")


class FinishedRun:
    """A finished run, read from its folder; `torch_qpmpc.load_run` makes one."""

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        self._last: tuple[Any, ...] = ()

    def __repr__(self) -> str:
        """Say which run it is, and its mean costs before and after learning."""
        text = f"<run {self.folder}"
        with contextlib.suppress(QPError, TypeError):  # unfinished, or a cost is null
            cfg, J = self.cfg, self.summary
            text += f": task={cfg.task.name} constraint={cfg.constraint.name} seed={cfg.seed}"
            text += f", J {J['J_start']:.4g} to {J['J_best']:.4g}"
        return f"{text}>"

    @torch.no_grad()
    def predict(self, observation: Any, begins: bool = False) -> np.ndarray:
        """Return the policy's action ``(*batch, n_u)``, within its bounds, for an observation.

        A run that started from a log acts on its `observer`'s estimate, and remembers the steps.

        Args:
            observation: ``(*batch, n)``, the output, after the known signals if there are some.
            begins: True for the first observation of an episode; the first call begins one, too.

        Raises:
            QPError: the observation has another shape.
        """
        own, model, k = self.policy, self.observer, 0
        low, high = map(np.asarray, own.scheme.bounds.action_bounds or (-np.inf, np.inf))
        if model is None:
            return np.clip(u := own.predict(observation), low, high, dtype=u.dtype)
        n_d, p = own.n_p - own.n_x, read_numbers("observation", observation)
        d, y = check_tensor("observation", p, n_d + len(model.C)).tensor_split([n_d], -1)
        if begins or not self._last:
            x = (kalman := KalmanFilter(model)).first(y)
            act = own.predict if own.sequential is None else warm_policy(own)
        else:
            kalman, act, x, u, known, k = self._last
            check_tensor("observation", p, *x.shape[:-1], p.shape[-1], batched=False, remedy=NEW)
            x = kalman.following(x, u, known, y, k)
        u = np.asarray(act(torch.cat((d, x), -1))).clip(low, high)
        self._last = kalman, act, x, torch.as_tensor(u), d[..., : model.E.shape[-1]], k + 1
        return u

    @cached_property
    def cfg(self) -> Config:
        """The run's configuration."""
        return read_config(self.folder)

    @cached_property
    def physics(self) -> AnyPlant:
        """The plant; `QPError` if it takes code that has not run."""
        return make_physics(self.cfg).observed(self.observer)

    @cached_property
    def observer(self) -> Innovations | None:
        """The model whose estimated state the policy acts on; None if it acts on the outputs."""
        return read_observer(self.folder)

    @cached_property
    def start(self) -> QPMPC:
        """The QP that learning started from."""
        return QPMPC.of(**self.policy.arguments)

    @cached_property
    def true(self) -> QPMPC | None:
        """The QP with the true model; None if that is unknown."""
        return make_true_mpc(self.cfg, self.physics) if has_run(self.cfg.task) else None

    @cached_property
    def policy(self) -> QPMPC:
        """The learned policy, which the run has kept."""
        return QPMPC.load(self.folder / BEST)

    @property
    def summary(self) -> dict[str, Any]:
        """The content of summary.json, as ``J_start`` and ``J_best``."""
        return read_summary(self.folder)

    @property
    def metrics(self) -> pd.DataFrame:
        """The content of metrics.csv by update."""
        return read_metrics(self.folder)

    def readings(self) -> dict[str, float]:
        """Return the zeros above C's band, a spectral radius, errors of learned and first model.

        ``zeros_above`` is a share, ``radius`` that of the policy's loop at the origin with the true
        plant, nan if that does not rest there. The errors are nan if the constraints do not
        determine the states. Without a true model all but the zeros are nan.
        """
        above = band_distance(self.policy.layout) > 0
        zeros = (self.policy.C[above] == 0).double().mean().item()
        errors, radius = (math.nan, math.nan), math.nan
        if has_run(self.cfg.task) and isinstance(physics := self.physics, LinearSystem):
            A, B, offset = physics.true_model()
            if not offset.any():
                radius = spectral_radius(A, B, local_gain(self.policy, 0 * offset)).item()
            with contextlib.suppress(QPError):
                forms = predictions(self.policy), predictions(self.start)
                errors = tuple(prediction_error(nearest_model(form), physics) for form in forms)
        names = ("zeros_above", "radius", "prediction_error", "prediction_error_start")
        return dict(zip(names, (zeros, radius, *errors), strict=True))


def prediction_error(model: NearestModel, physics: LinearSystem) -> float:
    """Compute the root mean square of `one_step_error` over start states and uniform actions."""
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
    """Collect every finished run below ``folder``, a row for each, or raise `QPError`.

    A row has the entries of summary.json, `FinishedRun.readings`, ``run``, a `FinishedRun`,
    ``sweep``, the folder that contains the run, ``label``, its case with its ablation or the
    settings that vary in the sweep, and ``real``, True if the gap is real.
    """
    folder, rows = Path(folder), []
    for file in sorted(folder.rglob("summary.json")):
        run = FinishedRun(file.parent)
        where = "." if file.parent == folder else str(file.parent.parent.relative_to(folder))
        sweep = folder.resolve().name if where == "." else where
        rows.append({**run.summary, "run": run, "sweep": sweep, **run.readings()})
    if not rows:
        got = f"{folder}, without a finished run"
        raise QPError.expected("RUNS_FOLDER", got, "a folder that train.py wrote to")
    frame = pd.DataFrame(rows).astype(dict.fromkeys(NUMBERS, float))  # null: no gap, or true model
    frame["real"] = frame["J_start"] - frame["J_true_model"] >= REAL_GAP * frame["J_start"].abs()
    frame["label"] = ""
    for _, sweep in frame.groupby("sweep"):
        frame.loc[sweep.index, "label"] = _labels(sweep)
    order = [*CASES, *sorted({*frame["constraint"]} - {*CASES})]
    rank = frame["constraint"].map(order.index)
    keys = ["sweep", "noise", "rank", "label", "seed"]
    return frame.assign(rank=rank).sort_values(keys, ignore_index=True).drop(columns="rank")


def _labels(sweep: pd.DataFrame) -> list[str]:
    """Name each run by its case, and by its ablation or the settings that vary within its case."""
    settings = [run.cfg.settings.items() for run in sweep["run"]]
    flat = [{k: f"{x:g}" if type(x) is float else str(x) for k, x in own} for own in settings]
    keys = pd.DataFrame(flat, index=sweep.index)
    keys = keys[[x for x in keys if x not in _UNLABELLED and not x.startswith("noise.")]]
    varied = keys.groupby(sweep["constraint"]).nunique() > 1
    labels = []
    for row, (case, ablation) in sweep[["constraint", "ablation"]].iterrows():
        own = keys.loc[row][varied.loc[case]].dropna().items()
        details = [f"{str(key).split('.')[-1]}={x}" for key, x in own]
        parts = [case, *(details if pd.isna(ablation) else [ablation])]
        labels.append(", ".join(parts).replace("$", ""))  # a $ begins mathematics in a figure
    return labels
