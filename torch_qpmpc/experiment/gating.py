"""The gate of a run: the policy that acts, and paired comparisons on the run's plant."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torch_qpmpc.envs.closed_loop import ClosedLoop
from torch_qpmpc.experiment.algorithms import evaluate
from torch_qpmpc.experiment.checkpoint import write_whole
from torch_qpmpc.experiment.tasks import AnyPlant
from torch_qpmpc.learning.gate import Gate
from torch_qpmpc.learning.operators import in_closed_loop
from torch_qpmpc.learning.search import KNOBS, search
from torch_qpmpc.mpc.module import QPMPC

#: The file of the policy that acts, in a run's folder.
BEST = "best.pt"


class RunGate:
    """The policy that acts in a run: the learner's, or the one that a `Gate` lets act.

    Args:
        cfg: the run's configuration; ``gate`` switches the comparisons on.
        actor: the learner's actor, which shares its parameters.
        physics: the plant.

    Attributes:
        actor: the policy that acts.
    """

    def __init__(self, cfg: DictConfig, actor: Any, physics: AnyPlant) -> None:
        self._cfg, self._physics = cfg, physics
        self._gate = Gate(actor, self._costs, seed=cfg.seed) if cfg.gate else None
        self.actor: Any = actor if self._gate is None else self._gate.actor

    @property
    def mpc(self) -> QPMPC | None:
        """The QP of the policy that acts; None if it is a network."""
        return next((x for x in self.actor.modules() if isinstance(x, QPMPC)), None)

    def judge(self, candidate: TensorDictModuleBase) -> dict[str, float]:
        """Let ``candidate`` act if it costs less, and return the scalars of the comparison."""
        return {} if self._gate is None else self._gate.judge(candidate).metrics()

    def search(self, mpc: QPMPC, candidate: TensorDictModuleBase) -> dict[str, float]:
        """Search over ``cfg.search``'s scalars from the policy that acts, and `judge` the result.

        Args:
            mpc: the QP of the candidate.
            candidate: the learner's actor.
        """
        sizes = {name: x for name in KNOBS if (x := self._cfg.search[name])}
        if not sizes:
            return {}
        candidate.load_state_dict(self.actor.state_dict())
        loops, seed = self._cfg.search.loops, self._cfg.seed
        found = search(
            mpc, lambda _, seed: self._costs(candidate, seed), sizes, loops=loops, seed=seed
        )
        verdict = self.judge(candidate)
        return {
            **{f"search/{name}": x for name, x in found.items()},
            **{name.replace("gate/", "search/"): x for name, x in verdict.items()},
        }

    def release(self, candidate: TensorDictModuleBase) -> None:
        """Free the C of the policy that acts, as the candidate's is; without a gate it is one."""
        if self._gate is None:
            self.actor = candidate
        elif self.mpc is not None:
            self.mpc.release()

    def summary(self) -> dict[str, int]:
        """Return the numbers of candidates that were accepted and rejected."""
        if self._gate is None:
            return {}
        return {"accepted": self._gate.accepted, "rejected": self._gate.rejected}

    def save(self, folder: Path) -> None:
        """Write the policy that acts to best.pt; without a gate, the checkpoint has it."""
        if self._gate is None:
            return
        mpc = self.mpc
        structure, state = (None, self.actor) if mpc is None else (mpc.structure, mpc)
        buffer = io.BytesIO()
        torch.save({"structure": structure, "policy": state.state_dict()}, buffer)
        write_whole(folder / BEST, buffer.getbuffer())

    def state_dict(self) -> dict[str, Any] | None:
        """Return the state of a `Gate`; None without one."""
        return None if self._gate is None else self._gate.state_dict()

    def load_state_dict(self, state: dict[str, Any] | None) -> None:
        """Load a `state_dict`."""
        if self._gate is not None and state is not None:
            self._gate.load_state_dict(state)

    def closed_loop(self, actor: TensorDictModuleBase | None = None, **options: Any) -> ClosedLoop:
        """Evaluate ``actor``, by default the one that acts; ``options`` are those of `evaluate`."""
        policy = in_closed_loop(actor or self.actor, getattr(self._physics, "n_preview", 0))
        return evaluate(self._cfg, policy, self._physics, **options)

    def _costs(self, actor: Any, seed: int) -> Tensor:
        return self.closed_loop(actor, seed=seed).costs.sum(0)
