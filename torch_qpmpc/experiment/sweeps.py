"""Sweeps: they skip finished runs and resume stopped ones."""

from __future__ import annotations

import contextlib
import re
import shutil
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf, open_dict, read_write

from torch_qpmpc.errors import QPError
from torch_qpmpc.experiment.checkpoint import CHECKPOINT, PREVIOUS, load_checkpoint
from torch_qpmpc.experiment.config import differences, load_config, settings
from torch_qpmpc.experiment.run_folder import read_summary
from torch_qpmpc.experiment.run_state import check_state


def finished_run(folder: str | Path, cfg: DictConfig) -> dict[str, Any] | None:
    """Read the summary of the run in ``folder``; return None if the run has not finished.

    Raises:
        QPError: the run has finished with other settings than ``cfg``.
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


class SubFolders(Callback):
    """Reduces Hydra's ``override_dirname`` to the overrides that the sweep varies.

    The noise, the constraint and the seed are already in the sub-folder's name.
    """

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        varied = config.hydra.sweeper.get("params") or {}
        overrides = OverridesParser.create().parse_overrides(config.hydra.overrides.task)
        fixed = [x for x in overrides if not x.is_sweep_override()]
        excluded = [x.key_or_group for x in fixed if x.get_key_element() not in varied]
        excluded += ["noise", "constraint", "seed"]
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
