"""A run's folder: config.yaml, metrics.csv, TensorBoard events, checkpoint.pt, summary.json."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd
from matplotlib.figure import Figure
from omegaconf import DictConfig, OmegaConf
from tensorboard.compat.proto import event_pb2
from torchrl.record.loggers.tensorboard import TensorboardLogger

from torch_qpmpc.config import flatten


class RunFolder:
    """Where one run writes; a context manager, so that no event is lost.

    Args:
        folder: created if it does not exist.
        cfg: the run's configuration.
        after: go on after this update: what the folder has of it and before is kept, what is later
            is written anew. None starts from nothing.
    """

    def __init__(self, folder: str | Path, cfg: DictConfig, after: int | None = None) -> None:
        # Absolute, as the event writer's thread outlives changes of the working directory.
        self.path = Path(folder).resolve()
        self.path.mkdir(parents=True, exist_ok=True)
        self.cfg = cfg
        OmegaConf.save(cfg, self.path / "config.yaml", resolve=True)
        self.logger = TensorboardLogger(exp_name="tensorboard", log_dir=str(self.path))
        text = OmegaConf.to_yaml(cfg, resolve=True)
        self.logger.experiment.add_text("config", f"```yaml\n{text}```")
        self.rows: list[dict[str, float]] = []
        if after is not None:
            table = pd.read_csv(self.path / "metrics.csv", float_precision="round_trip")
            found = [row.dropna().to_dict() for _, row in table.iterrows()]
            self.rows = [row for row in found if row["update"] <= after]
            # TensorBoard drops what earlier event files have from here on.
            event: Any = event_pb2  # its classes are made at run time
            start = event.SessionLog(status=event.SessionLog.START)
            writer = self.logger.experiment.file_writer.event_writer
            writer.add_event(event.Event(step=after + 1, session_log=start))

    def __enter__(self) -> RunFolder:
        return self

    def __exit__(self, *_: object) -> None:
        self.flush()
        self.logger.experiment.close()

    def log(self, metrics: Mapping[str, float], update: int) -> None:
        """Scalars at an update: a row of metrics.csv, and TensorBoard."""
        if not self.rows or self.rows[-1]["update"] != update:
            self.rows.append({"update": update})
        self.rows[-1].update(metrics)
        for name, value in metrics.items():
            self.logger.log_scalar(name, value, step=update)

    def figure(self, name: str, figure: Figure, update: int) -> None:
        """A figure for TensorBoard."""
        self.logger.experiment.add_figure(name, figure, update)

    def column(self, name: str) -> tuple[list[float], list[float]]:
        """The updates at which ``name`` was logged, and its values."""
        rows = [row for row in self.rows if name in row]
        return [row["update"] for row in rows], [row[name] for row in rows]

    def flush(self) -> None:
        """Write metrics.csv, and what TensorBoard still holds."""
        partial = self.path / "metrics.csv.partial"
        pd.DataFrame(self.rows).to_csv(partial, index=False)
        partial.replace(self.path / "metrics.csv")
        self.logger.experiment.flush()

    def finish(self, summary: Mapping[str, float | int | str]) -> None:
        """Write summary.json, and the hyper-parameters with the outcome to TensorBoard.

        JSON knows neither nan (no gap to close) nor inf: there they are null.
        """
        finite = {
            key: None if isinstance(value, float) and not math.isfinite(value) else value
            for key, value in summary.items()
        }
        text = json.dumps(finite, indent=2, allow_nan=False)
        # All at once: it is what tells a sweep that the run need not be done again.
        partial = self.path / "summary.json.partial"
        partial.write_text(text + "\n", encoding="utf-8")
        partial.replace(self.path / "summary.json")
        plain = (bool, int, float, str)
        hparams = {
            key: value if isinstance(value, plain) else str(value)
            for key, value in flatten(OmegaConf.to_container(self.cfg, resolve=True)).items()
        }
        outcome = {
            f"hparam/{key}": value for key, value in summary.items() if isinstance(value, float)
        }
        self.logger.experiment.add_hparams(hparams, outcome, run_name=".")
