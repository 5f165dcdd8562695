"""The gate of a run: the policies that act and that are kept, compared on the plant."""

import math
from typing import Any

import numpy as np
from torch import Tensor

from torch_qpmpc.experiment.algorithms import Learner, evaluate
from torch_qpmpc.experiment.config import Config
from torch_qpmpc.experiment.tasks import AnyPlant
from torch_qpmpc.learning.gate import Gate
from torch_qpmpc.learning.operators import warm_policy
from torch_qpmpc.mpc.module import QPMPC

#: The most pairs of a comparison. A run's later ones need more, as they share one alpha.
PAIRS = 160
#: The values of gate with which only what is kept acts.
ACTING = ("act", "plant")
#: The rejections in a row after which the learner then restarts from what is kept.
PATIENCE = 3
#: Names of the transitions of comparisons, on a simulator and on the plant.
COMPARED = ("simulated", "alternated")


class RunGate:
    """The policies of a run: the learner's, and the best one that a `Gate` has accepted.

    With ``gate=true`` the learner's policy acts and learns as without a gate, and the gate decides
    which one is kept. With ``gate=act`` the policy that is kept acts, too, and the learner restarts
    from it after three rejections in a row. ``gate=plant`` does the same with closed loops that a
    plant can run, as no two of them have the same starts and disturbances.

    Attributes:
        kept: the policy that is evaluated and saved; without a gate, the learner's.
        compared: the number of transitions in closed loops of comparisons.
    """

    def __init__(self, cfg: Config, learner: Learner, physics: AnyPlant) -> None:
        self._cfg, self._learner, self._physics = cfg, learner, physics
        self._interval = cfg.gate_interval or cfg.eval_interval
        options: Any = {"seed": cfg.seed, "pairs": PAIRS, "bound": cfg.gate_bound}
        options["decisions"] = math.ceil(cfg.updates / self._interval) + 1
        options["patience"] = PATIENCE if cfg.gate in ACTING else None
        self._gate = Gate(learner.actor, self._costs, **options) if cfg.gate else None
        self.kept: Any = learner.actor if self._gate is None else self._gate.actor
        self.compared = 0

    @property
    def acting(self) -> Any:
        """The policy that collects transitions."""
        return self.kept if self._cfg.gate in ACTING else self._learner.actor

    @property
    def mpc(self) -> QPMPC:
        """The QP of the policy that is kept."""
        return self.kept.module

    def judge(self, update: int) -> dict[str, float]:
        """Keep the learner's policy if it costs less; return the scalars of the comparison.

        Judges each ``gate_interval`` updates and after the last one; without a gate, never.
        """
        if self._gate is None or (update != self._cfg.updates and update % self._interval):
            return {}
        test = self._gate.judge(self._learner.actor)
        names = ("accepted", "mean", "low", "high", "pairs")
        values = test.decision == "better", test.mean, *test.interval, test.pairs
        return {f"gate/{name}": float(x) for name, x in zip(names, values, strict=True)}

    def _costs(self, actor: Any, seed: int) -> Tensor:
        if self._cfg.gate == "plant":
            seed = int(np.random.SeedSequence([seed, self.compared]).generate_state(1)[0])
        costs = evaluate(self._cfg, warm_policy(actor.module), self._physics, seed).costs
        self.compared += costs.numel()
        return costs.sum(0)

    def summary(self) -> dict[str, int]:
        """Return the numbers of candidates accepted and rejected, and of transitions for them."""
        if self._gate is None:
            return {}
        decisions = {"accepted": self._gate.accepted, "rejected": self._gate.rejected}
        return decisions | {COMPARED[self._cfg.gate == "plant"]: self.compared}

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
