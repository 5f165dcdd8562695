"""A run's folder: config.yaml, metrics.csv, TensorBoard's files, checkpoint.pt, summary.json."""

import io
import json
import math
from collections.abc import Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import pandas as pd
from omegaconf import OmegaConf
from torchrl.record.loggers import TensorboardLogger

from torch_qpmpc.errors import QPError
from torch_qpmpc.experiment.config import Config, flatten
from torch_qpmpc.files import reading, write_whole

#: The newest state of a run in its folder.
CHECKPOINT = "checkpoint.pt"
#: The policy that the gate keeps, written by `QPMPC.save`.
BEST = "best.pt"
#: Entries of summary.json that are numbers or, if they are not finite, null.
NUMBERS = ("seed", "closed_gap", "J_start", "J_best", "J_final", "J_true_model")
NUMBERS += ("canonical_distance",)


class RunFolder(AbstractContextManager["RunFolder"]):
    """The output of one run; a context manager, which flushes at its end.

    Scalars go to metrics.csv and to TensorBoard. A resumed run keeps the rows up to the update
    ``after``, None in a new one; `QPError` where they are damaged.
    """

    def __init__(self, folder: str | Path, cfg: Config, after: int | None = None) -> None:
        # Absolute, so that changes of the working directory do not affect the event writer.
        self.path = Path(folder).resolve()
        self.path.mkdir(parents=True, exist_ok=True)
        # Read before the first event is written: damaged rows stop the run.
        earlier: Any = () if after is None else read_metrics(self.path).loc[:after].iterrows()
        self.rows: list[dict[str, float]] = [{"update": k, **row.dropna()} for k, row in earlier]
        self.cfg = cfg
        if after is None:
            text = OmegaConf.to_yaml(cfg.model_dump(exclude_unset=True))
            write_whole(self.path / "config.yaml", text.encode())
        self.logger = TensorboardLogger("tensorboard", str(self.path))

    def __exit__(self, *_: object) -> None:
        try:
            self.flush()
        finally:
            self.logger.close()

    def log(self, metrics: Mapping[str, float], update: int) -> None:
        """Log scalars at an update, to metrics.csv and TensorBoard."""
        if not metrics:
            return
        if not self.rows or self.rows[-1]["update"] != update:
            self.rows.append({"update": update})
        self.rows[-1].update(metrics)
        self.logger.log_metrics(dict(metrics), step=update)

    def column(self, name: str) -> tuple[list[float], list[float]]:
        """Return the updates at which ``name`` was logged, and its values."""
        rows = [row for row in self.rows if name in row]
        return [row["update"] for row in rows], [row[name] for row in rows]

    def flush(self) -> None:
        """Write metrics.csv and flush TensorBoard's events."""
        table = pd.DataFrame(self.rows).to_csv(index=False)
        write_whole(self.path / "metrics.csv", table.encode())
        self.logger.flush()

    def finish(self, summary: Mapping[str, Any]) -> None:
        """Write the outcome to summary.json, with null for nan and inf, which JSON lacks."""
        finite = json.loads(json.dumps(summary), parse_constant=lambda name: None)
        text = json.dumps(finite, indent=2, allow_nan=False)
        # Written last and atomically: its presence marks the run as finished.
        write_whole(self.path / "summary.json", f"{text}\n".encode())


def read_config(folder: str | Path) -> Config:
    """Read a run's config.yaml; `QPError` if it is damaged or of another version."""
    file = Path(folder) / "config.yaml"
    with reading(file, "the configuration that a run of this version wrote"):
        tree: Any = OmegaConf.to_container(OmegaConf.load(file), resolve=False)
        if not isinstance(tree, dict):
            raise ValueError("it is a list")
        if key := next((key for key, x in flatten(tree).items() if "${" in str(x)), None):
            raise ValueError(f"{key} is an interpolation: write its value")
        return Config.of(tree)


def read_metrics(folder: str | Path) -> pd.DataFrame:
    """Read a run's metrics.csv by update, to the last digit."""
    file = Path(folder) / "metrics.csv"
    remedy = "Go on in a copy of the folder, or start a new run with hydra.run.dir=FOLDER."
    with reading(file, "the table that a run wrote", remedy):
        text = file.read_text(encoding="utf-8")
        if not text.endswith("\n"):
            raise ValueError("its last line is cut off")
        table = pd.read_csv(io.StringIO(text), float_precision="round_trip").astype(float)
        return table.astype({"update": int}).set_index("update")


def read_summary(folder: str | Path) -> dict[str, Any]:
    """Read a finished run's summary.json; raise `QPError` if it is missing or damaged."""
    file = Path(folder) / "summary.json"
    if file.with_name(CHECKPOINT).exists() and not file.exists():
        remedy = f"Finish it: repeat its command with hydra.run.dir={folder}."
        raise QPError.expected("folder", f"{folder}, with a stopped run", "a finished run", remedy)
    with reading(file, "the outcome that a run wrote"):
        summary = json.loads(file.read_text(encoding="utf-8"))
        for name in NUMBERS:
            if not isinstance(summary[name], int | float | None):
                raise ValueError(f"{name} is {summary[name]!r}")
        return summary


def not_null(value: Any) -> Any:
    """Replace None by nan, as before `RunFolder.finish`."""
    if isinstance(value, Mapping):
        return {key: not_null(entry) for key, entry in value.items()}
    return math.nan if value is None else value


def unwritable(folder: str | Path, error: OSError) -> QPError:
    """Make the error of a run in ``folder`` that ended with ``error``."""
    checkpoint = Path(folder) / CHECKPOINT
    remedy = "Choose another folder with hydra.run.dir=FOLDER."
    if checkpoint.exists():
        remedy = f"{checkpoint} is intact: free space, then repeat the command with "
        remedy += f"hydra.run.dir={folder}."
    got = f"{folder}, where writing failed ({error})"
    return QPError.expected("folder", got, "a writable folder", remedy)
