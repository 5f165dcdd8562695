"""Solve and certify QPs (eq:qp2, eq:qp3): one strategy after the other, until all are certified.

Tensors become arrays once; all else is in float64, without autograd.
"""

from __future__ import annotations

import contextvars
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torch_qpmpc.errors import QPError, SolverError
from torch_qpmpc.qp.batching import broadcast, flatten_batch
from torch_qpmpc.qp.pipeline.arrays import (
    TOLERANCE,
    Array,
    BatchSolution,
    SoftQPs,
    indices,
    native_device,
    on_device,
    to_numpy,
    to_tensor,
)
from torch_qpmpc.qp.pipeline.batch import Programs, prepared_for
from torch_qpmpc.qp.pipeline.condensing import OTHER_ELIMINATIONS, Elimination
from torch_qpmpc.qp.pipeline.diagnosis import diagnose
from torch_qpmpc.qp.pipeline.refinement import refine
from torch_qpmpc.qp.program import NDIMS, QuadraticProgram, Status
from torch_qpmpc.qp.solvers import BACKENDS, Backend, BackendSolution, backend, fallbacks
from torch_qpmpc.qp.tracing import serially_if_forked

ON_FAILURE = ("raise", "warn", "mask")
Eliminate = Callable[[np.ndarray, int], Elimination | None]
#: Rejected solutions with a relative residual up to this are refined.
NEARLY = 1e-2
#: Up to this number, rejected QPs are refined one by one; of more, other eliminations come first.
FEW = 8
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
        >>> mpc = qm.QPMPC.of(2, 1, 5)
        >>> with qm.SolveLog() as log:
        ...     values = mpc.value(torch.zeros(8, 2))
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
        accepted = solution.residual[solution.accepted()]
        self.solves += len(solution.residual)
        self.unsolved += len(solution.residual) - len(accepted)
        self.iterations += int(solution.iterations.sum())
        self.residual = max(self.residual, float(accepted.max()) if len(accepted) else 0.0)
        self.seconds += seconds


_active_log: contextvars.ContextVar[SolveLog] = contextvars.ContextVar("log")


@serially_if_forked
def solve_now(*arguments: Any) -> BatchSolution:
    """Solve a batch, on the CPU or, with ``solver="torch"``, on the device of q.

    The ``arguments`` are H, q, c, C, b, G, lb, ub, w and ``fixed``; the active sets ``(*batch,
    n_g)`` of a warm start, or None; ``n_kept`` of `Programs.of`; ``solver`` and ``on_failure``.
    """
    *theta, fixed, start, n_kept, solver, on_failure = arguments
    q = theta[1]
    backend(solver)
    if on_failure not in ON_FAILURE:
        raise QPError.expected("on_failure", repr(on_failure), f"one of {', '.join(ON_FAILURE)}")
    device = native_device(q) if solver == "torch" else None
    try:
        programs, batch = Programs.of(*theta, fixed, n_kept=n_kept, device=device)
        if start is not None:
            start = flatten_batch(start.detach().to(q.device).expand(*batch, -1)).contiguous()
        sets = start.numpy(force=True) if start is not None and device is None else start
        solution = solve_programs(programs, solver, sets)
    except (MemoryError, RuntimeError) as error:
        # torch's allocator on the CPU reports a failure only in the message.
        failed = isinstance(error, MemoryError | torch.OutOfMemoryError)
        if not failed and "DefaultCPUAllocator" not in str(error):
            raise
        shapes = (x.shape[: x.ndim - n] for x, n in zip(theta, NDIMS, strict=True))
        count = broadcast(*shapes, fixed.shape[:-1]).numel()
        got = f"{count:,} QPs of n_z = {q.shape[-1]}"
        remedy = f"Solve the batch in chunks, with torch.split. The allocation failed: {error}."
        raise QPError.expected("batch", got, "as many as fit in memory", remedy) from error
    if on_failure != "mask" and not solution.all_accepted:
        _report(solution, batch, on_failure)

    outputs = BatchSolution._make(map(to_tensor, solution))
    if len(batch) == 1 and q.dtype == torch.float64 and q.device == outputs.value.device:
        return outputs

    def out(x: Tensor) -> Tensor:
        dtype = q.dtype if x.is_floating_point() else x.dtype
        return x.reshape((*batch, *x.shape[1:])).to(q.device, dtype)

    return BatchSolution._make(map(out, outputs))


def _report(solution: BatchSolution, batch: torch.Size, on_failure: str) -> None:
    statuses = torch.as_tensor(solution.status).cpu()
    failed = statuses.nonzero().squeeze(-1)
    reasons = []
    for status in Status:
        where = (statuses == status).nonzero().squeeze(-1)
        if status != Status.SOLVED and len(where):
            first = torch.unravel_index(where[0], batch) if batch else ()
            at = f", first at batch index {tuple(int(i) for i in first)}" if batch else ""
            reasons.append(f"{len(where)} {status.name}{at}: {status.explanation}")
    message = f"{len(failed)} of {len(statuses)} QPs have no certified solution. " + ". ".join(
        reasons
    )
    if on_failure == "raise":
        if (statuses[failed] == Status.INVALID_DATA).all():
            raise QPError(message)
        raise SolverError(message)
    warnings.warn(message, RuntimeWarning, stacklevel=2)


class AtRest:
    """QPs of a theta at rest, solved one after the other.

    What that does not solve, or the certificate rejects, is solved as any other QP. ``n_f`` is the
    number of fixed entries of z, ``n_kept`` that of `Programs.of`.
    """

    def __init__(self, qp: QuadraticProgram, n_f: int, n_kept: int, solver: str) -> None:
        data = [to_numpy(x.detach()) for x in qp.tensors()]
        self.prepared, self.solver = prepared_for(data, n_kept, None), solver
        self._active, programs = (
            np.zeros((1, qp.lb.shape[-1]), np.int8),
            self._of(np.zeros((1, n_f))),
        )
        # The certificate proves nothing without a convex cost.
        self._is_sound = programs.scaled().solvable() is None

    def solve(self, fixed: np.ndarray, warm: bool = True) -> BatchSolution:
        """Solve and certify the QP with the fixed entries ``(1, n_f)``, in float64.

        It starts from the last active set if it is ``warm``, else from the empty one.
        """
        self._active = self._active if warm else np.zeros_like(self._active)
        began, programs, log = time.perf_counter(), self._of(fixed), _active_log.get(None)
        if (solution := self._recalled(programs)) is None:
            solution = solve_programs(programs, self.solver)
            if not solution.status[0]:  # of one set, the solution is the same whatever led to it
                self._active = solution.active
                solution = self._recalled(programs) or solution
        elif log is not None:
            log.recalled += 1
            log.add(solution, time.perf_counter() - began)
        return solution

    def _recalled(self, programs: Programs) -> BatchSolution | None:
        """Return the certified solution of the last active set, corrected where needed, if any."""
        if not self._is_sound:
            return None
        solution, units = programs.scaled().recalled(self._active), self.prepared.units
        if units is not None:
            solution = units.restored(solution, programs.group)
            _refuted(*_in_own_lengths(programs, solution), programs.group)
        if max(solution.residual[0], solution.value_error[0]) > TOLERANCE:
            return None
        self._active = solution.active
        return solution

    def _of(self, fixed: np.ndarray) -> Programs:
        return Programs(self.prepared, np.zeros(1, np.int64), fixed)


class Strategy(NamedTuple):
    """One way to solve QPs: from their last active sets, or by a backend."""

    solve: Backend
    start: Array | None = None
    eliminate: Eliminate | None = None

    def prepared(self, programs: Programs) -> Programs | None:
        """Return the QPs with this elimination; None if it does not apply."""
        if self.eliminate is None:
            return programs
        C = programs.theta.C
        elimination = self.eliminate(C, programs.n_f) if C.size else None
        return None if elimination is None else programs.eliminated(elimination)

    def certified(self, programs: Programs) -> BatchSolution:
        """Return candidates, completed and certified; active sets that do not settle are none."""
        if self.start is not None:
            return programs.recalled(self.start)
        qps = programs.reduced_qps()
        solve = self.solve if qps.l.shape[-1] else _unconstrained
        return programs.recover(solve(qps).like(programs.fixed), PASSES if self.eliminate else 0)


def strategies(solver: str, start: Array | None) -> list[Strategy]:
    """Return the ways to solve QPs, each for those that the ones before do not solve.

    Other eliminations follow the solver, for ill-conditioned QPs, and then other solvers.
    """
    own = backend(solver)
    last_sets = [] if start is None else [Strategy(own, start)]
    eliminations = [Strategy(BACKENDS["torch"], eliminate=way) for way in OTHER_ELIMINATIONS]
    return [*last_sets, Strategy(own), *eliminations, *map(Strategy, fallbacks(solver))]


def _unconstrained(qps: SoftQPs) -> BackendSolution:
    """Solve QPs without rows in closed form; the certificate rejects unbounded ones."""
    H, _, group, g, lam, _, _ = qps.in_torch()
    v = torch.einsum("bij,bj->bi", torch.linalg.pinv(H, hermitian=True)[group], -g)
    return BackendSolution(v, lam, torch.zeros_like(group))


def solve_programs(programs: Programs, solver: str, start: Array | None = None) -> BatchSolution:
    """Solve and certify B QPs; the status of an unsolved one is its diagnosis.

    ``start`` are active sets ``(B, n_g)`` of nearly equal QPs, see `Programs.recalled`.
    """
    began = time.perf_counter()
    log = _active_log.get(unused := SolveLog())
    units = programs.prepared.units
    if units is None:
        solution = _solved(programs, solver, start, log)
    else:
        scaled = programs.scaled()
        solution = units.restored(_solved(scaled, solver, start, log), scaled.group)
        solution = _confirmed(programs.on_cpu(), solver, solution.on_cpu(), log)
    if log is not unused:
        log.add(solution, time.perf_counter() - began)
    return solution


def _solved(
    programs: Programs,
    solver: str,
    start: Array | None,
    log: SolveLog,
    solution: BatchSolution | None = None,
) -> BatchSolution:
    """Try one strategy after the other on the QPs without a certified solution.

    The first runs on their device. Up to `FEW` QPs that the solver leaves are refined and diagnosed
    one by one; of more, those that the other eliminations leave, which solve whole batches. A QP
    that is proved to have no solution is not tried again. ``solution`` holds candidates that were
    rejected before.
    """
    status = np.full(len(programs), int(Status.NOT_CONVERGED))
    todo = programs.solvable() if solution is None else np.arange(len(programs))
    if solution is None and todo is not None:
        status[:] = Status.INVALID_DATA
        solution, status[todo] = programs.unsolved(status), Status.NOT_CONVERGED
        todo = on_device(todo, programs.prepared.device)
        start = None if start is None else start[todo]
    ways = strategies(solver, start)
    own = singly = ways[start is not None]
    for way in ways:
        if todo is not None and not len(todo):
            break
        rest = way.prepared(programs if todo is None else programs.take(todo))
        if rest is not None:
            answer = way.certified(rest)
            if way.start is not None:
                log.recalled += int(answer.accepted().sum())
            if todo is None and answer.all_accepted:
                return answer
            if way.start is None and not answer.all_accepted:  # what follows needs the CPU
                programs, answer = programs.on_cpu(), answer.on_cpu()
                solution = solution and solution.on_cpu()
                todo = None if todo is None else to_numpy(todo)
            if solution is None or todo is None:
                solution, todo = answer, indices(~answer.accepted())
            else:  # the last candidate is refined, whatever was refined before
                (solution.put if way is ways[-1] else solution.improve)(todo, answer)
                todo = todo[~solution.accepted()[todo]]
        assert solution is not None
        assert todo is not None
        if way is own and len(todo) > FEW:
            log.fallback += len(todo)
            singly = [way for way in ways if way.eliminate is not None][-1]
        last = way is ways[-1]
        if (way is singly or last) and len(todo):
            near = todo if last else todo[solution.residual[todo] <= NEARLY]
            log.refined += len(near)
            refine(programs, solution, near, last)
            todo = todo[~solution.accepted()[todo]]
        if way is singly and len(todo):
            log.fallback += len(todo) if way is own else 0
            status[todo] = diagnose(programs.take(todo))
            todo = todo[status[todo] == Status.NOT_CONVERGED]
    assert solution is not None
    if not solution.all_accepted:
        programs, solution = programs.on_cpu(), solution.on_cpu()
        solution.clear(np.flatnonzero(~solution.accepted()), programs.unsolved(status))
    return solution


def _in_own_lengths(programs: Programs, solution: BatchSolution) -> tuple[Programs, BatchSolution]:
    """Return QPs and solutions in the numbers that are certified, with the same errors.

    They are the original ones; of numbers whose columns differ by orders of magnitude, those in
    lengths of z that follow from the matrices: the error of a value has no bound without.
    """
    if (lengths := programs.prepared.lengths) is None:
        return programs, solution
    return programs.equilibrated(), lengths.inverse().restored(solution, programs.group)


def _confirmed(
    programs: Programs, solver: str, solution: BatchSolution, log: SolveLog
) -> BatchSolution:
    """Certify scaled solutions in the original numbers, too; solve second those that fail.

    The units depend on the bounds. A bound that is far from every solution, such as a large number
    in place of inf, makes them so large that a certificate in these units misses errors.
    """
    units, accepted = programs.prepared.units, np.flatnonzero(solution.accepted())
    assert units is not None
    scaled, lengths = programs.scaled(), programs.prepared.lengths
    programs, solution = _in_own_lengths(programs, solution)
    if lengths is not None:
        units = units._replace(length=units.length / lengths.length)
    rejected = _refuted(programs, solution, accepted)
    if len(rejected):
        part, second = programs.take(rejected), SolveLog()
        again = _solved(part, solver, None, second, solution.at(rejected))
        solution.put(rejected, again)
        in_units = units.inverse().restored(solution, programs.group)
        unsure = _refuted(scaled, in_units, rejected[again.accepted()])
        failed = refine(programs, solution, unsure)
        solution.put(failed, programs.unsolved(Status.NOT_CONVERGED).at(failed))
        log.refined += second.refined + len(unsure)
    return solution if lengths is None else lengths.restored(solution, programs.group)


def _refuted(programs: Programs, solution: BatchSolution, which: np.ndarray) -> np.ndarray:
    """Raise the residuals at the indices ``which`` to the QPs' own; return those rejected."""
    if not len(which):
        return which
    solved = solution.at(which)
    part = programs if len(which) == len(programs) else programs.take(which)
    _, residual, error = part.certify(solved.z, solved.lam, solved.chi, solved.xi)
    solution.residual[which] = np.maximum(solved.residual, residual)
    solution.value_error[which] = np.maximum(solved.value_error, error)
    return which[(residual > TOLERANCE) | (error > TOLERANCE)]
