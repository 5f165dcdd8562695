"""Launch of a run: its folder, its lock, its end by Ctrl-C, and its errors as one sentence."""

import logging
import re
import shlex
import shutil
import signal
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf, open_dict, read_write

from torch_qpmpc.errors import QPError
from torch_qpmpc.experiment.config import Config, keys, unknown_key
from torch_qpmpc.experiment.run_folder import CHECKPOINT, read_config, read_summary, unwritable
from torch_qpmpc.experiment.tasks.code import COMMAND
from torch_qpmpc.files import load_file
from torch_qpmpc.mpc.state import KIND

#: The locked file of a run's folder.
LOCK = ".lock"


def settled(
    cfg: Config, folder: str | Path, sweep: bool
) -> tuple[dict[str, Any] | None, dict[str, Any] | None]:
    """Decide between a new run in ``folder``, one that goes on, and a finished one.

    Returns:
        The state to go on from, or None; the summary of a finished run, or None.

    Raises:
        QPError: the folder holds a run with another configuration.
    """
    folder = Path(folder)
    config, remedy = folder / "config.yaml", f"Choose another folder with {_key(sweep)}=FOLDER."
    if not config.exists():
        if any((folder / name).exists() for name in ("metrics.csv", CHECKPOINT, "summary.json")):
            got = f"{folder}, which holds a run without its config.yaml"
            raise QPError.expected("folder", got, "a run's folder, or one without a run", remedy)
        return None, None
    finished, state = (folder / "summary.json").exists(), None
    known, own = [read_config(folder).settings], cfg.settings
    if (folder / CHECKPOINT).exists() and not finished:
        state = load_file(folder / CHECKPOINT, KIND, "train.py")
        if "config" not in state:
            raise QPError.expected("checkpoint", "a saved QPMPC", "a run's state")
        known.append(state["config"])
    for settings in known:
        changed = [key for key in {**settings, **own} if settings.get(key) != own.get(key)]
        if changed:
            both = (settings, own)
            then, now = (", ".join(f"{key}={of.get(key)}" for key in changed) for of in both)
            got = f"{folder}, which holds a run with {then}"
            raise QPError.expected("folder", got, now, remedy)
    if state is None and not finished:
        shutil.rmtree(folder / "tensorboard", ignore_errors=True)  # of a run that begins anew
    return state, read_summary(folder) if finished else None


def _key(sweep: bool) -> str:
    return f"hydra.{'sweep' if sweep else 'run'}.dir"


def check_overrides(arguments: Sequence[str], configs: str | Path) -> None:
    """Raise `QPError` for an unknown key, for which Hydra advises a +."""
    known, groups = [*keys()], {path.name for path in Path(configs).iterdir() if path.is_dir()}
    for argument in arguments:
        key = argument.partition("=")[0]
        plain = "=" in argument and re.fullmatch(r"\w+(\.\w+)*", key)
        if not plain or key in groups or key.startswith("hydra."):
            continue
        if not any(f"{x}.".startswith(f"{key}.") or key.startswith(f"{x}.") for x in known):
            raise unknown_key(key)


@contextmanager
def launched() -> Iterator[tuple[str, bool]]:
    """Lock the run's folder, yield it and True in a sweep, and exit with one sentence on an error.

    Ctrl-C and SIGTERM name the command that goes on; a sweep's runs raise. train.log gets warnings.
    """
    hydra, stopped = HydraConfig.get(), []
    sweep, folder = hydra.mode is RunMode.MULTIRUN, hydra.runtime.output_dir

    def stop(signum: int, frame: Any) -> None:
        stopped.append(signum)
        signal.default_int_handler(signum, frame)

    usual = {} if sweep else {x: signal.signal(x, stop) for x in (signal.SIGINT, signal.SIGTERM)}
    logging.captureWarnings(True)
    try:
        with locked(folder, f"{_key(sweep)}=FOLDER"):
            yield folder, sweep
    except (QPError, OSError) as error:
        if sweep:
            error.add_note(f"The run is that of {folder}.")
            raise
        if isinstance(error, OSError):
            error = unwritable(folder, error)
        raise SystemExit(str(error)) from None
    except BaseException as error:  # libraries make errors of their own of Ctrl-C
        if sweep or not (stopped or isinstance(error, KeyboardInterrupt)):
            raise
        command = shlex.join([*hydra.overrides.task, f"hydra.run.dir={folder}"])
        print(f"\nStopped: go on with {COMMAND} {command}", flush=True)
        raise SystemExit(128 + (stopped or [signal.SIGINT])[-1]) from None
    finally:
        logging.captureWarnings(False)
        for signum, handler in usual.items():
            signal.signal(signum, handler)


@contextmanager
def locked(folder: str | Path, elsewhere: str) -> Iterator[None]:
    """Hold the lock of a run's folder, or raise `QPError`; ``elsewhere`` chooses another folder."""
    try:
        with FileLock(Path(folder) / LOCK, timeout=0):
            yield
    except Timeout:
        remedy = f"Wait until that run has ended, or choose another folder with {elsewhere}."
        got, want = f"{folder}, in use by another process", "one that no run is using"
        raise QPError.expected("folder", got, want, remedy) from None


class SubFolders(Callback):
    """Names sub-folders by the overrides that a sweep varies; its end names the report."""

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        varied = config.hydra.sweeper.get("params") or {}
        overrides = OverridesParser.create().parse_overrides(config.hydra.overrides.task)
        fixed = [x for x in overrides if not x.is_sweep_override()]
        excluded = [x.key_or_group for x in fixed if x.get_key_element() not in varied]
        excluded += ["noise", "constraint", "seed"]  # in the name already
        # Each run composes its configuration from these overrides and its own.
        with open_dict(config), read_write(config):
            config.hydra.overrides.hydra.append(
                f"hydra.job.config.override_dirname.exclude_keys={excluded}"
            )

    def on_multirun_end(self, config: DictConfig, **_: Any) -> None:
        """Name the command that makes the table of the runs."""
        print(f"\npython -m torch_qpmpc.report {shlex.quote(config.hydra.sweep.dir)}", flush=True)


def sub_folder(*names: str) -> str:
    """Join ``names`` to a folder's name, without characters that some file systems refuse."""
    joined = "-".join(filter(None, names)).replace("+", "")
    return re.sub(r"[^\w.,=-]+", "_", joined)


# configs/config.yaml calls this.
OmegaConf.register_new_resolver("sub_folder", sub_folder, replace=True)
