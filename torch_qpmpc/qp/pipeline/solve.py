"""Solve and certify QPs (eq:qp2, eq:qp3): condense, solve, certify, fall back.

Tensors become arrays once; all else is in float64, without autograd.
"""

from __future__ import annotations

import contextvars
import time
import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torch_qpmpc.errors import QPError, SolverError
from torch_qpmpc.qp.batching import broadcast, flatten_batch
from torch_qpmpc.qp.forking import serial_if_forked
from torch_qpmpc.qp.pipeline.arrays import (
    TOLERANCE,
    Array,
    BatchSolution,
    SoftQPs,
    native_device,
    on_device,
    per_qp,
    to_numpy,
    to_tensor,
    unsolved,
)
from torch_qpmpc.qp.pipeline.batch import Programs
from torch_qpmpc.qp.pipeline.condensing import OTHER_ELIMINATIONS
from torch_qpmpc.qp.pipeline.diagnosis import diagnose
from torch_qpmpc.qp.pipeline.refinement import refine
from torch_qpmpc.qp.program import NDIMS, Status
from torch_qpmpc.qp.solvers import BACKENDS, Backend, BackendSolution, backend, fallbacks

ON_FAILURE = ("raise", "warn", "mask")
#: The tensors of a `QPSolution`: value, z, chi, lam, xi, status, residual, value_error, iterations,
#: active.
Outputs = tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]
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


def solve_now(
    H: Tensor,
    q: Tensor,
    c: Tensor,
    C: Tensor,
    b: Tensor,
    G: Tensor,
    lb: Tensor,
    ub: Tensor,
    w: Tensor,
    fixed: Tensor,
    start: Tensor | None,
    n_kept: int,
    solver: str,
    on_failure: str,
) -> Outputs:
    """Solve a batch, on the CPU or, with ``solver="torch"``, on the device of q.

    Args:
        H, q, c, C, b, G, lb, ub, w: see `QuadraticProgram`.
        fixed, solver, on_failure: see `torch_qpmpc.solve_qp`.
        start: active sets ``(*batch, n_g)`` of a warm start.
        n_kept: see `Programs.of`.

    Raises:
        QPError: the solver or ``on_failure`` is unknown, the data are invalid, or the batch
            exceeds the memory.
        SolverError: with ``on_failure="raise"``, a QP has no certified solution.
    """
    backend(solver)
    if on_failure not in ON_FAILURE:
        raise QPError.expected("on_failure", repr(on_failure), f"one of {', '.join(ON_FAILURE)}")
    device = native_device(q) if solver == "torch" else None
    theta = (H, q, c, C, b, G, lb, ub, w)
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

    outputs: Any = tuple(map(to_tensor, solution))
    if len(batch) == 1 and q.dtype == torch.float64 and q.device == outputs[0].device:
        return outputs

    def out(x: Tensor) -> Tensor:
        dtype = q.dtype if x.is_floating_point() else x.dtype
        return x.reshape((*batch, *x.shape[1:])).to(q.device, dtype)

    return tuple(map(out, outputs))  # pyright: ignore[reportReturnType] - a tuple of ten


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


def solve_programs(p: Programs, solver: str, start: Array | None = None) -> BatchSolution:
    """Solve and certify B QPs; the status of an unsolved one is its diagnosis.

    Args:
        p: the QPs.
        solver: a backend's name, see `torch_qpmpc.qp.solvers`.
        start: active sets ``(B, n_g)`` of nearly equal QPs, see `Programs.try_active_sets`.
    """
    began = time.perf_counter()
    log = _active_log.get(unused := SolveLog())
    units = p.prepared.units
    if units is None:
        solution = _solve(p, solver, start, log)
    else:
        scaled = _scaled(p)
        solution = units.restored(_solve(scaled, solver, start, log), scaled.group)
        solution = _settled(p.on_cpu(), solver, solution.on_cpu())
    if log is not unused:
        log.add(solution, time.perf_counter() - began)
    return solution


def _scaled(p: Programs) -> Programs:
    """Return the QPs in their own units."""
    prepared = p.prepared.scaled
    assert p.prepared.units is not None
    return Programs(
        prepared, p.group, p.fixed / per_qp(p.prepared.units.length, p.group)[:, : p.n_f]
    )


def _settled(p: Programs, solver: str, solution: BatchSolution) -> BatchSolution:
    """Certify scaled solutions in the original numbers, too; solve second those that fail.

    The units depend on the bounds. A bound that is far from every solution, such as a large number
    in place of inf, makes them so large that a certificate in these units misses errors.
    """
    units = p.prepared.units
    assert units is not None
    accepted = np.flatnonzero(solution.accepted())
    failed = accepted[_certify_at(p, solution, accepted)]
    failed = refine(p, solution, failed)
    if len(failed):
        failing = p.take(failed)
        second = _solve(failing, solver, None, SolveLog())
        solution.put(failed, second)
        in_units = units.inverse().restored(solution, p.group)
        failed = failed[solution.accepted()[failed]]
        failed = failed[_certify_at(_scaled(p), in_units, failed)]
        solution.put(failed, _unsolved(p.take(failed), Status.NOT_CONVERGED))
    return solution


def _certify_at(p: Programs, solution: BatchSolution, at: np.ndarray) -> np.ndarray:
    """Raise the residuals at the indices ``at`` to those of ``p``; return the mask of failures."""
    if not len(at):
        return np.zeros(0, bool)
    solved = solution.at(at)
    part = p if len(at) == len(p) else p.take(at)
    _, residual, error = part.certify(solved.z, solved.lam, solved.chi, solved.xi)
    solution.residual[at] = np.maximum(solved.residual, residual)
    solution.value_error[at] = np.maximum(solved.value_error, error)
    return (residual > TOLERANCE) | (error > TOLERANCE)


def _solve(p: Programs, solver: str, start: Array | None, log: SolveLog) -> BatchSolution:
    """Solve with the chosen solver, and by fallbacks if the certificate rejects the result."""
    index = _solvable(p)
    if index is None:
        solution = _attempt(p, backend(solver), start, log)
        if not solution.all_accepted:
            solution = _solved_otherwise(p.on_cpu(), solution.on_cpu(), solver, log)
        return solution
    solution = _unsolved(p.on_cpu(), Status.INVALID_DATA)
    if len(index):
        start = None if start is None else start[on_device(index, p.prepared.device)]
        solution.put(index, _solve(p.take(index), solver, start, log).on_cpu())
    return solution


def _solvable(p: Programs) -> np.ndarray | None:
    """Return the indices of QPs with valid data and a convex cost; None for all.

    First-order conditions certify an optimum only where the QP is convex.
    """
    valid = p.valid()
    if valid is None:
        convex = p.prepared.convex(p.n_f)
        return None if convex is None else np.flatnonzero(convex[to_numpy(p.group)])
    index = np.flatnonzero(valid)
    rest = _solvable(p.take(index)) if len(index) else None
    return index if rest is None else index[rest]


def _attempt(
    p: Programs,
    solve: Backend,
    start: Array | None,
    log: SolveLog,
    passes: int = 0,
    nearly: float = NEARLY,
) -> BatchSolution:
    """Solve once, from the active sets ``start`` unless None, and certify the result.

    Rejected solutions with a residual up to ``nearly`` are refined.
    """
    qps = p.reduced_qps()
    settled = None
    if not qps.l.shape[-1]:
        claim = _unconstrained(qps).like(p.fixed)
    elif start is None:
        claim = solve(qps).like(p.fixed)
    else:
        claim, settled = p.try_active_sets(qps, start)
        _replace(claim, ~settled, qps, solve)
    solution = p.recover(claim, passes)
    if settled is not None:
        kept = settled & solution.accepted()
        log.recalled += int(kept.sum())
        if _replace(claim, settled & ~kept, qps, solve):
            solution = p.recover(claim, passes)
    if not solution.all_accepted:
        solution = solution.on_cpu()
        rejected = ~solution.accepted() & (solution.residual <= nearly)
        refine(p.on_cpu(), solution, np.flatnonzero(rejected), last=nearly == np.inf)
    return solution


def _replace(claim: BackendSolution, where: Array, qps: SoftQPs, solve: Backend) -> bool:
    """Solve the QPs in the mask ``where`` again, in place; return False if there are none."""
    if not where.any():
        return False
    claim.put(where, solve(qps.take(where)).like(where))
    return True


def _unconstrained(qps: SoftQPs) -> BackendSolution:
    """Solve QPs without rows in closed form; the certificate rejects unbounded ones."""
    H, _, group, g, lam, _, _ = qps.in_torch()
    v = torch.einsum("bij,bj->bi", torch.linalg.pinv(H, hermitian=True)[group], -g)
    return BackendSolution(v, lam, torch.zeros_like(group))


def _solved_otherwise(
    p: Programs, solution: BatchSolution, solver: str, log: SolveLog
) -> BatchSolution:
    """Diagnose rejected QPs, and solve those that may have a solution by fallbacks.

    Other eliminations of C z = b come first, for ill-conditioned QPs, then the other solvers.
    """
    todo = np.flatnonzero(~solution.accepted())
    log.fallback += len(todo)
    rest = p.take(todo)
    errors = {name: getattr(solution, name)[todo] for name in ("residual", "value_error")}
    failed = _unsolved(rest, Status.NOT_CONVERGED)._replace(**errors)
    solution.put(todo, failed._replace(status=diagnose(rest)))
    todo = todo[solution.status[todo] == Status.NOT_CONVERGED]
    ways = [(eliminate, BACKENDS["torch"], PASSES) for eliminate in OTHER_ELIMINATIONS]
    ways += [(None, other, 0) for other in fallbacks(solver)]
    for position, (eliminate, solve, passes) in enumerate(ways):
        if not len(todo):
            break
        rest = p.take(todo)
        if eliminate is not None:
            elimination = eliminate(rest.theta.C, rest.n_f) if rest.theta.C.size else None
            if elimination is None:
                continue
            prepared = rest.prepared.eliminated(elimination, rest.n_f)
            rest = Programs(prepared, rest.group, rest.fixed)
        nearly = NEARLY if position < len(ways) - 1 else np.inf
        second = _attempt(rest, solve, None, log, passes, nearly)
        accepted = second.accepted()
        solution.put(todo[accepted], second.at(accepted))
        todo = todo[~accepted]
        solution.residual[todo] = second.residual[~accepted]
        solution.value_error[todo] = second.value_error[~accepted]
    return solution


def _unsolved(p: Programs, status: Status) -> BatchSolution:
    _, C, G, q, *_ = p.theta
    return unsolved(p.fixed, q.shape[-1], C.shape[1], G.shape[1], status)
