"""Counts of the outcomes of a family, and the time of its slowest QP."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass, field, fields
from typing import Any

import torch
from torch import Tensor

from tests.campaign.families import Case
from tests.campaign.outcomes import finite_gradients, judge
from torch_qpmpc import QuadraticProgram, Status, solve_qp
from torch_qpmpc.qp.program import EVENT_SHAPES, UNKNOWN, broadcast
from torch_qpmpc.qp.solution import QPSolution

#: Largest allowed time of a QP in seconds of one core.
SLOW = 0.5


@dataclass
class Tally:
    """Counts, the largest ``error`` of certified QPs, and the seconds of the ``slowest``, alone."""

    count: int = 0
    certified: int = 0
    named: int = 0
    missed: int = 0
    wrong: int = 0
    not_finite: int = 0
    slow: int = 0
    error: float = 0.0
    slowest: float = 0.0
    seconds: float = 0.0
    suspect: tuple[float, Case] | None = field(default=None, repr=False)

    @property
    def failures(self) -> int:
        """The outcomes that must not occur; which QPs are `SLOW` depends on the machine."""
        return self.wrong + self.not_finite

    def add(self, case: Case, solver: str) -> list[str]:
        tensors = (*case.known.qp.tensors(), case.known.fixed)
        *theta, fixed = operands = tuple(x.detach().requires_grad_() for x in tensors)
        qp = QuadraticProgram(*theta, check_values=False)
        began = time.process_time()
        solution = solve(qp, fixed, solver)
        taken = time.process_time() - began
        outcome, finite = judge(case, solution), finite_gradients(solution, operands)
        # An empty batch counts as one certified QP.
        self.count += max(1, len(case.expected))
        self.certified += int(outcome.certified.sum()) + (not len(case.expected))
        for name in ("named", "missed", "wrong"):
            setattr(self, name, getattr(self, name) + int(getattr(outcome, name).sum()))
        self.not_finite += int((~finite).sum())
        if outcome.certified.any():
            self.error = max(self.error, float(outcome.error[outcome.certified].max()))
        if taken > SLOW:
            self.measure_alone(case, solver)
        elif self.suspect is None or taken > self.suspect[0]:
            self.suspect = (taken, case)
        lines = [
            f"QP {i} is {Status(int(case.expected[i])).name}, called "
            f"{Status(int(solution.status[i])).name}, error {float(outcome.error[i]):.0e}"
            for i in outcome.wrong.nonzero().flatten().tolist()
        ]
        return lines + [f"QP {i}: gradient" for i in (~finite).nonzero().flatten().tolist()]

    def settle(self, solver: str) -> None:
        """Measure the QPs of the slowest batch alone."""
        if self.suspect is not None:
            self.measure_alone(self.suspect[1], solver)
            self.suspect = None

    def measure_alone(self, case: Case, solver: str) -> None:
        for i in range(len(case.expected)):
            qp, fixed = alone(case, i)
            began = time.process_time()
            solve(qp, fixed, solver)
            taken = time.process_time() - began
            self.slow += taken > SLOW
            self.slowest = max(self.slowest, taken)

    def plus(self, other: Tally) -> Tally:
        parts = {f.name: getattr(self, f.name) + getattr(other, f.name) for f in fields(self)[:-1]}
        parts |= {
            name: max(getattr(self, name), getattr(other, name)) for name in ("error", "slowest")
        }
        return Tally(**parts)

    def record(self) -> dict[str, float]:
        return {name: value for name, value in asdict(self).items() if name != "suspect"}


def solve(qp: QuadraticProgram, fixed: Tensor, solver: str) -> QPSolution:
    """Solve by a solver's name; with "NAME, warm", from empty active sets."""
    name, _, warm = solver.partition(", ")
    start = None
    if warm:
        batch = broadcast(qp.batch_shape, fixed.shape[:-1])
        start = torch.full((*batch, qp.lb.shape[-1]), UNKNOWN, dtype=torch.int8)
    return solve_qp(qp, fixed, solver=name, on_failure="mask", warm_start=start)


def alone(case: Case, i: int) -> tuple[QuadraticProgram, Tensor]:
    qp = case.known.qp
    parts: dict[str, Any] = {
        name: tensor[i] if tensor.ndim > len(event) else tensor
        for (name, event), tensor in zip(EVENT_SHAPES.items(), qp.tensors(), strict=True)
    }
    return QuadraticProgram(**parts, check_values=False), case.known.fixed[i]
