"""Launch of a run: its folder, its lock, and its errors as one-sentence messages."""

from __future__ import annotations

import contextlib
import re
import threading
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from torch_qpmpc.errors import QPError
from torch_qpmpc.experiment.announcement import announcement, compilation_named
from torch_qpmpc.experiment.config import check_config
from torch_qpmpc.experiment.config.messages import keys, unknown_key
from torch_qpmpc.experiment.lock import ELSEWHERE, ELSEWHERE_IN_SWEEP, locked
from torch_qpmpc.experiment.run_folder import unwritable
from torch_qpmpc.experiment.run_state import check_fresh, check_own_folder, folder_of, resumed
from torch_qpmpc.experiment.sweeps import finished_run, stopped_run
from torch_qpmpc.experiment.tasks import run_code

# For hydra.run.dir in configs/config.yaml: a resumed run keeps its folder.
OmegaConf.register_new_resolver("folder_of", folder_of, replace=True)


@dataclass(frozen=True)
class Launch:
    """One call of train.py.

    Attributes:
        folder: the run's folder.
        overrides: the command line's overrides.
        sweep: True if the run is part of a sweep.
    """

    folder: str
    overrides: Collection[str]
    sweep: bool

    def settle(
        self, cfg: DictConfig
    ) -> tuple[DictConfig, dict[str, Any] | None, dict[str, Any] | None]:
        """Decide between a new run, one to resume, and a finished one of a sweep.

        Returns:
            The run's configuration, the state to resume from or None, and the summary of a
            finished run or None.

        Raises:
            QPError: the configuration is invalid, or the folder holds another run.
        """
        resume, state = cfg.resume, None
        if resume is None:
            run_code(cfg.task)
        else:
            own = cfg.task.get("file")
            cfg, state = resumed(resume, self.overrides)
            run_code({**cfg.task, "file": own})
        check_config(cfg)
        if self.sweep:
            if (summary := finished_run(self.folder, cfg)) is not None:
                return cfg, None, summary
            state = stopped_run(self.folder, cfg)
        elif resume is None:
            check_fresh(self.folder)
        else:
            check_own_folder(resume, self.folder)
        if not self.sweep:
            print(announcement(cfg, self.folder, state["update"] if state else 0), flush=True)
        return cfg, state, None


def check_overrides(arguments: Sequence[str], configs: str | Path) -> None:
    """Exit with the nearest key if an override has an unknown one, for which Hydra advises a +.

    Args:
        arguments: the command line.
        configs: the folder of the configuration groups.
    """
    known = keys()
    groups = {path.name for path in Path(configs).iterdir() if path.is_dir()}
    for argument in arguments:
        key = argument.partition("=")[0]
        is_plain = "=" in argument and re.fullmatch(r"\w+(\.\w+)*", key)
        if not is_plain or key in groups or key.startswith("hydra."):
            continue
        if not any(
            f"{name}.".startswith(f"{key}.") or key.startswith(f"{name}.") for name in known
        ):
            raise SystemExit(str(unknown_key(key, known)))


@contextmanager
def launched() -> Iterator[Launch]:
    """Lock the run's folder, and exit with one sentence on a user's error.

    In a sweep the error is raised instead, because an exit would end the other runs.
    """
    hydra = HydraConfig.get()
    sweep = hydra.mode is RunMode.MULTIRUN
    launch = Launch(hydra.runtime.output_dir, list(hydra.overrides.task), sweep)
    try:
        named = contextlib.nullcontext() if sweep else compilation_named()
        lock = locked(launch.folder, ELSEWHERE_IN_SWEEP if sweep else ELSEWHERE)
        with _threads_os_errors_ignored(), lock, named:
            yield launch
    except QPError as error:
        if sweep:
            raise
        raise SystemExit(str(error)) from None
    except OSError as error:
        if sweep:
            raise
        raise SystemExit(str(unwritable(launch.folder, error))) from None


@contextmanager
def _threads_os_errors_ignored() -> Iterator[None]:
    """Keep silent about file errors of TensorBoard's thread, which the run raises again.

    The thread starts inside TensorBoard, so that only Python's hook sees its errors.
    """
    previous = threading.excepthook

    def hook(error: threading.ExceptHookArgs) -> None:
        if not isinstance(error.exc_value, OSError):
            previous(error)

    threading.excepthook = hook
    try:
        yield
    finally:
        threading.excepthook = previous
