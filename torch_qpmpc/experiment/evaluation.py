"""A run's evaluation: J of the learned policy beside the start, the true model and the rivals.

All have the same starts and disturbances. All but the learned policy are evaluated once.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

from tensordict import TensorDictBase
from torch import Tensor
from tqdm import tqdm

from torch_qpmpc.envs.closed_loop import ClosedLoop
from torch_qpmpc.errors import QPError, printable
from torch_qpmpc.experiment.algorithms import evaluate
from torch_qpmpc.experiment.config import Config, find_task
from torch_qpmpc.experiment.rivals import IDENTIFICATION, Policy
from torch_qpmpc.experiment.tasks import AnyPlant, make_true_mpc
from torch_qpmpc.experiment.tasks.identified import nominal_mpcs
from torch_qpmpc.learning.operators import warm_policy
from torch_qpmpc.mpc.module import QPMPC


def closed_gap(J_start: float, J_final: float, J_true_model: float) -> float:
    """Return the share of the gap from the start to the true-model MPC that learning has closed.

    It is (J_start - J_final) / (J_start - J_true_model): 0 is no gain, 1 equals the true model. It
    is nan if the start is no worse than the true model, or a J is nan.

    Example:
        >>> closed_gap(J_start=100.0, J_final=60.0, J_true_model=50.0)
        0.8
    """
    gap = J_start - J_true_model
    return (J_start - J_final) / gap if gap > 0 else math.nan


def cost_text(J: float) -> str:
    """Return a cost with four significant digits, or all digits before the point.

    Example:
        >>> cost_text(20.9), cost_text(0.12345), cost_text(40827.4)
        ('20.90', '0.1235', '40827')
    """
    return f"{J:.0f}" if 999.95 <= abs(J) < math.inf else f"{J:#.4g}"


@dataclass(frozen=True)
class Evaluation:
    """Closed loops of a run's policies.

    Attributes:
        cfg, physics: the run's configuration and plant.
        loops: those of ``start``, ``learned``, which is kept, and, if they are there, of the last
            ``candidate`` and the ``true model``.
        rivals: J of the task's rivals by name, after `identify` also of `IDENTIFICATION`.
        missing: why the end of the run lacks a rival or a figure, by name.
        entries: what summary.json has of a start from data.
    """

    cfg: Config
    physics: AnyPlant
    loops: dict[str, ClosedLoop] = field(default_factory=dict)
    rivals: dict[str, float] = field(default_factory=dict)
    missing: dict[str, str] = field(default_factory=dict)
    entries: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def before(cls, cfg: Config, physics: AnyPlant, mpc: QPMPC, quiet: bool = True) -> Evaluation:
        """Evaluate before learning, when ``mpc`` is the start and what has been learned."""
        policies: dict[str, Callable[[], Policy]] = {"start": lambda: warm_policy(mpc)}
        if (true_mpc := make_true_mpc(cfg, physics)) is not None:
            policies["true model"] = lambda: warm_policy(true_mpc)
        rivals = find_task(cfg.task).rivals
        if cfg.rivals is not True:
            rivals = {name: make for name, make in rivals.items() if name in (cfg.rivals or ())}
        policies |= {name: partial(make, physics) for name, make in rivals.items()}
        loops = {}
        with tqdm(policies.items(), "first evaluation", leave=False, disable=quiet or None) as bar:
            for name, make in bar:
                bar.set_postfix_str(name)
                loops[name] = evaluate(cfg, make(), physics)
        first = loops["start"]  # of which a finite state has a cost, whatever comes later
        check_rewards(replace(first, costs=first.costs[:1]), physics)
        costs = {name: loops.pop(name).J for name in rivals}
        return cls(cfg, physics, {"start": first, "learned": first, **loops}, costs)

    def evaluate(self, policy: Callable[[Tensor], Tensor], name: str = "learned") -> None:
        """Evaluate what has been learned so far."""
        self.loops[name] = evaluate(self.cfg, policy, self.physics)

    def identify(self, data: Callable[[], Sequence[TensorDictBase]]) -> None:
        """Evaluate the rival `IDENTIFICATION` of logged steps, if ``cfg.rivals`` chooses it."""
        chosen = self.cfg.rivals
        if not (chosen if isinstance(chosen, bool) else IDENTIFICATION in chosen):
            return
        self.rivals[IDENTIFICATION] = math.nan
        with self.optional(f"rival {IDENTIFICATION}"):
            policies = map(warm_policy, nominal_mpcs(self.cfg, self.physics, data()))
            costs = (evaluate(self.cfg, policy, self.physics).J for policy in policies)
            self.rivals[IDENTIFICATION] = min(costs, key=lambda J: (math.isnan(J), J))

    @contextmanager
    def optional(self, name: str) -> Iterator[None]:
        """Go on without what a block makes for the end of a run, ``name``, and keep the reason."""
        try:
            yield
        except Exception as error:  # of any type: hours of learning do not end with a figure
            kind = "" if isinstance(error, QPError) else f"{type(error).__name__}: "
            self.missing[name] = printable(kind + str(error).strip().partition("\n")[0])

    def state_dict(self) -> dict[str, Any]:
        """Return all but the configuration and the plant, as tensors and plain values."""
        own = {name: getattr(self, name) for name in ("rivals", "missing", "entries")}
        return own | {"loops": {name: vars(loop) for name, loop in self.loops.items()}}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Load a `state_dict`."""
        loops = {name: ClosedLoop(**loop) for name, loop in state["loops"].items()}
        for name, part in {**state, "loops": loops}.items():
            getattr(self, name).update(part)

    def summary(self) -> dict[str, Any]:
        """Return J of the start, the learned and the true model, the closed gap and the rivals.

        ``J_best`` is that of the policy that is kept, ``J_final`` that of the last candidate.
        Missing values are nan.
        """
        loops = {"candidate": self.loops["learned"], **self.loops}
        summary: dict[str, Any] = {}
        J = {name: loop.J for name, loop in loops.items()}
        discounted = {name: loop.discounted(self.cfg.task.gamma) for name, loop in loops.items()}
        for suffix, costs in (("", J), ("_discounted", discounted)):
            names = ("start", "learned", "candidate", "true model")
            start, best, final, true = (costs.get(name, math.nan) for name in names)
            summary |= {f"J{suffix}_start": start, f"J{suffix}_best": best}
            summary |= {f"J{suffix}_final": final, f"J{suffix}_true_model": true}
            summary[f"closed_gap{suffix}"] = closed_gap(start, best, true)
        summary["episode_steps"], summary["episodes"] = loops["learned"].costs.shape
        return summary | {"rivals": dict(self.rivals)}


def check_rewards(loop: ClosedLoop, physics: AnyPlant) -> None:
    """Raise `QPError` if J of a closed loop is NaN."""
    if math.isnan(loop.J):
        raised = getattr(physics, "raised", None)
        remedy = "Return a number from the environment's step, or end the episode."
        remedy = f"The plant ends episodes by {raised[0]}." if raised else remedy
        got = f"NaN in {int(loop.costs.isnan().sum())} of {loop.costs.numel()} evaluated steps"
        raise QPError.expected("reward", got, "numbers", remedy)
