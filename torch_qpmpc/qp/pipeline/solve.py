"""QPs (eq:qp2, eq:qp3) and their certified solutions: condense, solve, certify, fall back."""

from __future__ import annotations

import contextvars
import time
from dataclasses import dataclass

import numpy as np
import torch

from torch_qpmpc.qp.pipeline.arrays import Array, of_group, on_device, to_numpy
from torch_qpmpc.qp.pipeline.batch import Programs, SoftQPs
from torch_qpmpc.qp.pipeline.batch_solution import TOLERANCE, BatchSolution, unsolved
from torch_qpmpc.qp.pipeline.certificate import certify, recover
from torch_qpmpc.qp.pipeline.condensing import OTHER_ELIMINATIONS
from torch_qpmpc.qp.pipeline.diagnosis import diagnose
from torch_qpmpc.qp.pipeline.polishing import refine
from torch_qpmpc.qp.pipeline.warm_start import try_active_sets
from torch_qpmpc.qp.program import Status
from torch_qpmpc.qp.solvers import BACKENDS, Backend, BackendSolution, backend, fallbacks

#: A rejected solution with a relative residual up to this is worth refining.
NEARLY = 1e-2
#: Steps of iterative refinement after an ill-conditioned elimination.
PASSES = 2


@dataclass
class SolveLog:
    """Counts what is solved inside a ``with`` block, by this thread.

    Example:
        >>> with SolveLog() as log:  # doctest: +SKIP
        ...     loss(batch)
        >>> log.solves, log.unsolved, log.seconds  # doctest: +SKIP
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
        """The scalars that training logs under ``qp/``."""
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
        """Count a batch."""
        accepted = solution.residual[solution.accepted()]
        self.solves += len(solution.residual)
        self.unsolved += len(solution.residual) - len(accepted)
        self.iterations += int(solution.iterations.sum())
        self.residual = max(self.residual, float(accepted.max()) if len(accepted) else 0.0)
        self.seconds += seconds


_active_log: contextvars.ContextVar[SolveLog] = contextvars.ContextVar("log")


def solve_programs(p: Programs, solver: str, start: Array | None = None) -> BatchSolution:
    """Solve and certify B QPs; what cannot be certified has a status that says why.

    Args:
        p: the QPs.
        solver: a backend's name, see `torch_qpmpc.qp.solvers`.
        start: active sets ``(B, n_g)`` of nearly these QPs, see `warm_start`.
    """
    began = time.perf_counter()
    log = _active_log.get(unread := SolveLog())
    units = p.prepared.units
    if units is None:
        solution = _solve(p, solver, start, log)
    else:
        scaled = _scaled(p)
        solution = units.restored(_solve(scaled, solver, start, log), scaled.group)
        solution = _settled(p.on_cpu(), solver, solution.on_cpu())
    if log is not unread:
        log.add(solution, time.perf_counter() - began)
    return solution


def _scaled(p: Programs) -> Programs:
    """The QPs in their own units."""
    prepared = p.prepared.scaled
    assert p.prepared.units is not None
    return Programs(prepared, p.group, p.fixed / of_group(p.prepared.units.length, p.group))


def _settled(p: Programs, solver: str, solution: BatchSolution) -> BatchSolution:
    """Certify solutions found in units in the QPs' own numbers, too; solve again what fails.

    Units follow from bounds, among others. Where a bound is far from every solution, as a large
    number in the place of none is, they are large, and a certificate in them misses errors.
    """
    units = p.prepared.units
    assert units is not None
    accepted = np.flatnonzero(solution.accepted())
    failed = accepted[_certify_at(p, solution, accepted)]
    if len(failed):
        part = p.take(failed)
        again = _solve(part, solver, None, SolveLog())
        solution.put(failed, again)
        in_units = units.inverse().restored(solution, p.group)
        failed = failed[solution.accepted()[failed]]
        failed = failed[_certify_at(_scaled(p), in_units, failed)]
        solution.put(failed, _unsolved(p.take(failed), Status.NOT_CONVERGED))
    return solution


def _certify_at(p: Programs, solution: BatchSolution, at: np.ndarray) -> np.ndarray:
    """Raise the residuals at the indices ``at`` to what they are here; True where too much."""
    found = solution.at(at)
    _, residual = certify(p.take(at), found.z, found.lam, found.chi, found.xi)
    solution.residual[at] = np.maximum(found.residual, residual)
    return residual > TOLERANCE


def _solve(p: Programs, solver: str, start: Array | None, log: SolveLog) -> BatchSolution:
    """Solve with the chosen solver, and in other ways what its certificate rejects."""
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
    """The indices of QPs with valid data and a convex cost; None for all.

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
    p: Programs, solve: Backend, start: Array | None, log: SolveLog, passes: int = 0
) -> BatchSolution:
    """Solve once, from the active sets ``start`` if there are any, and certify the result."""
    qps = p.reduced_qps()
    settled = None
    if not qps.l.shape[-1]:
        found = _unconstrained(qps).like(p.fixed)
    elif start is None:
        found = solve(qps).like(p.fixed)
    else:
        found, settled = try_active_sets(p, qps, start)
        _replace(found, ~settled, qps, solve)
    solution = recover(p, found, passes)
    if settled is not None:
        kept = settled & solution.accepted()
        log.recalled += int(kept.sum())
        if _replace(found, settled & ~kept, qps, solve):
            solution = recover(p, found, passes)
    if not solution.all_accepted:
        solution = _refined(p.on_cpu(), qps.in_numpy(), found, solution.on_cpu(), passes)
    return solution


def _replace(found: BackendSolution, where: Array, qps: SoftQPs, solve: Backend) -> bool:
    """Solve the QPs ``where`` ``(B,)`` anew, in place; False if there are none."""
    if not where.any():
        return False
    found.put(where, solve(qps.take(where)).like(where))
    return True


def _refined(
    p: Programs, qps: SoftQPs, found: BackendSolution, solution: BatchSolution, passes: int
) -> BatchSolution:
    """Refine what the certificate rejects by little."""
    nearly = ~solution.accepted() & (solution.residual <= NEARLY)
    if nearly.any():
        second = recover(p, refine(qps, found.like(p.fixed), np.flatnonzero(nearly)), passes)
        better = np.flatnonzero(second.residual < solution.residual)
        solution.put(better, second.at(better))
    return solution


def _unconstrained(qps: SoftQPs) -> BackendSolution:
    """Solve QPs without rows in closed form; the certificate rejects what is unbounded."""
    H, _, group, g, lam, _, _ = qps.in_torch()
    v = torch.einsum("bij,bj->bi", torch.linalg.pinv(H, hermitian=True)[group], -g)
    return BackendSolution(v, lam, torch.zeros_like(group))


def _solved_otherwise(
    p: Programs, solution: BatchSolution, solver: str, log: SolveLog
) -> BatchSolution:
    """Diagnose what is not accepted, and solve it in other ways unless it has no solution.

    Other eliminations of C z = b come first, for ill-conditioned ones, then the other solvers.
    """
    todo = np.flatnonzero(~solution.accepted())
    log.fallback += len(todo)
    part = p.take(todo)
    failed = _unsolved(part, Status.NOT_CONVERGED)._replace(residual=solution.residual[todo])
    solution.put(todo, failed._replace(status=diagnose(part)))
    todo = todo[solution.status[todo] == Status.NOT_CONVERGED]
    ways = [(eliminate, BACKENDS["torch"], PASSES) for eliminate in OTHER_ELIMINATIONS]
    for eliminate, solve, passes in (*ways, *((None, other, 0) for other in fallbacks(solver))):
        if not len(todo):
            break
        part = p.take(todo)
        if eliminate is not None:
            elimination = eliminate(part.theta.C, part.n_f) if part.theta.C.size else None
            if elimination is None:
                continue
            prepared = part.prepared.eliminated(elimination, part.n_f)
            part = Programs(prepared, part.group, part.fixed)
        found = _attempt(part, solve, None, log, passes)
        accepted = found.accepted()
        solution.put(todo[accepted], found.at(accepted))
        todo = todo[~accepted]
        solution.residual[todo] = found.residual[~accepted]
    return solution


def _unsolved(p: Programs, status: Status) -> BatchSolution:
    _, C, G, q, *_ = p.theta
    return unsolved(p.fixed, q.shape[-1], C.shape[1], G.shape[1], status)
