"""The gate of a run: the policies that act and that are kept, compared on a plant or on models."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import DictConfig
from torch import Tensor
from tqdm import tqdm

from torch_qpmpc.envs.arx_plant import ARXMember
from torch_qpmpc.envs.closed_loop import plant_loop
from torch_qpmpc.errors import QPError
from torch_qpmpc.experiment.algorithms import Learner, evaluate
from torch_qpmpc.experiment.checkpoint import BEST
from torch_qpmpc.experiment.ensemble import MEMBERS, check_ensemble, run_ensemble
from torch_qpmpc.experiment.start import transitions
from torch_qpmpc.experiment.tasks import AnyPlant
from torch_qpmpc.experiment.tasks.identified import Start
from torch_qpmpc.files import save_file
from torch_qpmpc.learning.gate import Gate
from torch_qpmpc.learning.operators import in_closed_loop
from torch_qpmpc.learning.replay import Replay
from torch_qpmpc.learning.search import available, search
from torch_qpmpc.mpc.module import QPMPC

#: The most pairs of a comparison. A run's later ones need more, as they share one alpha.
PAIRS = 160
#: The values of gate with which only what is kept acts.
ACTING = ("act", "plant", "model")
#: The rejections in a row after which the learner then restarts from what is kept.
PATIENCE = 3
#: What the transitions of comparisons are called that do not run on a simulator.
COMPARED = {"plant": "alternated", "model": "modelled"}
UNFITTED = "The run's transitions identify no ensemble, so that gate=model rejects the candidate: "


class RunGate:
    """The policies of a run: the learner's, and the best one that a `Gate` has accepted.

    With ``gate=true`` the learner's policy acts and learns as without a gate, and the gate decides
    which one is kept. With ``gate=act`` the policy that is kept acts, too, and the learner restarts
    from it after three rejections in a row. ``gate=plant`` does the same with closed loops that a
    plant can run, as no two of them have the same starts and disturbances. ``gate=model`` does so
    with closed loops on the `ensemble` of the run's transitions, and no others.

    Args:
        cfg: the run's configuration; ``gate`` switches the comparisons on.
        learner: the learner, whose policy is the candidate.
        physics: the plant.
        start, replay: the log that the run starts from, if it does, and its transitions.
        quiet: show no bar during the search.

    Attributes:
        kept: the policy that is evaluated and saved; without a gate, the learner's.
        compared: the number of transitions in closed loops of comparisons and searches.

    Raises:
        QPError: ``gate=model`` has no plant, or too few transitions.
    """

    def __init__(
        self,
        cfg: DictConfig,
        learner: Learner,
        physics: AnyPlant,
        start: Start | None,
        replay: Replay,
        quiet: bool = True,
    ) -> None:
        self._cfg, self._learner, self._physics, self._quiet = cfg, learner, physics, quiet
        self._logged, self._members = partial(transitions, start, replay), list[ARXMember]()
        self._start = start
        options = {"seed": cfg.seed, "pairs": PAIRS, "decisions": _decisions(cfg)}
        options |= {"bound": cfg.gate_bound, "patience": PATIENCE if cfg.gate in ACTING else None}
        costs: Any = self._costs
        if cfg.gate == "model":
            check_ensemble(cfg, physics, start)
            costs = [partial(self._member_costs, i) for i in range(MEMBERS)]
        self._gate = Gate(learner.actor, costs, **options) if cfg.gate else None
        self.kept: Any = learner.actor if self._gate is None else self._gate.actor
        self.compared = 0

    @property
    def acting(self) -> Any:
        """The policy that collects transitions."""
        return self.kept if self._cfg.gate in ACTING else self._learner.actor

    @property
    def policy(self) -> Callable[[Tensor], Tensor]:
        """The policy that is kept, as a function from p to a, for one closed loop."""
        return in_closed_loop(self.kept, self._learner.n_preview)

    @property
    def mpc(self) -> QPMPC | None:
        """The QP of the policy that is kept; None if it is a network."""
        return _qp(self.kept)

    def judge(self, update: int) -> dict[str, float]:
        """Keep the learner's policy if it costs less; return the scalars of the comparison.

        Judges each ``gate_interval`` updates and after the last one. Then a direct search over the
        scalars that the configuration chooses follows, from the policy that is kept, and its result
        is judged, too. Without a gate nothing is judged or searched, and on models nothing is
        searched: a search moves the policy to where their errors agree.
        """
        if self._gate is None:
            return {}
        last = update == self._cfg.updates
        if not last and update % _interval(self._cfg):
            return {}
        if self._cfg.gate == "model":
            try:
                self._members = run_ensemble(self._cfg, self._physics, self._start, self._logged())
            except QPError as error:
                warnings.warn(f"{UNFITTED}{error}", UserWarning, stacklevel=2)
                self._gate.rejected += 1
                return {"gate/accepted": 0.0}
        verdict = self._judge("gate")
        return verdict | self._search() if last and self._cfg.gate != "model" else verdict

    def _judge(self, tag: str) -> dict[str, float]:
        assert self._gate is not None
        verdict = self._gate.judge(self._learner.actor)
        names = ("accepted", "mean", "low", "high", "pairs")
        return {f"{tag}/{name}": float(getattr(verdict, name)) for name in names}

    def _search(self) -> dict[str, float]:
        actor = self._learner.actor
        mpc = _qp(actor)
        if mpc is None:
            return {}
        sizes = {name: x for name in available(mpc) if (x := self._cfg.search.get(name))}
        if not sizes:
            return {}
        actor.load_state_dict(self.kept.state_dict())
        loops, seed = self._cfg.search.loops, self._cfg.seed
        with tqdm(desc="search", total=loops, leave=False, disable=self._quiet or None) as bar:

            def costs(_: QPMPC, seed: int) -> Tensor:
                bar.update()
                return self._costs(actor, seed)

            metrics = search(mpc, costs, sizes, loops=loops, seed=seed)
        return {f"search/{name}": x for name, x in metrics.items()} | self._judge("search")

    def _costs(self, actor: Any, seed: int) -> Tensor:
        if self._cfg.gate == "plant":
            seed = int(np.random.SeedSequence([seed, self.compared]).generate_state(1)[0])
        policy = in_closed_loop(actor, self._learner.n_preview)
        costs = evaluate(self._cfg, policy, self._physics, seed).costs
        self.compared += costs.numel()
        return costs.sum(0)

    def _member_costs(self, i: int, actor: Any, seed: int) -> Tensor:
        # An environment has a length of its own.
        steps = self._cfg.task.eval_steps or getattr(self._physics, "max_steps", 0)
        policy = in_closed_loop(actor, self._learner.n_preview)
        costs = plant_loop(policy, self._members[i], steps=steps, seed=seed).costs
        self.compared += costs.numel()
        return costs.sum(0)

    def keep(self, mpc: QPMPC) -> None:
        """Keep the policy of a QP, until a candidate costs less; a network stays what it is."""
        if self.mpc is not None:
            self.mpc.load_state_dict(mpc.state_dict())

    def release(self, learner: Learner) -> None:
        """Free the C of the policy that is kept, as the new ``learner``'s is."""
        self._learner = learner
        if self._gate is None:
            self.kept = learner.actor
        elif self.mpc is not None:
            self.mpc.release()

    def summary(self) -> dict[str, int]:
        """Return the numbers of candidates accepted and rejected, and of transitions for them.

        These are ``simulated``, ``alternated`` on the plant, or ``modelled`` on an ensemble.
        """
        if self._gate is None:
            return {}
        decisions = {"accepted": self._gate.accepted, "rejected": self._gate.rejected}
        return decisions | {COMPARED.get(self._cfg.gate, "simulated"): self.compared}

    def save(self, folder: Path) -> None:
        """Write the policy that is kept to best.pt; without a gate, the checkpoint has it."""
        if self._gate is None:
            return
        if self.mpc is not None:
            self.mpc.save(folder / BEST)
        else:
            save_file(folder / BEST, "network", {"policy": self.kept.state_dict()})

    def state_dict(self) -> dict[str, Any] | None:
        """Return the state of the gate; None without one."""
        if self._gate is None:
            return None
        return self._gate.state_dict() | {"simulated": self.compared}

    def load_state_dict(self, state: dict[str, Any] | None) -> None:
        """Load a `state_dict`."""
        if self._gate is not None and state is not None:
            self._gate.load_state_dict(state)
            self.compared = state["simulated"]


def _interval(cfg: DictConfig) -> int:
    return cfg.gate_interval or cfg.eval_interval


def _decisions(cfg: DictConfig) -> int:
    """Count the comparisons of a run, the one of the search included."""
    return math.ceil(cfg.updates / _interval(cfg)) + 1


def _qp(actor: Any) -> QPMPC | None:
    return next((part for part in actor.modules() if isinstance(part, QPMPC)), None)
