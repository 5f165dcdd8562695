"""TorchRL's loggers for a run, by name: TensorBoard, CSV, Weights & Biases and MLflow.

Each writes into the run's folder. What TorchRL's interface lacks, such as figures and the end of a
run, is here.
"""

from __future__ import annotations

import importlib.util
import os
import shutil
import uuid
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from tensorboard.compat.proto import event_pb2
from torchrl.record.loggers import Logger, TensorboardLogger, get_logger

from torch_qpmpc.errors import QPError

LOGGERS = ("tensorboard", "csv", "wandb", "mlflow")
#: Those that need a package which is not installed with torch_qpmpc, but with an extra of its name.
EXTRAS = ("wandb", "mlflow")


class RunLogger:
    """One of TorchRL's loggers in the folder of a run, which may go on.

    TensorBoard and W&B continue; CSV and MLflow, which cannot, begin anew with the rows so far.

    Args:
        name: one of `LOGGERS`.
        folder: of the run.
        settings: of the run, by their dotted keys.
        rows: what was logged up to the update ``after``; None for ``after`` is a new run.

    Raises:
        QPError: the package of ``name`` is not installed.
    """

    def __init__(
        self,
        name: str,
        folder: Path,
        settings: Mapping[str, Any],
        rows: Sequence[Mapping[str, float]] = (),
        after: int | None = None,
    ) -> None:
        if name in EXTRAS and importlib.util.find_spec(name) is None:
            got, remedy = f"{name}, which is not installed", f"Install it: pip install {name}."
            raise QPError.expected("logger", got, "an installed logger", remedy)
        self.name, self.folder, self.settings = name, folder, plain(settings)
        self.logger: Logger = self._make()
        if isinstance(self.logger, TensorboardLogger):
            # TensorBoard drops what earlier event files have from here on.
            event: Any = event_pb2  # its classes are made at run time
            start = event.SessionLog(status=event.SessionLog.START)
            writer = self.logger.experiment.file_writer.event_writer
            writer.add_event(event.Event(step=0 if after is None else after + 1, session_log=start))
        else:
            self.logger.log_hparams(self.settings)
        if name in ("csv", "mlflow"):
            for row in rows:
                scalars = {key: value for key, value in row.items() if key != "update"}
                self.log(scalars, int(row["update"]))

    def _make(self) -> Any:
        if self.name == "wandb":
            options = {"id": self._wandb_id(), "log_env_packages": False}
            place = str(self.folder)
            return get_logger("wandb", place, self.folder.name, wandb_kwargs=options)
        if self.name == "mlflow":
            # Its successor, a database, needs more packages than a folder of files.
            os.environ.setdefault("MLFLOW_ALLOW_FILE_STORE", "true")
            return get_logger("mlflow", str(self.folder / "mlflow"), "torch_qpmpc")
        if self.name == "csv":
            shutil.rmtree(self.folder / "csv", ignore_errors=True)
        name: Any = self.name  # of the literals that TorchRL's annotation lists
        return get_logger(name, str(self.folder), self.name)

    def _wandb_id(self) -> str:
        """The run's id at W&B, by which it goes on there."""
        file = self.folder / "wandb-id.txt"
        if not file.exists():
            file.write_text(uuid.uuid4().hex, encoding="utf-8")
        return file.read_text(encoding="utf-8")

    def log(self, metrics: Mapping[str, float], update: int) -> None:
        """Scalars at an update."""
        self.logger.log_metrics(dict(metrics), step=update)

    def text(self, name: str, text: str) -> None:
        """A text in Markdown, for TensorBoard, which has no other place for the settings so early.

        The others have the settings as hyper-parameters.
        """
        if isinstance(self.logger, TensorboardLogger):
            self.logger.experiment.add_text(name, text)

    def figure(self, name: str, figure: Figure, update: int) -> None:
        """A figure at an update."""
        if isinstance(self.logger, TensorboardLogger):
            self.logger.experiment.add_figure(name, figure, update)
        elif self.name == "wandb":
            import matplotlib.pyplot  # noqa: F401 - wandb.Image needs it imported
            import wandb

            self.logger.log_metrics({name: wandb.Image(figure)}, step=update)
        elif self.name == "mlflow":
            import mlflow

            mlflow.log_figure(figure, f"{name}-{update}.png")
        else:
            file = self.folder / "csv" / "figures" / f"{name}-{update}.png"
            file.parent.mkdir(parents=True, exist_ok=True)
            figure.savefig(file, dpi=100)

    def finish(self, summary: Mapping[str, Any]) -> None:
        """The outcome of a run, beside its hyper-parameters."""
        outcome = {
            f"hparam/{key}": value for key, value in summary.items() if isinstance(value, float)
        }
        if isinstance(self.logger, TensorboardLogger):
            self.logger.experiment.add_hparams(self.settings, outcome, run_name=".")
        else:
            self.logger.log_metrics(outcome)

    def flush(self) -> None:
        self.logger.flush()

    def close(self) -> None:
        if self.name == "mlflow":
            import mlflow

            mlflow.end_run()
        elif isinstance(self.logger, TensorboardLogger):
            self.logger.experiment.close()  # also where flushing fails
        else:
            self.logger.close()


def plain(settings: Mapping[str, Any]) -> dict[str, bool | int | float | str]:
    """Settings as hyper-parameters: what is no number, name or flag as text."""
    kinds = (bool, int, float, str)
    return {key: x if isinstance(x, kinds) else str(x) for key, x in settings.items()}
