"""What became of the QPs of a family, counted, and how long the slowest of them takes alone."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass, field, fields

import torch
from torch import Tensor

from tests.campaign.families import Case
from tests.campaign.outcomes import finite_gradients, judge
from torch_qpmpc import QPSolution, QuadraticProgram, Status, solve_qp
from torch_qpmpc.qp.batching import broadcast
from torch_qpmpc.qp.program import EVENT_SHAPES, UNKNOWN

#: Seconds of one core that no QP may take.
SLOW = 0.5


@dataclass
class Tally:
    """Counts; ``error`` is a certified QP's largest, ``slowest`` in seconds, measured alone."""

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
        """What may not happen at all."""
        return self.wrong + self.not_finite + self.slow

    def add(self, case: Case, solver: str) -> list[str]:
        """Solve and count a case; a line on each failure."""
        tensors = (*case.known.qp.tensors(), case.known.fixed)
        *theta, fixed = operands = tuple(x.detach().requires_grad_() for x in tensors)
        qp = QuadraticProgram(*theta, check_values=False)
        began = time.process_time()
        solution = solve(qp, fixed, solver)
        taken = time.process_time() - began
        outcome, finite = judge(case, solution), finite_gradients(solution, operands)
        # An empty batch counts as one: it was handed back as it came.
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

    def cell(self) -> str:
        return f"{self.certified:,} / {self.named:,} / {self.missed:,} / {self.wrong:,}"


def solve(qp: QuadraticProgram, fixed: Tensor, solver: str) -> QPSolution:
    """By a solver's name; with "NAME, warm", from active sets of which nothing is known yet."""
    name, _, warm = solver.partition(", ")
    start = None
    if warm:
        batch = broadcast(qp.batch_shape, fixed.shape[:-1])
        start = torch.full((*batch, qp.lb.shape[-1]), UNKNOWN, dtype=torch.int8)
    return solve_qp(qp, fixed, solver=name, on_failure="mask", warm_start=start)


def alone(case: Case, i: int) -> tuple[QuadraticProgram, Tensor]:
    """The QP at ``i`` and its fixed entries."""
    qp = case.known.qp
    parts = {
        name: tensor[i] if tensor.ndim > len(event) else tensor
        for (name, event), tensor in zip(EVENT_SHAPES.items(), qp.tensors(), strict=True)
    }
    return QuadraticProgram(**parts, check_values=False), case.known.fixed[i]
