"""Solve and certify QPs (eq:qp2, eq:qp3): one step after the other, until all are certified.

Tensors become arrays once; all else is in float64, without autograd.
"""

from __future__ import annotations

import contextvars
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torch_qpmpc.errors import QPError, SolverError
from torch_qpmpc.qp.batching import flatten_batch
from torch_qpmpc.qp.pipeline.arrays import BatchSolution, SoftQPs
from torch_qpmpc.qp.pipeline.batch import Prepared, Programs, prepared_for
from torch_qpmpc.qp.pipeline.condensing import OTHER_ELIMINATIONS
from torch_qpmpc.qp.pipeline.diagnosis import diagnose
from torch_qpmpc.qp.pipeline.refinement import refine
from torch_qpmpc.qp.program import QuadraticProgram, Status, batch_shape, broadcast
from torch_qpmpc.qp.solvers import BACKENDS, Backend, BackendSolution, backend, interior_point
from torch_qpmpc.qp.solvers.interior_point import EARLY, LAST, MIDDLE, SETTLING

#: Backends that solve again, cold, what the chosen one leaves: they give up soonest, and solve all
#: that ProxQP solves. The last is the same for each: none decides whether there is a solution.
FALLBACKS = ("daqp", "torch")
ON_FAILURE = ("raise", "warn", "mask")
#: Rejected solutions with a relative residual up to this are refined.
NEARLY = 1e-2
#: Up to this number, rejected QPs are refined one by one; of more, other eliminations come first.
FEW = 8
#: So many matrices are condensed at once: more do not fit in the caches.
TOGETHER = 32
#: Number of iterative refinements after an alternative elimination.
PASSES = 2


@dataclass
class SolveLog:
    """Counts of the QPs that this thread solves inside a ``with`` block.

    Attributes:
        solves: QPs, solved or not.
        unsolved: QPs without a certified solution.
        fallback: QPs that their solver does not solve, nor a refinement in small batches.
        refined: rejected solutions that were refined in twice the working precision, which is slow.
        recalled: QPs solved by their warm start alone.
        iterations: the solvers' iterations.
        residual: largest residual of a certified solution.
        seconds: wall-clock time of the solves, in seconds.

    Example:
        >>> import torch, torch_qpmpc as qm
        >>> mpc = qm.QPMPC.from_model([[1.0]], [[1.0]], 5, stage_weight=[1.0, 0.1])
        >>> with qm.SolveLog() as log:
        ...     values = mpc.value(torch.zeros(8, 1))
        >>> log.solves, log.unsolved
        (8, 0)
    """

    solves: int = 0
    unsolved: int = 0
    fallback: int = 0
    refined: int = 0
    recalled: int = 0
    iterations: int = 0
    residual: float = 0.0
    seconds: float = 0.0

    def __enter__(self) -> SolveLog:
        self._token = _active_log.set(self)
        return self

    def __exit__(self, *_: object) -> None:
        _active_log.reset(self._token)

    def metrics(self) -> dict[str, float]:
        """Return the scalars that training logs, with iterations per QP."""
        return {
            "qp/solves": self.solves,
            "qp/unsolved": self.unsolved,
            "qp/fallback": self.fallback,
            "qp/recalled": self.recalled,
            "qp/iterations": self.iterations / max(self.solves, 1),
            "qp/residual": self.residual,
            "time/qp": self.seconds,
        }

    def add(self, solution: BatchSolution, seconds: float) -> None:
        """Count the ``solution`` of a batch, which took ``seconds``."""
        accepted = solution.residual[solution.status == Status.SOLVED]
        self.solves += len(solution.residual)
        self.unsolved += len(solution.residual) - len(accepted)
        self.iterations += int(solution.iterations.sum())
        self.residual = max(self.residual, float(accepted.max()) if len(accepted) else 0.0)
        self.seconds += seconds


_active_log: contextvars.ContextVar[SolveLog] = contextvars.ContextVar("log")


def solve_now(*arguments: Any) -> BatchSolution:
    """Solve a batch; with ``solver="torch"``, the device of q makes the first attempt.

    The ``arguments`` are H, q, c, C, b, G, lb, ub, w and ``fixed``; the active sets ``(*batch,
    n_g)`` of a warm start, or None; ``n_kept`` of `Programs.of`; ``solver`` and ``on_failure``.
    """
    *theta, fixed, start, n_kept, solver, on_failure = arguments
    q = theta[1]
    if on_failure not in ON_FAILURE:
        raise QPError.expected("on_failure", repr(on_failure), f"one of {', '.join(ON_FAILURE)}")
    device = accelerator(q) if solver == "torch" else None
    try:
        programs, batch = Programs.of(*theta, fixed, n_kept=n_kept)
        if start is not None:
            start = flatten_batch(start.expand(*batch, -1)).contiguous().numpy(force=True)
        solution = solve_programs(programs, solver, start, device)
    except (MemoryError, RuntimeError) as error:
        # torch's allocator on the CPU reports a failure only in the message.
        failed = isinstance(error, MemoryError | torch.OutOfMemoryError)
        if not failed and "DefaultCPUAllocator" not in str(error):
            raise
        count = broadcast(batch_shape(theta), fixed.shape[:-1]).numel()
        got = f"{count:,} QPs of n_z = {q.shape[-1]}"
        remedy = f"Solve the batch in chunks, with torch.split. The allocation failed: {error}."
        raise QPError.expected("batch", got, "as many as fit in memory", remedy) from error
    if on_failure != "mask" and solution.status.any():
        report(solution.status, batch, on_failure)

    outputs = BatchSolution._make(map(torch.from_numpy, solution))
    if len(batch) == 1 and q.dtype == torch.float64 and q.device == outputs.value.device:
        return outputs

    def out(x: Tensor) -> Tensor:
        dtype = q.dtype if x.is_floating_point() else x.dtype
        return x.reshape((*batch, *x.shape[1:])).to(q.device, dtype)

    return BatchSolution._make(map(out, outputs))


def accelerator(x: Tensor) -> torch.device | None:
    """Return the device of x; None if that is the CPU."""
    return x.device if x.is_cuda else None


def report(status: np.ndarray, batch: torch.Size, on_failure: str) -> None:
    """Raise or warn about the unsolved QPs of a batch, by their `Status` ``(B,)``."""
    unsolved, reasons = np.flatnonzero(status), []
    for kind in list(Status)[1:]:
        if len(where := np.flatnonzero(status == kind)):
            first = tuple(map(int, np.unravel_index(where[0], batch))) if batch else ()
            at = f", first at batch index {first}" if batch else ""
            reasons.append(f"{len(where)} {kind.name}{at}: {kind.explanation}")
    text = ". ".join(reasons)
    message = f"{len(unsolved)} of {len(status)} QPs have no certified solution. {text}"
    if on_failure == "raise":
        if (status[unsolved] == Status.INVALID_DATA).all():
            raise QPError(message)
        raise SolverError(message)
    warnings.warn(message, RuntimeWarning, stacklevel=2)


class AtRest:
    """QPs of a theta at rest, solved call by call.

    QPs that this leaves unsolved take the ordinary steps. ``n_f`` is the number of fixed entries of
    z, ``n_kept`` that of `Programs.of`.
    """

    def __init__(self, qp: QuadraticProgram, n_f: int, n_kept: int, solver: str) -> None:
        data = [x.numpy(force=True) for x in qp.tensors()]
        self.prepared, self.solver = prepared_for(data, n_kept), solver
        self._active = np.zeros((1, qp.lb.shape[-1]), np.int8)
        # The certificate proves nothing without a convex cost.
        self._is_sound = self.programs(np.zeros((1, n_f))).scaled().solvable() is None

    def solve(self, fixed: np.ndarray, warm: bool = True) -> BatchSolution:
        """Solve QPs with the fixed entries ``(B, n_f)``, from the last active sets if ``warm``."""
        if not warm or len(fixed) != len(self._active):
            self._active = np.zeros((len(fixed), self._active.shape[1]), np.int8)
        began, programs, log = time.perf_counter(), self.programs(fixed), _active_log.get(None)
        if (solution := self._recalled(programs)) is None:
            solution = solve_programs(programs, self.solver)
            if not any(solution.status):  # of one set, the solution is the same whatever led to it
                self._active = solution.active
                solution = self._recalled(programs) or solution
        elif log is not None:
            log.recalled += len(fixed)
            log.add(solution, time.perf_counter() - began)
        return solution

    def _recalled(self, programs: Programs) -> BatchSolution | None:
        """Return certified solutions of the last active sets, if these settle."""
        if not self._is_sound:
            return None
        solution, units = programs.scaled().recalled(self._active), self.prepared.units
        if units is not None:
            solution = units.restored(solution, programs.group)
        if any(solution.status):
            return None
        self._active = solution.active
        return solution

    def programs(self, fixed: np.ndarray) -> Programs:
        """Return the QPs with these fixed entries."""
        return Programs(self.prepared, np.zeros(len(fixed), np.int64), fixed)


#: A step maps QPs without a certified solution, and their best candidates so far, to candidates;
#: backends ignore these, which the first has not.
Step = Callable[[Programs, Any], BatchSolution]


def solve_programs(
    programs: Programs,
    solver: str,
    start: np.ndarray | None = None,
    device: torch.device | None = None,
) -> BatchSolution:
    """Solve and certify B QPs; the status of an unsolved one is its diagnosis.

    ``start`` are active sets ``(B, n_g)`` of nearly equal QPs, see `Programs.recalled`; a
    ``device`` makes the first attempt.
    """
    if (count := max(map(len, programs.prepared.theta[:3]))) > TOGETHER:
        solution = programs.unsolved(Status.NOT_CONVERGED)
        for index in np.array_split(programs.group.argsort(kind="stable"), -(-count // TOGETHER)):
            own = None if start is None else start[index]
            solution.put(index, solve_programs(programs.take(index), solver, own, device))
        return solution
    began, log = time.perf_counter(), _active_log.get(unused := SolveLog())
    steps = steps_of(solver, log, len(programs.group), start is not None, device)
    if (units := programs.prepared.units) is None:
        solution = _solved(programs, steps, start)
    else:
        scaled = programs.scaled()
        solution = units.restored(_solved(scaled, steps, start), scaled.group)
    if log is not unused:
        log.add(solution, time.perf_counter() - began)
    return solution


def _solved(programs: Programs, steps: list[Step], start: np.ndarray | None) -> BatchSolution:
    """Take the steps until each QP has a certified solution, or a proof that it has none."""
    count, solution, solvable = len(programs.group), None, programs.solvable()
    todo = np.arange(count) if solvable is None else solvable
    if solvable is not None or start is not None:
        solution = programs.unsolved(Status.INVALID_DATA)
        solution.status[todo] = Status.NOT_CONVERGED
        solution.active[:] = solution.active if start is None else start
    for step in steps:
        if not len(todo):
            break
        if solution is None:  # the first step needs no candidates
            solution = step(programs, None)
        elif len(todo) == count:
            solution.improve(todo, step(programs, solution))
        else:
            solution.improve(todo, step(programs.take(todo), solution.at(todo)))
        todo = todo[solution.status[todo] == Status.NOT_CONVERGED]
    if solution is None:
        return programs.unsolved(Status.NOT_CONVERGED)
    if len(unsolved := np.flatnonzero(solution.status)):
        errors = {"residual": solution.residual, "value_error": solution.value_error}
        blank = programs.unsolved(solution.status)._replace(**errors)
        solution.put(unsolved, blank.at(unsolved))
    return solution


def steps_of(
    solver: str, log: SolveLog, count: int, warm: bool = False, device: torch.device | None = None
) -> list[Step]:
    """Return the steps of a solve of ``count`` QPs, each for those that the ones before leave.

    Up to `FEW` QPs that the solver leaves are refined one by one at once; more of them after other
    eliminations, which solve whole batches, but cost more than a diagnosis.
    """
    fallbacks = (name for name in FALLBACKS if name != solver or name == FALLBACKS[-1])
    solves = BACKENDS.get(solver) or backend(solver), *map(BACKENDS.__getitem__, fallbacks)
    first, *others, last = map(backed, solves)
    refined = partial(_refined, log)
    return [
        *([partial(_warm, log)] if warm else []),
        *([_recalled] if solver == "daqp" and count > 1 else []),
        *([partial(_early, device)] if solver == "torch" else []),
        first,
        partial(_if_few, refined),
        partial(_counted, log),
        _recalled,
        _diagnosed,
        *(partial(_eliminated, way) for way in (*OTHER_ELIMINATIONS, None)),
        refined,
        *(step for other in others for step in (other, refined)),
        partial(_refined_last, log, last),
    ]


def backed(solve: Backend, passes: int = 0) -> Step:
    """Return the step of a backend, see `Programs.recover`."""

    def step(programs: Programs, _: Any) -> BatchSolution:
        qps = programs.reduced_qps()
        run = solve if qps.l.shape[-1] else _unconstrained
        return programs.recover(qps.in_own_units(run), passes)

    return step


def _early(device: torch.device | None, programs: Programs, best: BatchSolution) -> BatchSolution:
    """Solve by the interior point until it shows the active sets, and from these."""
    solve = partial(interior_point.solve, device=device or "cpu", target=EARLY)
    answer = backed(solve)(programs, best)
    recalled = programs.recalled(answer.active)._replace(iterations=answer.iterations)
    answer.improve(np.arange(len(programs)), recalled)
    return answer


def _recalled(programs: Programs, best: BatchSolution | None) -> BatchSolution:
    """Solve from the candidates' active sets, or from those of similar QPs."""
    return programs.recalled((best or programs.unsolved(Status.NOT_CONVERGED)).active)


def _warm(log: SolveLog, programs: Programs, best: BatchSolution) -> BatchSolution:
    answer = _recalled(programs, best)
    log.recalled += int((answer.status == Status.SOLVED).sum())
    return answer


def _refined(log: SolveLog, programs: Programs, best: BatchSolution) -> BatchSolution:
    """Refine near misses."""
    near = np.flatnonzero(best.residual <= NEARLY)
    log.refined += len(near)
    refine(programs, best, near)
    return best


def _refined_last(
    log: SolveLog, step: Step, programs: Programs, best: BatchSolution
) -> BatchSolution:
    """Refine the candidates of a step, whatever was refined before, and however large."""
    answer = step(programs, best)
    left = np.flatnonzero(answer.status)
    log.refined += len(left)
    refine(programs, answer, left, last=True)
    return answer


def _counted(log: SolveLog, programs: Programs, best: BatchSolution) -> BatchSolution:
    log.fallback += len(programs)
    return best


def _diagnosed(programs: Programs, best: BatchSolution) -> BatchSolution:
    return best._replace(status=diagnose(programs))


def _if_few(step: Step, programs: Programs, best: BatchSolution) -> BatchSolution:
    return step(programs, best) if len(programs) <= FEW else best


def _eliminated(eliminate: Any, programs: Programs, best: BatchSolution) -> BatchSolution:
    """Solve with another elimination of C z = b, if it applies."""
    other = programs
    if eliminate is not None:
        C = programs.theta.C
        prepared = Prepared(programs.theta, programs.prepared.group, programs.n_f)
        prepared.elimination = eliminate(C, programs.n_f) if C.size else None
        if prepared.elimination is None or not np.isfinite(prepared.elimination.T).all():
            return best
        other = Programs(prepared, programs.group, programs.fixed)
    answer, every = backed(BACKENDS["torch"], PASSES)(other, best), np.arange(len(programs))
    for target in (EARLY, MIDDLE, LAST):
        if not answer.status.any():
            break
        solve = partial(interior_point.solve, target=target, steps=SETTLING)
        answer.improve(every, backed(solve, PASSES)(other, best))
    return answer


def _unconstrained(qps: SoftQPs) -> BackendSolution:
    """Solve QPs without rows in closed form; the certificate rejects unbounded ones."""
    inverse = np.linalg.pinv(qps.H, hermitian=True)[qps.group]
    return BackendSolution((inverse @ -qps.g[:, :, None])[:, :, 0], qps.l, np.zeros_like(qps.group))
