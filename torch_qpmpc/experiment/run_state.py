"""The state of a run, as tensors and plain numbers, from which it resumes.

Over a `LinearSystem` or a `Plant` the resumed run is exact, down to every random number. Other
environments cannot be saved and start new episodes.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs import TransformedEnv

from torch_qpmpc.envs.vectorised import VectorisedEnv
from torch_qpmpc.errors import QPError
from torch_qpmpc.experiment.algorithms import Learner
from torch_qpmpc.experiment.config import Config, differences
from torch_qpmpc.experiment.evaluation import Evaluation
from torch_qpmpc.experiment.gating import RunGate
from torch_qpmpc.experiment.metrics import Tally
from torch_qpmpc.experiment.run_folder import CHECKPOINT
from torch_qpmpc.files import load_file
from torch_qpmpc.learning.replay import Replay
from torch_qpmpc.mpc.module import QPMPC
from torch_qpmpc.mpc.state import KIND, stored


def snapshot(
    cfg: Config,
    mpc: QPMPC,
    learner: Learner,
    gate: RunGate,
    collector: Collector,
    replay: Replay,
    evaluation: Evaluation,
    tally: Tally,
) -> dict[str, Any]:
    """Return the state of a run between two updates, a file of the `KIND` of a QPMPC.

    After the last update the replay and the collector's state are left out.
    """
    finished = tally.update == cfg.updates
    return {
        "config": cfg.settings,
        "update": tally.update,
        **stored(mpc),  # so that QPMPC.load reads a checkpoint, too
        "loss_module": learner.loss_module.state_dict(),
        "optimizer": learner.optimizer.state_dict(),
        "scheduler": {"last_epoch": learner.scheduler.last_epoch},
        "gate": gate.state_dict(),
        "replay": replay.state_dict() if len(replay) and not finished else None,
        "collector": None if finished else _collector_state(collector),
        "evaluation": evaluation.state_dict(),
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
    evaluation: Evaluation,
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
        "evaluation": evaluation.load_state_dict,
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


def load_state(folder: Path, cfg: Config) -> dict[str, Any]:
    """Load the last `snapshot` of the run in a folder, which has the configuration ``cfg``.

    Raises:
        QPError: the file is damaged, or of a run with another configuration.
    """
    state = load_file(folder / CHECKPOINT, KIND, "train.py")
    if "config" not in state:
        raise QPError.expected("checkpoint", "a saved QPMPC", "a run's state")
    if changed := differences(state["config"], cfg.settings):
        then, now = changed
        remedy = "A run resumes with its own configuration, from its own checkpoints."
        raise QPError.expected(
            "checkpoint", f"one from a run with {then}", f"config.yaml's {now}", remedy
        )
    return state


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
