"""A run's folder: config.yaml, metrics.csv, what its logger writes, checkpoint.pt, summary.json."""

from __future__ import annotations

import io
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd
from hydra.experimental.callback import Callback
from matplotlib.figure import Figure
from omegaconf import DictConfig, OmegaConf

from torch_qpmpc.errors import QPError
from torch_qpmpc.experiment.checkpoint import CHECKPOINT, write_whole
from torch_qpmpc.experiment.config import settings
from torch_qpmpc.experiment.loggers import RunLogger


class RunFolder:
    """Where one run writes; a context manager, so that no event is lost.

    Args:
        folder: created if it does not exist.
        cfg: the run's configuration.
        after: go on after this update: what the folder has of it and before is kept, what is later
            is written anew. None starts from nothing.

    Raises:
        QPError: the rows of the updates up to ``after`` are missing or damaged.
        OSError: here and in what follows, something cannot be written; all other files are whole.
    """

    def __init__(self, folder: str | Path, cfg: DictConfig, after: int | None = None) -> None:
        # Absolute, as the event writer's thread outlives changes of the working directory.
        self.path = Path(folder).resolve()
        self.path.mkdir(parents=True, exist_ok=True)
        # Before the first event, as a run whose rows are damaged does not go on.
        earlier: Any = None if after is None else _read_until(self.path, cfg, after)
        self.cfg = cfg
        self.rows: list[dict[str, float]] = []
        if after is not None:
            for update, row in earlier.iterrows():
                self.rows.append({"update": update, **row.dropna()})
        self.logger = RunLogger(cfg.logger, self.path, settings(cfg), self.rows, after)
        if after is None:
            text = OmegaConf.to_yaml(cfg, resolve=True)
            write_whole(self.path / "config.yaml", text.encode())
            self.logger.text("config", f"```yaml\n{text}```")

    def __enter__(self) -> RunFolder:
        return self

    def __exit__(self, *_: object) -> None:
        try:
            self.flush()
        finally:
            self.logger.close()

    def log(self, metrics: Mapping[str, float], update: int) -> None:
        """Scalars at an update: a row of metrics.csv, and the logger."""
        if not self.rows or self.rows[-1]["update"] != update:
            self.rows.append({"update": update})
        self.rows[-1].update(metrics)
        self.logger.log(metrics, update)

    def figure(self, name: str, figure: Figure, update: int) -> None:
        """A figure for the logger."""
        self.logger.figure(name, figure, update)

    def column(self, name: str) -> tuple[list[float], list[float]]:
        """The updates at which ``name`` was logged, and its values."""
        rows = [row for row in self.rows if name in row]
        return [row["update"] for row in rows], [row[name] for row in rows]

    def flush(self) -> None:
        """Write metrics.csv, and what the logger still holds."""
        table = pd.DataFrame(self.rows).to_csv(index=False)
        write_whole(self.path / "metrics.csv", table.encode())
        self.logger.flush()

    def finish(self, summary: Mapping[str, float | int | str]) -> None:
        """Write the outcome to the logger, and summary.json.

        JSON knows neither nan (no gap to close) nor inf: there they are null.
        """
        self.logger.finish(summary)
        self.logger.flush()
        finite = {
            key: None if isinstance(value, float) and not math.isfinite(value) else value
            for key, value in summary.items()
        }
        text = json.dumps(finite, indent=2, allow_nan=False)
        # Last, and all at once: its presence marks the run as finished.
        write_whole(self.path / "summary.json", f"{text}\n".encode())


def read_metrics(folder: str | Path) -> pd.DataFrame:
    """Read a run's metrics.csv by update, to the last digit.

    Raises:
        QPError: it is missing, or is not the table that a run writes.
    """
    file = Path(folder) / "metrics.csv"
    try:
        text = file.read_text(encoding="utf-8")
        if not text.endswith("\n"):
            raise ValueError("its last line is cut off")
        # First as text: before 3.1, pandas rounds what it reads as numbers.
        table = pd.read_csv(io.StringIO(text), dtype=str).astype(float)
        return table.astype({"update": int}).set_index("update")
    except (OSError, ValueError, KeyError) as error:
        raise _damaged(file, str(error).strip().partition("\n")[0]) from error


def _read_until(folder: Path, cfg: DictConfig, update: int) -> pd.DataFrame:
    """Read the rows up to ``update``, and check that there are all that ``cfg`` makes a run log."""
    table = read_metrics(folder)
    due = {0, *range(cfg.log_interval, update + 1, cfg.log_interval)}
    due |= {*range(cfg.eval_interval, update + 1, cfg.eval_interval)}
    if missing := sorted(due - {*table.index}):
        lost = ", ".join(map(str, missing[:5])) + (", .." if len(missing) > 5 else "")
        raise _damaged(folder / "metrics.csv", f"no row of update {lost}")
    if not table.index.is_monotonic_increasing or table.index.has_duplicates:
        raise _damaged(folder / "metrics.csv", "updates that do not increase")
    return table.loc[:update]


def _damaged(file: Path, wrong: str) -> QPError:
    remedy = (
        "Put a whole copy of it there, go on from a copy of the folder, or start anew in another "
        "one by hydra.run.dir=FOLDER."
    )
    return QPError.expected(
        "metrics.csv", f"{file} ({wrong})", "the table that a run wrote", remedy
    )


class WritableFolder(Callback):
    """Makes the folder of a run or of a sweep, or says why not before Hydra's own traceback."""

    def on_run_start(self, config: DictConfig, **_: Any) -> None:
        self._make("hydra.run.dir", config)

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        self._make("hydra.sweep.dir", config)

    @staticmethod
    def _make(key: str, config: DictConfig) -> None:
        folder = OmegaConf.select(config, key)
        try:
            Path(folder).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            # Of a callback's errors, Hydra makes warnings; not of its exit.
            raise SystemExit(str(unwritable(folder, error, key))) from None


def unwritable(folder: str | Path, error: OSError, key: str = "hydra.run.dir") -> QPError:
    """The message for a run in ``folder``, chosen by ``key``, that ended with ``error``."""
    checkpoint = Path(folder) / CHECKPOINT
    remedy = f"Choose another folder by {key}=FOLDER."
    if checkpoint.exists():
        remedy = f"{checkpoint} is whole: make room, then python train.py resume={folder}."
    got = f"{folder}, where writing failed ({error})"
    return QPError.expected("folder", got, "one that can be written to", remedy)
