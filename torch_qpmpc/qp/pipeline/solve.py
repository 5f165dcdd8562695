"""QPs (eq:qp2, eq:qp3) and their certified solutions: condense, solve, certify, fall back."""

from __future__ import annotations

import contextvars
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torch_qpmpc.qp.kernels import per_sample
from torch_qpmpc.qp.pipeline.batch import FlatPrograms, SoftQPs
from torch_qpmpc.qp.pipeline.batch_solution import RawArrays, RawSolution, unsolved
from torch_qpmpc.qp.pipeline.certificate import TOLERANCE, Products, certify
from torch_qpmpc.qp.pipeline.condensing import VIOLATED, Reduced, condensed_for, other_eliminations
from torch_qpmpc.qp.pipeline.diagnosis import diagnose
from torch_qpmpc.qp.pipeline.polishing import refine
from torch_qpmpc.qp.pipeline.scaling import Units, units_of
from torch_qpmpc.qp.pipeline.warm_start import recall
from torch_qpmpc.qp.program import Status
from torch_qpmpc.qp.solvers import BACKENDS, Answer, Backend, backend, fallbacks

#: A rejected claim with a relative residual up to this is worth sharpening.
NEARLY = 1e-2
#: How often what an ill-conditioned elimination left over is solved for again.
PASSES = 2
#: Entries of a C that fits into a core's cache, with what else a QP has: larger ones are for BLAS.
CACHED = 2**15


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


_active_log: contextvars.ContextVar[SolveLog | None] = contextvars.ContextVar("log", default=None)


def solve_programs(
    programs: FlatPrograms, keep: int, solver: str, start: Tensor | None = None
) -> RawSolution:
    """Solve and certify B QPs; what cannot be certified has a status that says why.

    Args:
        programs: the QPs.
        keep: leading entries of z that the elimination of C z = b leaves alone, at least n_f.
        solver: a backend's name, see `torch_qpmpc.qp.solvers`.
        start: active sets ``(B, n_g)`` of nearly these QPs, see `warm_start`.
    """
    began = time.perf_counter()
    units = units_of(programs)
    chain = _Chain(programs if units is None else units.scaled(programs), keep)
    raw = chain.run(solver, start)
    if units is not None:
        raw = _settled(programs, units, keep, solver, units.restored(programs, raw))
    if (log := _active_log.get()) is not None:
        residual, worst = raw.residual, raw.worst
        if not raw.all_accepted:
            residual = residual[raw.accepted()]
            worst = float(residual.max()) if len(residual) else 0.0
        log.solves += len(programs)
        log.unsolved += len(programs) - len(residual)
        log.fallback += chain.rejected
        log.recalled += chain.recalled
        log.iterations += int(raw.iterations.sum())
        log.residual = max(log.residual, worst)
        log.seconds += time.perf_counter() - began
    return raw


def _settled(
    programs: FlatPrograms, units: Units, keep: int, solver: str, raw: RawSolution
) -> RawSolution:
    """Certify what was solved in ``units`` in the QPs' own numbers, too; solve again what fails.

    Units follow from bounds, among others. Where a bound is far from every solution, as a large
    number in the place of none is, they are large, and a certificate in them misses errors.
    """
    accepted = raw.accepted().nonzero().squeeze(-1)
    failed = accepted[_certify_at(programs, raw, accepted)]
    if len(failed):
        # Matrices of QPs that are left out may be invalid.
        again = _Chain(programs.take(failed).compacted(), keep).run(solver, None)
        raw.put(failed, again)
        scaled, again = units.scaled(programs), units.inverse.restored(programs, raw)
        failed = failed[raw.accepted()[failed]]
        failed = failed[_certify_at(scaled, again, failed)]
        raw.put(failed, unsolved(programs.take(failed), Status.NOT_CONVERGED))
    raw.worst = float(raw.residual.max()) if len(raw.residual) else 0.0
    return raw


def _certify_at(programs: FlatPrograms, raw: RawSolution, at: Tensor) -> Tensor:
    """Raise the residuals at the indices ``at`` to what they are here; where that is too much."""
    found = raw.at(at)
    judged = certify(programs.take(at), found.z, found.lam, found.chi, found.xi)
    raw.residual[at] = found.residual.maximum(judged.residual)
    return judged.residual > TOLERANCE


class _Chain:
    """One batch on its way from attempt to attempt: what one leaves, the next one gets.

    ``todo`` are the indices of the QPs that are still to be solved, or None for the whole batch.
    ``recalled`` counts what the active sets of ``start`` solved, ``rejected`` the claims of the
    chosen solver that the certificate rejected.
    """

    def __init__(self, programs: FlatPrograms, keep: int) -> None:
        valid = programs.valid()
        if valid is not None:
            programs = programs.without_nan()
        self.programs, self.keep = programs, keep
        self.recalled = self.rejected = 0
        # First-order conditions certify an optimum only where the QP is convex.
        self.reduced = self.reduced_for(programs)
        convex = self.reduced.convex
        if convex is not None:
            of_qps = convex[programs.group]
            valid = of_qps if valid is None else valid & of_qps
        self.raw: RawSolution | None = None
        self.todo: Tensor | None = None
        if valid is not None and not valid.all():
            self.raw = unsolved(programs)
            self.todo = valid.nonzero().squeeze(-1)
            self.raw.status[self.todo] = Status.NOT_CONVERGED

    def run(self, solver: str, start: Tensor | None) -> RawSolution:
        raw, todo = self.attempt(backend(solver), start)
        self.rejected = 0 if todo is None else len(todo)
        if todo is not None and self.rejected:
            raw.status[todo] = diagnose(self.part())
            # What is proved to have no solution need not be tried by every other solver.
            self.todo = todo[raw.status[todo] == Status.NOT_CONVERGED]
            self.attempt_otherwise()
            for other in fallbacks(solver):
                self.attempt(other)
        return raw

    def part(self) -> FlatPrograms:
        """The programs that are still to be solved."""
        return self.programs if self.todo is None else self.programs.take(self.todo)

    def reduced_for(self, part: FlatPrograms) -> Reduced:
        return condensed_for(part, self.keep).reduced(part)

    def attempt(
        self, solve: Backend, start: Tensor | None = None
    ) -> tuple[RawSolution, Tensor | None]:
        """Ask for what is still to be solved, and keep what the certificate accepts.

        With active sets ``start``, ``solve`` is only asked for what `recall` makes nothing of.
        Returns the solutions so far, and ``todo``: None if all were accepted at once.
        """
        if self.raw is not None and self.todo is not None and not len(self.todo):
            return self.raw, self.todo
        part = self.part()
        reduced = self.reduced if self.todo is None else self.reduced_for(part)
        return self._attempt(part, reduced, solve, start)

    def attempt_otherwise(self) -> None:
        """Attempt what is left with C z = b eliminated in other ways, for ill-conditioned ones."""
        if self.todo is None or not len(self.todo):
            return
        first, part = self.todo, self.part().compacted()
        for condensed in other_eliminations(part):
            left = part.take(torch.isin(first, self.todo).nonzero().squeeze(-1))
            # What is known of theta belongs to another elimination.
            left = replace(left, _known={})
            self._attempt(left, condensed.reduced(left), BACKENDS["torch"], passes=PASSES)
            if not len(self.todo):
                return

    def _attempt(
        self,
        part: FlatPrograms,
        reduced: Reduced,
        solve: Backend,
        start: Tensor | None = None,
        passes: int = 0,
    ) -> tuple[RawSolution, Tensor | None]:
        qps, recover = reduced.at(part), partial(_recover, part, reduced, passes=passes)
        recalled = None
        if not len(reduced.arrays.rows):
            answer = _unconstrained(qps)
        elif start is None:
            answer = solve(qps)
        else:
            start = start if self.todo is None else start[self.todo]
            # A part of a batch may have fewer rows with a bound than the whole.
            answer, recalled = recall(qps, start[:, reduced.rows])
            _replace(answer, ~recalled, qps, solve)
        claim = recover(answer)
        all_accepted = claim.all_accepted
        if recalled is not None:
            kept = recalled if all_accepted else recalled & claim.accepted()
            self.recalled = int(kept.sum())
            if not all_accepted and _replace(answer, recalled & ~kept, qps, solve):
                claim = recover(answer)
                all_accepted = claim.all_accepted
        if all_accepted and self.todo is None:
            self.raw = claim
            return self.raw, None
        if not all_accepted:
            _sharpen(claim, qps, answer, recover)
        if self.raw is None or self.todo is None:
            self.raw = unsolved(self.programs, Status.NOT_CONVERGED)
            self.todo = torch.arange(len(part), device=part.q.device)
        accepted = claim.accepted()
        self.raw.put(self.todo[accepted], claim.at(accepted))
        self.todo = self.todo[~accepted]
        self.raw.residual[self.todo] = claim.residual[~accepted]
        return self.raw, self.todo


def _replace(answer: Answer, where: Tensor, qps: SoftQPs, solve: Backend) -> bool:
    """Put the answers of ``solve`` where ``where`` ``(B,)`` says so; whether that is anywhere."""
    index = where.nonzero().squeeze(-1)
    if len(index):
        answer.put(index, solve(qps.take(index)))
    return len(index) > 0


def _sharpen(
    claim: RawSolution, qps: SoftQPs, answer: Answer, recover: Callable[[Answer], RawSolution]
) -> None:
    """Improve in place, where that is likely, what the certificate rejects by little."""
    nearly = ~claim.accepted() & (claim.residual <= NEARLY)
    if not nearly.any():
        return
    second = recover(refine(qps, answer, nearly.nonzero().squeeze(-1)))
    improved = (second.residual < claim.residual).nonzero().squeeze(-1)
    claim.put(improved, second.at(improved))


def _unconstrained(qps: SoftQPs) -> Answer:
    """Without rows there is a closed form; where it is unbounded, the certificate sees that."""
    inverse = torch.linalg.pinv(qps.H, hermitian=True)
    v = torch.einsum("bij,bj->bi", inverse[qps.group], -qps.g)
    return Answer(v, qps.l, torch.zeros_like(qps.group))


def _recover(p: FlatPrograms, reduced: Reduced, answer: Answer, passes: int = 0) -> RawSolution:
    """The full primal-dual solution from a backend's answer, certified.

    The multipliers that condensing eliminated come from the stationarity of the Lagrangian: chi by
    the transpose of the same elimination, xi from what is left in the fixed entries. Each of
    ``passes`` solves C z = b and for chi again, against the errors that the elimination made.
    """
    small = math.prod(p.arrays.C.shape[1:]) <= CACHED
    if p.device.type == "cpu" and small and not passes:
        return _recover_compiled(p, reduced, answer)
    z = reduced.expand(p, answer.v)
    for _ in range(passes):
        z = z + p.multiply(reduced.Y_neg, p.multiply(p.C, z) - p.b)
    Hz, y = p.times_H(z), p.times_G(z)
    lam = reduced.all_rows(p, answer.lam, y)
    G_lam = p.times_G(lam, transposed=True)
    slope = Hz + p.q + G_lam
    chi = p.multiply(reduced.Y_neg, slope, transposed=True)
    C_chi = p.multiply(p.C, chi, transposed=True)
    for _ in range(passes):
        chi = chi + p.multiply(reduced.Y_neg, slope + C_chi, transposed=True)
        C_chi = p.multiply(p.C, chi, transposed=True)
    slope += C_chi
    of_fixed = slope[:, : p.fixed.shape[-1]]
    xi = -of_fixed
    of_fixed += xi
    certificate = certify(p, z, lam, chi, xi, Products(Hz, G_lam, C_chi, slope, y))
    value, sigma, residual = certificate.value, certificate.sigma, certificate.residual
    worst = float(residual.max()) if len(residual) else 0.0
    status = torch.zeros_like(p.group)
    return RawSolution(value, z, sigma, chi, lam, xi, status, residual, answer.iterations, worst)


def _recover_compiled(p: FlatPrograms, reduced: Reduced, answer: Answer) -> RawSolution:
    """`_recover` in one kernel."""

    def of_theta() -> list[Any]:
        a, diagonal = p.arrays, (p.is_diagonal("H"), p.is_diagonal("G"))
        T_T, C_T = (np.ascontiguousarray(M.swapaxes(1, 2)) for M in (x.T, a.C))
        G_T = a.G if diagonal[1] else np.ascontiguousarray(a.G.swapaxes(1, 2))
        matrices = [T_T, x.Y_neg, a.C, C_T, a.H, a.G, G_T, diagonal]
        return [*matrices, x.z_0, a.q, a.c, a.b, a.lb, a.ub, a.w]

    claim, x = answer.arrays, reduced.arrays
    # V and Q of a theta share its T, unless C has dependent rows.
    theta = p.known(("kernel", reduced.keep), of_theta)
    given = (claim.v, claim.lam, p.group_array, p.fixed_array, x.rows, x.others, *theta, VIOLATED)
    *found, worst = per_sample.recover(*given)
    arrays = RawArrays._make((*found, claim.iterations))
    return RawSolution.of_arrays(arrays, p.device, worst=worst)
