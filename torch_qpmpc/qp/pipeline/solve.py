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
from torch_qpmpc.qp.pipeline.batch import Programs
from torch_qpmpc.qp.pipeline.condensing import OTHER_ELIMINATIONS, Elimination
from torch_qpmpc.qp.pipeline.diagnosis import diagnose
from torch_qpmpc.qp.pipeline.refinement import refine
from torch_qpmpc.qp.program import NDIMS, Status
from torch_qpmpc.qp.solvers import BACKENDS, Backend, BackendSolution, backend, fallbacks
from torch_qpmpc.qp.tracing import serial_if_forked

ON_FAILURE = ("raise", "warn", "mask")
Eliminate = Callable[[np.ndarray, int], Elimination | None]
#: Rejected solutions with a relative residual up to this are refined.
NEARLY = 1e-2
#: Number of iterative refinements after an alternative elimination.
PASSES = 2


@dataclass
class SolveLog:
    """Counts of the QPs that this thread solves inside a ``with`` block.

    Attributes:
        solves: QPs, solved or not.
        unsolved: QPs without a certified solution.
        fallback: QPs whose first solution was rejected.
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


def solve_now(*arguments: Any) -> BatchSolution:
    """Solve a batch, on the CPU or, with ``solver="torch"``, on the device of q.

    Args:
        arguments: H, q, c, C, b, G, lb, ub and w of the `QuadraticProgram`; ``fixed``; the active
            sets ``(*batch, n_g)`` of a warm start, or None; ``n_kept`` of `Programs.of`; ``solver``
            and ``on_failure`` of `torch_qpmpc.solve_qp`.

    Raises:
        QPError: the solver or ``on_failure`` is unknown, the data are invalid, or the batch
            exceeds the memory.
        SolverError: with ``on_failure="raise"``, a QP has no certified solution.
    """
    *theta, fixed, start, n_kept, solver, on_failure = arguments
    q = theta[1]
    backend(solver)
    if on_failure not in ON_FAILURE:
        raise QPError.expected("on_failure", repr(on_failure), f"one of {', '.join(ON_FAILURE)}")
    device = native_device(q) if solver == "torch" else None
    try:
        with serial_if_forked():
            programs, batch = Programs.of(*theta, fixed, n_kept=n_kept, device=device)
            if start is not None:
                start = flatten_batch(start.detach().to(q.device).expand(*batch, -1)).contiguous()
            sets = start.numpy(force=True) if start is not None and device is None else start
            solution = solve_programs(programs, solver, sets)
    except (MemoryError, RuntimeError) as error:
        if not _is_out_of_memory(error):
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


def _is_out_of_memory(error: Exception) -> bool:
    """True for a failed allocation, which torch's CPU allocator reports only in the message."""
    kinds = (MemoryError, torch.OutOfMemoryError)
    return isinstance(error, kinds) or "DefaultCPUAllocator" in str(error)


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
        qps = programs.reduced_qps()
        if self.start is not None:
            candidate, settled = programs.try_active_sets(qps, self.start)
            solution = programs.recover(candidate)
            solution.residual[~settled] = np.inf
            return solution
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

    Args:
        programs: the QPs.
        solver: a backend's name, see `torch_qpmpc.qp.solvers`.
        start: active sets ``(B, n_g)`` of nearly equal QPs, see `Programs.try_active_sets`.
    """
    began = time.perf_counter()
    log = _active_log.get(unused := SolveLog())
    units = programs.prepared.units
    if units is None:
        solution = _solved(programs, solver, start, log)
    else:
        scaled = programs.scaled()
        solution = units.restored(_solved(scaled, solver, start, log), scaled.group)
        solution = _confirmed(programs.on_cpu(), solver, solution.on_cpu())
    if log is not unused:
        log.add(solution, time.perf_counter() - began)
    return solution


def _solved(programs: Programs, solver: str, start: Array | None, log: SolveLog) -> BatchSolution:
    """Try one strategy after the other on the QPs without a certified solution.

    The first runs on their device. What it leaves is diagnosed: a QP that is proved to have no
    solution is tried no further.
    """
    status = np.full(len(programs), int(Status.NOT_CONVERGED))
    todo, solution = programs.solvable(), None
    if todo is not None:
        status[:] = Status.INVALID_DATA
        solution, status[todo] = programs.unsolved(status), Status.NOT_CONVERGED
        todo = on_device(todo, programs.prepared.device)
        start = None if start is None else start[todo]
    ways = strategies(solver, start)
    own = ways[start is not None]  # what the solver itself leaves is diagnosed
    for way in ways:
        if todo is not None and not len(todo):
            break
        rest = way.prepared(programs if todo is None else programs.take(todo))
        if rest is None:
            continue
        answer = way.certified(rest)
        if way.start is not None:
            log.recalled += int(answer.accepted().sum())
        if todo is None and answer.all_accepted:
            return answer
        if way.start is None and not answer.all_accepted:  # what follows needs the CPU
            programs, rest, answer = programs.on_cpu(), rest.on_cpu(), answer.on_cpu()
            solution, last = solution and solution.on_cpu(), way is ways[-1]
            todo = None if todo is None else to_numpy(todo)
            rejected = ~answer.accepted() & (last | (answer.residual <= NEARLY))
            refine(rest, answer, np.flatnonzero(rejected), last)
        left = indices(~answer.accepted())
        if solution is None or todo is None:
            solution, todo = answer, left
        else:
            solution.put(todo, answer)
            todo = todo[left]
        if way is own and len(todo):
            log.fallback += len(todo)
            status[todo] = diagnose(programs.take(todo))
            todo = todo[status[todo] == Status.NOT_CONVERGED]
    assert solution is not None
    if not solution.all_accepted:
        programs, solution = programs.on_cpu(), solution.on_cpu()
        solution.clear(np.flatnonzero(~solution.accepted()), programs.unsolved(status))
    return solution


def _confirmed(programs: Programs, solver: str, solution: BatchSolution) -> BatchSolution:
    """Certify scaled solutions in the original numbers, too; solve second those that fail.

    Of numbers whose columns differ by orders of magnitude, those in lengths of z that follow from
    the matrices are taken as the original ones: the error of a value has no bound without.

    The units depend on the bounds. A bound that is far from every solution, such as a large number
    in place of inf, makes them so large that a certificate in these units misses errors.
    """
    units, accepted = programs.prepared.units, np.flatnonzero(solution.accepted())
    assert units is not None
    if (lengths := programs.prepared.lengths) is not None:
        scaled, programs = programs.scaled(), programs.equilibrated()
        solution = lengths.inverse().restored(solution, programs.group)
        units = units._replace(length=units.length / lengths.length)
    else:
        scaled = programs.scaled()
    failed = refine(programs, solution, _refuted(programs, solution, accepted))
    if len(failed):
        solution.put(failed, _solved(programs.take(failed), solver, None, SolveLog()))
        in_units = units.inverse().restored(solution, programs.group)
        failed = failed[solution.accepted()[failed]]
        failed = _refuted(scaled, in_units, failed)
        solution.put(failed, programs.unsolved(Status.NOT_CONVERGED).at(failed))
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
