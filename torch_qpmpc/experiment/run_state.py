"""The state of a run, as tensors and plain numbers, from which it resumes.

Over a `LinearSystem` or a `Plant` the resumed run is exact, down to every random number. Other
environments cannot be saved and start new episodes.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Collection
from functools import partial
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs import TransformedEnv

from torch_qpmpc.envs.vectorised import VectorisedEnv
from torch_qpmpc.errors import QPError
from torch_qpmpc.experiment.algorithms import Learner
from torch_qpmpc.experiment.config import differences, load_config, settings
from torch_qpmpc.experiment.gating import RunGate
from torch_qpmpc.experiment.metrics import Tally
from torch_qpmpc.experiment.run_folder import CHECKPOINT
from torch_qpmpc.experiment.tasks.code import COMMAND, has_run, named_code, resume_arguments
from torch_qpmpc.files import load_file
from torch_qpmpc.learning.replay import Replay
from torch_qpmpc.mpc.module import QPMPC
from torch_qpmpc.mpc.state import KIND, stored

#: Files that a run writes before its first checkpoint.
WRITTEN = ("config.yaml", "metrics.csv")


def snapshot(
    cfg: DictConfig,
    mpc: QPMPC,
    learner: Learner,
    gate: RunGate,
    collector: Collector,
    replay: Replay,
    tally: Tally,
) -> dict[str, Any]:
    """Return the state of a run between two updates, a file of the `KIND` of a QPMPC.

    After the last update the replay and the collector's state are left out.
    """
    finished = tally.update == cfg.updates
    return {
        "config": settings(cfg),
        "update": tally.update,
        **stored(mpc),  # so that QPMPC.load reads a checkpoint, too
        "loss_module": learner.loss_module.state_dict(),
        "optimizer": learner.optimizer.state_dict(),
        "scheduler": {"last_epoch": learner.scheduler.last_epoch},
        "gate": gate.state_dict(),
        "replay": replay.state_dict() if len(replay) and not finished else None,
        "collector": None if finished else _collector_state(collector),
        "tally": tally.state_dict(),
        "rng": torch.get_rng_state(),
    }


def restore(
    state: dict[str, Any],
    mpc: QPMPC,
    learner: Learner,
    gate: RunGate,
    collector: Collector,
    replay: Replay,
) -> Tally:
    """Load a `snapshot` into the parts of a new run with the same configuration."""
    tally, schedule = Tally(), vars(learner.scheduler)
    load: dict[str, Callable[[Any], object]] = {
        "loss_module": learner.loss_module.load_state_dict,
        "mpc": mpc.load_state_dict,
        "optimizer": learner.optimizer.load_state_dict,
        "scheduler": lambda part: schedule.update(last_epoch=int(part["last_epoch"])),
        "gate": gate.load_state_dict,
        "replay": replay.load_state_dict,
        "collector": partial(_restore_collector, collector),
        "rng": torch.set_rng_state,
        "tally": tally.load_state_dict,
    }
    for name, function in load.items():
        try:
            if state[name] is not None:
                function(state[name])
        except (RuntimeError, KeyError, ValueError, TypeError, AttributeError) as error:
            reason = str(error).strip().partition("\n")[0]
            got = f"{name!r} that does not fit ({type(error).__name__}: {reason})"
            raise QPError.expected("checkpoint", got, "the state of this run") from error
    if state["collector"] is None:
        replay.end_episodes()
    return tally


def load_state(folder: Path, cfg: DictConfig) -> dict[str, Any]:
    """Load the last `snapshot` of the run in a folder, which has the configuration ``cfg``."""
    state = load_file(folder / CHECKPOINT, KIND, "train.py")
    if "config" not in state:
        raise QPError.expected("checkpoint", "a saved QPMPC", "a run's state")
    if changed := differences(state["config"], settings(cfg)):
        then, now = changed
        remedy = "A run resumes with its own configuration, from its own checkpoints."
        raise QPError.expected(
            "checkpoint", f"one from a run with {then}", f"config.yaml's {now}", remedy
        )
    return state


def resumed(path: str | Path, overrides: Collection[str]) -> tuple[DictConfig, dict | None]:
    """Load a stopped run's configuration and last state, or None before its first checkpoint.

    Beside the run's folder ``path``, the command line's ``overrides`` may only name the code that
    the run needs, as in ``task.file=FILE``.
    """
    given = {key: text.strip("'\"") for key, _, text in (x.partition("=") for x in overrides)}
    cfg, state = _stopped(path)
    code = named_code(cfg.task)
    if others := given.keys() - {"resume", *code, *(["task"] if "task.id" in code else [])}:
        got = f"it together with {', '.join(f'{key}={given[key]}' for key in sorted(others))}"
        remedy = "A run resumes with its own configuration."
        raise QPError.expected("resume", got, "no other override", remedy)
    # Another script may register the task, as on another computer, but not another environment.
    same = code.keys() <= given.keys() and given.get("task.id") == code.get("task.id")
    if not (same or has_run(cfg.task)):
        words = ", ".join(f"{key}={value!r}" for key, value in code.items())
        words += f" with task.kwargs={cfg.task.kwargs}" if cfg.task.get("kwargs") else ""
        got = f"{path}, whose config.yaml names code ({words})"
        command = f"{COMMAND} {resume_arguments(path, cfg.task)}"
        remedy = f"Read that code, which may not be yours; to run it: {command}"
        raise QPError.expected("resume", got, "code that the command line names, too", remedy)
    return cfg, state


def _stopped(path: str | Path) -> tuple[DictConfig, dict | None]:
    """Load a stopped run's configuration and last state as data."""
    config, path = configured(path), Path(path)
    if (path / "summary.json").exists():
        raise QPError.expected("resume", f"{path}, which is finished", "a stopped run")
    cfg = load_config(config)
    return cfg, load_state(path, cfg) if (path / CHECKPOINT).exists() else None


def configured(path: str | Path) -> Path:
    """Return config.yaml of the run in the folder ``path``."""
    if not isinstance(path, str | Path):
        raise QPError.expected("resume", repr(path), "a path")
    config = Path(path) / "config.yaml"
    if not config.exists():
        wrong = "without config.yaml" if Path(path).exists() else "which does not exist"
        raise QPError.expected("resume", f"{path}, {wrong}", "a run's folder")
    return config


def check_fresh(folder: str | Path) -> None:
    """Raise `QPError` if ``folder`` already holds a run, finished or stopped."""
    folder = Path(folder)
    remedy = "Choose another folder with hydra.run.dir=FOLDER."
    if (folder / "summary.json").exists():
        got = "which holds a finished run"
    elif any((folder / name).exists() for name in (*WRITTEN, CHECKPOINT)):
        got = "which holds a stopped run"
        with contextlib.suppress(Exception):  # damaged files raise errors of any type
            arguments = resume_arguments(folder, _stopped(folder)[0].task)
            remedy = (
                f"Resume it with {arguments}, or choose another folder with hydra.run.dir=FOLDER."
            )
    else:
        return
    raise QPError.expected("folder", f"{folder}, {got}", "one without a run", remedy)


def _collector_state(collector: Collector) -> dict[str, Any] | None:
    if (env := _saved_env(collector)) is None:
        return None
    # The collector's state_dict lacks the current steps, and its load_state_dict begins new
    # episodes with new ids: only its private attributes continue an episode.
    return {
        "episodes": collector._carrier.to_dict(),
        "trajectories": collector._traj_pool.state_dict(),
        "rng": env.rng.get_state(),
    }


def _saved_env(collector: Collector) -> VectorisedEnv | None:
    """Return the collector's environment, without its transforms, if its state can be saved."""
    env = collector.env
    env = env.base_env if isinstance(env, TransformedEnv) else env
    return env if isinstance(env, VectorisedEnv) else None


def _restore_collector(collector: Collector, state: dict[str, Any]) -> None:
    env = _saved_env(collector)
    assert env is not None
    episodes = TensorDict(state["episodes"], batch_size=collector._carrier.batch_size)
    if missing := set(collector._carrier.keys(True, True)) - set(episodes.keys(True, True)):
        raise KeyError(f"no {missing}")
    collector._carrier.update(episodes)
    collector._traj_pool.load_state_dict(state["trajectories"])
    env.rng.set_state(state["rng"])
