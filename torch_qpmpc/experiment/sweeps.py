"""Sweeps: they skip finished runs, resume stopped ones, and show their progress in one line."""

from __future__ import annotations

import contextlib
import math
import os
import re
import shutil
import signal
import threading
from collections import Counter
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.core.utils import JobReturn, JobStatus
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf, open_dict, read_write
from tqdm import tqdm

from torch_qpmpc.errors import QPError
from torch_qpmpc.experiment.checkpoint import CHECKPOINT, PREVIOUS, load_checkpoint
from torch_qpmpc.experiment.config import differences, load_config, settings
from torch_qpmpc.experiment.run_folder import read_summary
from torch_qpmpc.experiment.run_state import check_state

#: Seconds between two updates of the progress line.
PERIOD = 0.5


def finished_run(folder: str | Path, cfg: DictConfig) -> dict[str, Any] | None:
    """Read the summary of the run in ``folder``; return None if the run has not finished.

    Args:
        folder: the run's folder.
        cfg: the settings that the run must have.

    Raises:
        QPError: the run has finished with other settings.
    """
    folder = Path(folder)
    if not (folder / "summary.json").exists():
        return None
    saved = settings(load_config(folder / "config.yaml"))
    if changed := differences(saved, settings(cfg)):
        then, now = changed
        remedy = "Remove it, or choose another folder with hydra.sweep.dir=FOLDER."
        raise QPError.expected(f"{folder}", f"a finished run with {then}", now, remedy)
    return read_summary(folder)


def stopped_run(folder: str | Path, cfg: DictConfig) -> dict[str, Any] | None:
    """The state from which the run in ``folder`` can go on, or None where it has to begin anew.

    That is where there is none, or one that cannot be read or had other settings. What such a run
    left for TensorBoard is removed.
    """
    folder = Path(folder)
    for checkpoint in (folder / CHECKPOINT, folder / PREVIOUS):
        with contextlib.suppress(QPError):
            state = load_checkpoint(checkpoint)
            check_state(state, cfg)
            return state
    shutil.rmtree(folder / "tensorboard", ignore_errors=True)
    return None


def _overrides(config: DictConfig) -> dict[str, Override]:
    """Return a sweep's overrides by key; the command line takes precedence over the file."""
    params = config.hydra.sweeper.get("params") or {}
    arguments = [f"{key}={value}" for key, value in params.items()]
    overrides = OverridesParser.create().parse_overrides([*arguments, *config.hydra.overrides.task])
    return {override.get_key_element(): override for override in overrides}


def number_of_runs(config: DictConfig) -> int | None:
    """Count the runs of a sweep; return None if the sweeper draws values from an interval."""
    axes = [override for override in _overrides(config).values() if override.is_sweep_override()]
    if not all(override.is_discrete_sweep() for override in axes):
        return None
    return math.prod(len(list(axis.sweep_string_iterator())) for axis in axes)


class SubFolders(Callback):
    """Reduces Hydra's ``override_dirname`` to the overrides that the sweep varies.

    The noise, the constraint and the seed are already in the sub-folder's name.
    """

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        varied = config.hydra.sweeper.get("params") or {}
        excluded = ["noise", "constraint", "seed"]
        for key, override in _overrides(config).items():
            if not override.is_sweep_override() and key not in varied:
                excluded.append(override.key_or_group)
        # Each run composes its configuration from these overrides and its own.
        with open_dict(config), read_write(config):
            config.hydra.overrides.hydra.append(
                f"hydra.job.config.override_dirname.exclude_keys={excluded}"
            )


def sub_folder(*names: str) -> str:
    """Join ``names`` to a folder's name, without characters that some file systems refuse."""
    joined = "-".join(filter(None, names)).replace("+", "")
    return re.sub(r"[^\w.,=-]+", "_", joined)


# configs/config.yaml calls this.
OmegaConf.register_new_resolver("sub_folder", sub_folder, replace=True)


class SweepProgress(Callback):
    """A sweep's progress line, for any launcher.

    Each run, perhaps on another machine, leaves a note in the sweep's folder when it ends.
    """

    def __init__(self) -> None:
        self.notes: Path | None = None
        self.launcher = os.getpid()

    def __getstate__(self) -> dict[str, Any]:
        """Return what the processes of the runs need."""
        return {"notes": self.notes, "launcher": self.launcher}

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        folder = Path(config.hydra.sweep.dir).resolve()
        self.notes = folder / ".ended"
        shutil.rmtree(self.notes, ignore_errors=True)
        self.notes.mkdir(parents=True)
        self.ended = threading.Event()
        arguments = self.notes, number_of_runs(config), self.ended
        self.line = threading.Thread(target=_show, args=arguments, daemon=True)
        self.line.start()

    def on_job_start(self, config: DictConfig, **_: Any) -> None:
        self.skipped = (Path(config.hydra.runtime.output_dir) / "summary.json").exists()
        main_thread = threading.current_thread() is threading.main_thread()
        if os.getpid() != self.launcher and main_thread:
            # The launcher handles Ctrl-C and ends its runs.
            signal.signal(signal.SIGINT, signal.SIG_IGN)

    def on_job_end(self, config: DictConfig, job_return: JobReturn, **_: Any) -> None:
        if self.notes is None:
            return
        failed = job_return.status is not JobStatus.COMPLETED
        outcome = "failed" if failed else "finished before" if self.skipped else "done"
        (self.notes / f"{config.hydra.job.num} {outcome}").touch()

    def on_multirun_end(self, **_: Any) -> None:
        self.ended.set()
        self.line.join()


def _show(notes: Path, total: int | None, ended: threading.Event) -> None:
    with tqdm(total=total, desc=notes.parent.name, unit="run", dynamic_ncols=True) as line:
        while True:
            last = ended.wait(PERIOD)
            outcomes = Counter(note.name.partition(" ")[2] for note in notes.iterdir())
            if outcomes.total() > line.n:
                line.set_postfix(outcomes, refresh=False)
                line.update(outcomes.total() - line.n)
            if last:
                return
