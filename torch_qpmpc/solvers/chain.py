"""From a batch of QPs to certified solutions: condense, solve, certify, fall back, diagnose."""

from __future__ import annotations

import contextvars
import time
from dataclasses import dataclass, fields

import numpy as np
import torch
from torch import Tensor

from torch_qpmpc.certificate import TOLERANCE, Products, certify
from torch_qpmpc.condense import Condensed, FlatPrograms, SoftQPs, condensed_for
from torch_qpmpc.qp import Status
from torch_qpmpc.solvers import Answer, Backend, backend, fallbacks
from torch_qpmpc.solvers.crossover import refine
from torch_qpmpc.solvers.diagnose import diagnose

#: Multipliers of rows that no free variable enters count as active beyond this violation.
ACTIVE_TOLERANCE = 1e-9
#: A rejected claim with a relative residual up to this is worth sharpening.
NEARLY = 1e-2


@dataclass
class RawSolution:
    """Certified primal-dual solutions of B QPs: float64, on the CPU; lam = eta - upsilon."""

    value: Tensor
    z: Tensor
    sigma: Tensor
    chi: Tensor
    lam: Tensor
    xi: Tensor
    status: Tensor
    residual: Tensor
    iterations: Tensor

    def at(self, index: Tensor) -> RawSolution:
        """The solutions at ``index``."""
        return RawSolution(*(getattr(self, field.name)[index] for field in fields(self)))

    def put(self, index: Tensor, other: RawSolution) -> None:
        for field in fields(self):
            getattr(self, field.name)[index] = getattr(other, field.name)


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
            "qp/iterations": self.iterations / max(self.solves, 1),
            "qp/residual": self.residual,
            "time/qp": self.seconds,
        }


_active_log: contextvars.ContextVar[SolveLog | None] = contextvars.ContextVar("log", default=None)


def solve_programs(
    programs: FlatPrograms, keep: int, solver: str, start: tuple[Tensor, Tensor] | None = None
) -> RawSolution:
    """Solve and certify B QPs; what cannot be certified has a status that says why.

    Args:
        programs: the QPs.
        keep: leading entries of z that the elimination of C z = b leaves alone, at least n_f.
        solver: a backend's name, see `torch_qpmpc.solvers`.
        start: warm start, z ``(B, n_z)`` and lam ``(B, n_g)`` of a solution of nearly these QPs.
    """
    began = time.perf_counter()
    raw, rejected = _solve_programs(programs, keep, solver, start)
    if (log := _active_log.get()) is not None:
        log.solves += len(programs)
        log.unsolved += int((raw.status != Status.SOLVED).sum())
        log.fallback += rejected
        log.iterations += int(raw.iterations.sum())
        solved = raw.residual[raw.status == Status.SOLVED]
        log.residual = max(log.residual, float(solved.max()) if len(solved) else 0.0)
        log.seconds += time.perf_counter() - began
    return raw


def _solve_programs(
    programs: FlatPrograms, keep: int, solver: str, start: tuple[Tensor, Tensor] | None
) -> tuple[RawSolution, int]:
    """The solutions, and how often a claim was rejected and the next solver asked."""
    attempts: list[tuple[Backend, bool]] = [(backend(solver), False)]
    attempts += [(other, False) for other in fallbacks(solver)]
    if start is not None:
        attempts.insert(0, (backend(solver), True))
    valid = _valid(programs)
    usable = programs if valid.all() else programs.without_nan()
    condensed = condensed_for(usable, keep)
    # First-order conditions certify an optimum only where the QP is convex.
    valid &= condensed.convex(programs.fixed.shape[-1])[programs.group]
    todo, raw, rejected = torch.arange(len(programs)), None, 0
    if not valid.all():
        raw, todo = _unsolved(programs), valid.nonzero().squeeze(-1)
        raw.status[todo] = Status.NOT_CONVERGED
        if not len(todo):
            return raw, 0
    programs = usable
    for solve, warm in attempts:
        whole = len(todo) == len(programs)
        part = programs if whole else programs.take(todo)
        guess = (start[0][todo], start[1][todo]) if warm and start is not None else None
        claim = _attempt(solve, part, condensed, guess)
        accepted = claim.status == Status.SOLVED
        if whole and accepted.all():
            return claim, rejected
        raw = _unsolved(programs, Status.NOT_CONVERGED) if raw is None else raw
        raw.put(todo[accepted], claim.at(accepted))
        todo = todo[~accepted]
        raw.residual[todo] = claim.residual[~accepted]
        if len(todo) and not warm and not rejected:
            rejected = len(todo)
            # What is proved to be infeasible need not be tried by every other solver.
            raw.status[todo] = _reasons(programs.take(todo), condensed)
            todo = todo[raw.status[todo] != Status.INFEASIBLE]
        if not len(todo):
            break
    assert raw is not None
    return raw, rejected


def _attempt(
    solve: Backend,
    programs: FlatPrograms,
    condensed: Condensed,
    start: tuple[Tensor, Tensor] | None,
) -> RawSolution:
    """One backend's claims, sharpened where that helps; ``status`` is the certificate's verdict."""
    qps, rows = condensed.soft_qps(programs)
    if qps.l.shape[1] == 0:
        answer = _unconstrained(qps)
    elif start is None:
        answer = solve(qps, None)
    else:
        z, lam = start
        v = condensed.free_part(programs, z).numpy()
        answer = solve(qps, Answer(v, lam[:, rows].numpy(), np.zeros(len(v), dtype=np.int64)))
    claim = _recover(programs, condensed, answer, rows)
    nearly = (claim.residual > TOLERANCE) & (claim.residual <= NEARLY)
    if nearly.any():
        sharper = refine(qps, answer, nearly.nonzero().squeeze(-1).numpy())
        second = _recover(programs, condensed, sharper, rows)
        improved = (second.residual < claim.residual).nonzero().squeeze(-1)
        claim.put(improved, second.at(improved))
    claim.status[claim.residual > TOLERANCE] = Status.NOT_CONVERGED
    return claim


def _unconstrained(qps: SoftQPs) -> Answer:
    """Without rows there is a closed form; where it is unbounded, the certificate sees that."""
    inverse = np.linalg.pinv(qps.H, hermitian=True)
    v = np.einsum("bij,bj->bi", inverse[qps.group], -qps.g)
    return Answer(v, qps.l, np.zeros(len(v), dtype=np.int64))


def _recover(p: FlatPrograms, condensed: Condensed, answer: Answer, rows: Tensor) -> RawSolution:
    """The full primal-dual solution from a backend's answer, certified.

    The multipliers that condensing eliminated come from the stationarity of the Lagrangian: chi by
    the transpose of the same elimination, xi from what is left in the fixed entries.
    """
    z = condensed.expand(p, torch.from_numpy(answer.v))
    y = p.multiply(p.G, z)
    # A row that no free variable enters is active exactly where it is violated.
    lam = torch.zeros_like(y)
    lam.masked_fill_(y > p.ub + ACTIVE_TOLERANCE, torch.inf)
    lam.masked_fill_(y < p.lb - ACTIVE_TOLERANCE, -torch.inf)
    lam[:, rows] = torch.from_numpy(answer.lam)
    lam = lam.minimum(p.w).maximum(-p.w)
    lam = lam.masked_fill_(lam.isinf(), 0)  # a hard row out of reach: the certificate sees it
    products = Products(p.multiply(p.H, z), y, p.multiply(p.G.mT, lam))
    gradient = products.Hz + p.q + products.G_lam
    chi = -p.multiply(condensed.Y.mT, gradient)
    n_f = p.fixed.shape[-1]
    xi = -(gradient + p.multiply(p.C.mT, chi))[:, :n_f]
    certificate = certify(p, z, lam, chi, xi, products)
    iterations = torch.from_numpy(answer.iterations).to(torch.int64)
    return RawSolution(
        certificate.value,
        z,
        certificate.sigma,
        chi,
        lam,
        xi,
        torch.full_like(iterations, int(Status.SOLVED)),
        certificate.residual,
        iterations,
    )


def _reasons(part: FlatPrograms, condensed: Condensed) -> Tensor:
    """What is the matter with QPs that a solver did not solve: their status, ``(B,)``."""
    particular = condensed.particular(part)
    inconsistent = (part.multiply(part.C, particular) - part.b).abs() > TOLERANCE * (
        1 + part.b.abs() + particular.abs().amax(-1, keepdim=True)
    )
    y = part.multiply(part.G, particular)
    qps, rows = condensed.soft_qps(part)
    unreachable = (torch.maximum(part.lb - y, y - part.ub) > TOLERANCE) & part.w.isinf()
    unreachable[:, rows] = False
    impossible = inconsistent.any(-1) | unreachable.any(-1)
    if not qps.g.shape[1]:
        return torch.where(impossible, int(Status.INFEASIBLE), int(Status.NOT_CONVERGED))
    return torch.where(impossible, int(Status.INFEASIBLE), torch.from_numpy(diagnose(qps)))


def _unsolved(p: FlatPrograms, status: Status = Status.INVALID_DATA) -> RawSolution:
    """What an element carries that has no solution: an infinite cost, and zeros."""
    n, zeros = len(p), p.q.new_zeros
    z = zeros(n, p.q.shape[-1])
    z[:, : p.fixed.shape[-1]] = p.fixed.nan_to_num(0, 0, 0)
    return RawSolution(
        value=p.q.new_full((n,), torch.inf),
        z=z,
        sigma=zeros(n, p.lb.shape[-1]),
        chi=zeros(n, p.b.shape[-1]),
        lam=zeros(n, p.lb.shape[-1]),
        xi=torch.zeros_like(p.fixed),
        status=p.group.new_full((n,), int(status)),
        residual=p.q.new_full((n,), torch.inf),
        iterations=p.group.new_zeros(n),
    )


def _valid(p: FlatPrograms) -> Tensor:
    """Which QPs have finite data and lb <= ub, ``(B,)``."""
    # A sum is finite if its terms are (but for overflow, which no solver survives either).
    matrices = (p.H.sum((1, 2)) + p.C.sum((1, 2)) + p.G.sum((1, 2))).isfinite()
    vectors = (p.q.sum(-1) + p.b.sum(-1) + p.fixed.sum(-1) + p.c).isfinite()
    # A comparison with NaN is false, and an empty interval is one whose bounds are crossed.
    bounds = ((p.lb <= p.ub) & (p.lb < torch.inf) & (p.ub > -torch.inf) & (p.w >= 0)).all(-1)
    return matrices[p.group] & vectors & bounds
