"""What a run adds up over its updates: costs, violations, QPs and seconds."""

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

    began: float = field(default_factory=time.perf_counter)
    data: float = 0.0
    total: float = 0.0

    def collected(self) -> None:
        """End the collection; what follows is the learning."""
        self.data = time.perf_counter() - self.began

    def metrics(self) -> dict[str, float]:
        return {"time/collect": self.data, "time/update": self.total - self.data}


@dataclass
class Tally:
    """What a run adds up.

    Attributes:
        update: how many there have been.
        costs: the mean cost of a step, of each update.
        violation: of the states' bounds, summed over all steps.
        qps: what has been solved since the last row of metrics; ``unsolved``, before that.
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
        """Return to what `state` was called on."""
        parts: dict[str, Any] = state | {"qps": SolveLog(**state["qps"])}
        return cls(**parts)

    def state(self) -> dict[str, Any]:
        """Plain numbers, for a checkpoint."""
        return asdict(self)

    @contextmanager
    def timed(self) -> Iterator[Stopwatch]:
        """Count the QPs of an update, and its seconds."""
        watch = Stopwatch()
        with self.qps, install_timer("numba:compile", self._leave_out):
            yield watch
        watch.total = time.perf_counter() - watch.began
        self.seconds += watch.total

    def _leave_out(self, seconds: float) -> None:
        """Subtract a compilation, which `timed` is going to add."""
        self.seconds -= seconds

    def add(self, batch: TensorDictBase, violation: Tensor) -> None:
        """Count an update, with the batch that it collected, and the violation of each state."""
        self.update += 1
        self.costs.append(-batch["next", "reward"].mean().item())
        self.violation += violation.sum().item()

    def metrics(self) -> dict[str, float]:
        """The scalars since the last call, which begin anew."""
        row = {"train/reward": -self.costs[-1], "train/violation": self.violation}
        row |= self.qps.metrics()
        self.unsolved, self.qps = self.unsolved + self.qps.unsolved, SolveLog()
        return row

    def summary(self) -> dict[str, float]:
        """What learning itself cost: over all updates, and over the last tenth of them."""
        last = self.costs[-max(1, len(self.costs) // 10) :]
        return {
            "train_seconds": self.seconds,
            "train_cost": sum(self.costs) / len(self.costs),
            "train_cost_last_tenth": sum(last) / len(last),
            "train_violation": self.violation,
            "unsolved": self.unsolved + self.qps.unsolved,
        }
