"""Running totals of a run: costs, violations, QPs and seconds."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from typing import Any

from numba.core.event import install_timer
from tensordict import TensorDictBase
from torch import Tensor

from torch_qpmpc.qp.pipeline.solve import SolveLog


@dataclass
class Tally:
    """Running totals over the updates of a run.

    Attributes:
        update: number of the last update.
        costs: mean stage cost of each update.
        violation: violation of the state bounds, summed over all steps.
        qps: counts of solves since the last row of metrics.
        unsolved: number of unsolved QPs before that.
        seconds: training time without the compilation of kernels.
    """

    update: int = 0
    costs: list[float] = field(default_factory=list)
    violation: float = 0.0
    qps: SolveLog = field(default_factory=SolveLog)
    unsolved: int = 0
    seconds: float = 0.0

    def state_dict(self) -> dict[str, Any]:
        """Return the tally as plain numbers, for a checkpoint."""
        return asdict(self)

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Load a `state_dict`."""
        vars(self).update(state, qps=SolveLog(**state["qps"]))

    @contextmanager
    def timed(self) -> Iterator[list[float]]:
        """Count an update's QPs, and list its times: the begin, those that are added, the end."""

        def leave_out(compilation: float) -> None:
            self.seconds -= compilation

        times = [time.perf_counter()]
        with self.qps, install_timer("numba:compile", leave_out):
            yield times
        times.append(time.perf_counter())
        self.seconds += times[-1] - times[0]

    def add(self, batch: TensorDictBase, violation: Tensor) -> None:
        """Add an update with its collected batch and the violation of each state."""
        self.update += 1
        self.costs.append(-batch["next", "reward"].nanmean().item())
        self.violation += violation.sum().item()

    def metrics(self) -> dict[str, float]:
        """Return the scalars of a row; QPs are counted since the previous row."""
        row = {"train/reward": -self.costs[-1], "train/violation": self.violation}
        row |= self.qps.metrics()
        self.unsolved, self.qps = self.unsolved + self.qps.unsolved, SolveLog()
        return row

    def summary(self) -> dict[str, float]:
        """Return the totals: time, violation, unsolved QPs, and the mean cost during training."""
        last = self.costs[-max(1, len(self.costs) // 10) :]
        return {
            "train_seconds": self.seconds,
            "train_cost": sum(self.costs) / len(self.costs),
            "train_cost_last_tenth": sum(last) / len(last),
            "train_violation": self.violation,
            "unsolved": self.unsolved + self.qps.unsolved,
        }
