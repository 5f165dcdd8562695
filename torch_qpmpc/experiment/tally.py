"""Running sums of a run: costs, violations, QPs and seconds."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from typing import Any, Self

from numba.core.event import install_timer
from tensordict import TensorDictBase
from torch import Tensor

from torch_qpmpc.qp.pipeline.solve import SolveLog


@dataclass
class Stopwatch:
    """Seconds of one update: until its data were collected, and until its end."""

    began: float
    data: float = 0.0
    total: float = 0.0

    def collected(self) -> None:
        """End the collection; what follows is the learning."""
        self.data = time.perf_counter() - self.began

    def metrics(self) -> dict[str, float]:
        return {"time/collect": self.data, "time/update": self.total - self.data}


@dataclass
class Tally:
    """Running sums over the updates of a run.

    Attributes:
        update: the number of the last one.
        costs: the mean cost of a step, of each update.
        violation: of the states' bounds, summed over all steps.
        qps: counts of solves since the last row of metrics; ``unsolved``: failures before that.
        seconds: of training, without the compilation of kernels, once for an installation.
    """

    update: int = 0
    costs: list[float] = field(default_factory=list)
    violation: float = 0.0
    qps: SolveLog = field(default_factory=SolveLog)
    unsolved: int = 0
    seconds: float = 0.0

    @classmethod
    def from_state(cls, state: dict[str, Any]) -> Self:
        """The tally of a checkpoint, from `state`."""
        parts: dict[str, Any] = state | {"qps": SolveLog(**state["qps"])}
        return cls(**parts)

    def state(self) -> dict[str, Any]:
        """Plain numbers, for a checkpoint."""
        return asdict(self)

    @contextmanager
    def timed(self) -> Iterator[Stopwatch]:
        """Count the QPs of an update, and its seconds."""
        watch = Stopwatch(time.perf_counter())
        with self.qps, install_timer("numba:compile", self._leave_out):
            yield watch
        watch.total = time.perf_counter() - watch.began
        self.seconds += watch.total

    def _leave_out(self, seconds: float) -> None:
        """Subtract a compilation, as `timed` adds it with the rest."""
        self.seconds -= seconds

    def add(self, batch: TensorDictBase, violation: Tensor) -> None:
        """Count an update, with the batch that it collected, and the violation of each state."""
        self.update += 1
        self.costs.append(-batch["next", "reward"].mean().item())
        self.violation += violation.sum().item()

    def metrics(self) -> dict[str, float]:
        """The scalars of a row; those of the QPs count from the row before."""
        row = {"train/reward": -self.costs[-1], "train/violation": self.violation}
        row |= self.qps.metrics()
        self.unsolved, self.qps = self.unsolved + self.qps.unsolved, SolveLog()
        return row

    def summary(self) -> dict[str, float]:
        """The cost of learning itself: over all updates, and over the last tenth of them."""
        last = self.costs[-max(1, len(self.costs) // 10) :]
        return {
            "train_seconds": self.seconds,
            "train_cost": sum(self.costs) / len(self.costs),
            "train_cost_last_tenth": sum(last) / len(last),
            "train_violation": self.violation,
            "unsolved": self.unsolved + self.qps.unsolved,
        }
