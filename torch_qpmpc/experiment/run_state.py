"""The state of a run, as tensors and plain numbers, from which it resumes.

Over a `LinearSystem` or a `Plant` the resumed run is exact, down to every random number. Other
environments cannot be saved and start new episodes.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs import TransformedEnv

from torch_qpmpc.envs.vectorised import VectorisedEnv
from torch_qpmpc.errors import QPError
from torch_qpmpc.experiment.algorithms import Learner
from torch_qpmpc.experiment.config import Config
from torch_qpmpc.experiment.evaluation import Evaluation
from torch_qpmpc.experiment.gating import RunGate
from torch_qpmpc.experiment.metrics import Tally
from torch_qpmpc.learning.replay import Replay
from torch_qpmpc.mpc.module import QPMPC
from torch_qpmpc.mpc.state import stored


@dataclass(frozen=True)
class RunState:
    """The parts of a run whose state a checkpoint keeps."""

    cfg: Config
    mpc: QPMPC
    learner: Learner
    gate: RunGate
    collector: Collector
    replay: Replay
    evaluation: Evaluation
    tally: Tally

    @property
    def _parts(self) -> dict[str, Any]:
        learner = {"loss_module": self.learner.loss_module, "optimizer": self.learner.optimizer}
        names = ("mpc", "gate", "replay", "evaluation", "tally")
        return learner | {name: getattr(self, name) for name in names}

    def snapshot(self) -> dict[str, Any]:
        """Return the state between two updates, a file that `QPMPC.load` reads, too.

        After the last update the replay and the collector's state are left out.
        """
        finished, parts = self.tally.update == self.cfg.updates, self._parts
        if finished or not len(self.replay):
            del parts["replay"]
        own: dict[str, Any] = {"replay": None, "config": self.cfg.settings}
        own |= {name: part.state_dict() for name, part in parts.items()}
        own |= {"update": self.tally.update, "rng": torch.get_rng_state()}
        own |= {"scheduler": {"last_epoch": self.learner.scheduler.last_epoch}}
        own |= {"collector": None if finished else _collector_state(self.collector)}
        return stored(self.mpc) | own

    def restore(self, state: dict[str, Any]) -> None:
        """Load a `snapshot` of a run with the same configuration."""
        schedule = vars(self.learner.scheduler)
        load: dict[str, Callable[[Any], object]] = {
            **{name: part.load_state_dict for name, part in self._parts.items()},
            "scheduler": lambda part: schedule.update(last_epoch=int(part["last_epoch"])),
            "collector": partial(_restore_collector, self.collector),
            "rng": torch.set_rng_state,
        }
        for name, function in load.items():
            try:
                if state[name] is not None:
                    function(state[name])
            except (RuntimeError, KeyError, ValueError, TypeError, AttributeError) as error:
                reason = str(error).strip().partition("\n")[0]
                got = f"{name!r} that does not fit ({type(error).__name__}: {reason})"
                raise QPError.expected("checkpoint", got, "this run's, of this version") from error
        if state["collector"] is None:
            self.replay.end_episodes()


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
