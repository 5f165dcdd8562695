"""TorchRL's loggers by name: TensorBoard, CSV, Weights & Biases and MLflow.

Each writes into the run's folder. `RunLogger` adds what TorchRL's interface lacks: figures, texts
and the end of a run.
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

#: Loggers that need the extra of the same name.
EXTRAS = ("wandb", "mlflow")
#: The plots of TensorBoard's tab "Custom Scalars", each of the tags that match.
LAYOUT = {
    "run": {
        "closed-loop cost J": ["Multiline", ["^eval/J(_true_model)?$"]],
        "mean absolute TD error": ["Multiline", ["^train/td_error$"]],
    }
}


def check_logger(name: str) -> None:
    """Check that the package of a logger is installed.

    Raises:
        QPError: it is not.
    """
    if name in EXTRAS and importlib.util.find_spec(name) is None:
        got, remedy = f"{name}, which is not installed", f"Install it: pip install {name}."
        raise QPError.expected("logger", got, "an installed logger", remedy)


class RunLogger:
    """One of TorchRL's loggers, for a new or a resumed run.

    TensorBoard and W&B continue; CSV and MLflow start again from the rows logged so far.

    Args:
        name: tensorboard, csv, wandb or mlflow.
        folder: the run's folder.
        settings: the run's settings by dotted key.
        rows: the rows logged up to update ``after``.
        after: the update to resume after; None for a new run.

    Raises:
        QPError: the package ``name`` is not installed.
    """

    def __init__(
        self,
        name: str,
        folder: Path,
        settings: Mapping[str, Any],
        rows: Sequence[Mapping[str, float]] = (),
        after: int | None = None,
    ) -> None:
        check_logger(name)
        self.name, self.folder, self.settings = name, folder, plain(settings)
        self.logger: Logger = self._make()
        if isinstance(self.logger, TensorboardLogger):
            # TensorBoard drops later steps from earlier event files.
            event: Any = event_pb2  # its classes are created at run time
            start = event.SessionLog(status=event.SessionLog.START)
            writer = self.logger.experiment.file_writer.event_writer
            writer.add_event(event.Event(step=0 if after is None else after + 1, session_log=start))
            self.logger.experiment.add_custom_scalars(LAYOUT)
        else:
            self.logger.log_hparams(self.settings)
        if name in ("csv", "mlflow"):
            for row in rows:
                scalars = {key: value for key, value in row.items() if key != "update"}
                self.log(scalars, int(row["update"]))

    def _make(self) -> Any:
        if self.name == "wandb":
            options = {"id": self._wandb_id(), "log_env_packages": False}
            folder, run_name = str(self.folder), self.folder.name
            return get_logger("wandb", folder, run_name, wandb_kwargs=options)
        if self.name == "mlflow":
            # MLflow's default, a database, needs more packages.
            os.environ.setdefault("MLFLOW_ALLOW_FILE_STORE", "true")
            return get_logger("mlflow", str(self.folder / "mlflow"), "torch_qpmpc")
        if self.name == "csv":
            shutil.rmtree(self.folder / "csv", ignore_errors=True)
        name: Any = self.name  # TorchRL annotates a Literal
        return get_logger(name, str(self.folder), self.name)

    def _wandb_id(self) -> str:
        """Return the run's id at W&B, which a resumed run reuses."""
        file = self.folder / "wandb-id.txt"
        if not file.exists():
            file.write_text(uuid.uuid4().hex, encoding="utf-8")
        return file.read_text(encoding="utf-8")

    def log(self, metrics: Mapping[str, float], update: int) -> None:
        """Log scalars at an update."""
        self.logger.log_metrics(dict(metrics), step=update)

    def text(self, name: str, text: str) -> None:
        """Log a text in Markdown to TensorBoard.

        The other loggers get the settings as hyper-parameters at the start.
        """
        if isinstance(self.logger, TensorboardLogger):
            self.logger.experiment.add_text(name, text)

    def figure(self, name: str, figure: Figure, update: int) -> None:
        """Log a figure at an update."""
        if isinstance(self.logger, TensorboardLogger):
            self.logger.experiment.add_figure(name, figure, update)
        elif self.name == "wandb":
            import matplotlib.pyplot  # noqa: F401 - wandb.Image requires the import
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
        """Log a run's outcome beside its hyper-parameters."""
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
            self.logger.experiment.close()  # closes the file even if flushing fails
        else:
            self.logger.close()


def plain(settings: Mapping[str, Any]) -> dict[str, bool | int | float | str]:
    """Convert settings to hyper-parameters: numbers, flags and text."""
    kinds = (bool, int, float, str)
    return {key: x if isinstance(x, kinds) else str(x) for key, x in settings.items()}
