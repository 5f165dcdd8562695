"""From a batch of QPs to certified solutions: condense, solve, certify, fall back, diagnose."""

from __future__ import annotations

import contextvars
import time
from dataclasses import dataclass, fields

import numpy as np
import torch
from torch import Tensor

from torch_qpmpc.certificate import TOLERANCE, certify
from torch_qpmpc.condense import Condensed, FlatPrograms, SoftQPs, condense
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
    raw = _unsolved(programs)
    todo = _valid(programs).nonzero().squeeze(-1)
    raw.status[todo] = Status.NOT_CONVERGED
    chain: list[Backend] = [backend(solver), *fallbacks(solver)]
    rejected = 0
    if len(todo):
        n_f = programs.fixed.shape[-1]
        condensed = condense(*_finite_matrices(programs), keep)
        if condensed.deficient and keep > n_f:
            condensed = condense(*_finite_matrices(programs), n_f)
        if start is not None:
            todo = _attempt(chain[0], programs, condensed, todo, raw, start)
        for solve in chain:
            todo = _attempt(solve, programs, condensed, todo, raw)
            rejected += len(todo)
        if len(todo):
            _explain(programs.take(todo), condensed, todo, raw)
    if (log := _active_log.get()) is not None:
        log.solves += len(programs)
        log.unsolved += int((raw.status != Status.SOLVED).sum())
        log.fallback += rejected
        log.iterations += int(raw.iterations.sum())
        solved = raw.residual[raw.status == Status.SOLVED]
        log.residual = max(log.residual, float(solved.max()) if len(solved) else 0.0)
        log.seconds += time.perf_counter() - began
    return raw


def _attempt(
    solve: Backend,
    programs: FlatPrograms,
    condensed: Condensed,
    todo: Tensor,
    raw: RawSolution,
    start: tuple[Tensor, Tensor] | None = None,
) -> Tensor:
    """Solve the QPs at ``todo``, keep what the certificate accepts, return the rest."""
    if not len(todo):
        return todo
    whole = len(todo) == len(programs)
    part = programs if whole else programs.take(todo)
    qps, rows = condensed.soft_qps(part)
    if qps.l.shape[1] == 0:
        answer = _unconstrained(qps)
    else:
        guess = None
        if start is not None:
            z, lam = (tensor[todo] for tensor in start)
            guess = Answer(
                condensed.free_part(part, z).numpy(), lam[:, rows].numpy(), part.group.numpy()
            )
        answer = solve(qps, guess)
    claim = _recover(part, condensed, answer, rows)
    accepted = claim.residual <= TOLERANCE
    nearly = ~accepted & (claim.residual <= NEARLY)
    if nearly.any():
        sharper = refine(qps, answer, nearly.nonzero().squeeze(-1).numpy())
        second = _recover(part, condensed, sharper, rows)
        improved = (second.residual < claim.residual).nonzero().squeeze(-1)
        claim.put(improved, second.at(improved))
        accepted = claim.residual <= TOLERANCE
    claim.status = torch.where(accepted, Status.SOLVED, Status.NOT_CONVERGED)
    if accepted.all():
        raw.put(todo, claim)
        return todo[:0]
    raw.residual[todo] = claim.residual
    raw.put(todo[accepted], claim.at(accepted))
    return todo[~accepted]


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
    lam = torch.zeros_like(y)
    lam[y > p.ub + ACTIVE_TOLERANCE] = torch.inf
    lam[y < p.lb - ACTIVE_TOLERANCE] = -torch.inf
    lam[:, rows] = torch.from_numpy(answer.lam)
    lam = torch.minimum(torch.maximum(lam, -p.w), p.w)
    lam = lam.masked_fill(lam.isinf(), 0)  # a hard row out of reach: the certificate sees it
    gradient = p.multiply(p.H, z) + p.q + p.multiply(p.G.mT, lam)
    chi = -p.multiply(condensed.Y.mT, gradient)
    n_f = p.fixed.shape[-1]
    xi = -(gradient + p.multiply(p.C.mT, chi))[:, :n_f]
    certificate = certify(p, z, lam, chi, xi)
    iterations = torch.from_numpy(answer.iterations).to(torch.int64)
    status = torch.empty_like(iterations)
    return RawSolution(
        certificate.value,
        z,
        certificate.sigma,
        chi,
        lam,
        xi,
        status,
        certificate.residual,
        iterations,
    )


def _explain(part: FlatPrograms, condensed: Condensed, todo: Tensor, raw: RawSolution) -> None:
    """Replace NOT_CONVERGED by what is really the matter, where that can be told."""
    particular = condensed.particular(part)
    inconsistent = (part.multiply(part.C, particular) - part.b).abs() > TOLERANCE * (
        1 + part.b.abs() + particular.abs().amax(-1, keepdim=True)
    )
    y = part.multiply(part.G, particular)
    qps, rows = condensed.soft_qps(part)
    unreachable = (torch.maximum(part.lb - y, y - part.ub) > TOLERANCE) & part.w.isinf()
    unreachable[:, rows] = False
    impossible = inconsistent.any(-1) | unreachable.any(-1)
    reasons = torch.from_numpy(diagnose(qps)) if qps.g.shape[1] else raw.status[todo]
    raw.status[todo] = torch.where(impossible, int(Status.INFEASIBLE), reasons)


def _unsolved(p: FlatPrograms) -> RawSolution:
    """What an element carries that has no solution: an infinite cost, and zeros."""
    n, device = len(p), p.q.device
    z = torch.zeros_like(p.q)
    z[:, : p.fixed.shape[-1]] = p.fixed.nan_to_num(0, 0, 0)
    rows, count = torch.zeros_like(p.lb), torch.zeros(n, dtype=torch.int64, device=device)
    return RawSolution(
        value=torch.full((n,), torch.inf, dtype=p.q.dtype, device=device),
        z=z,
        sigma=rows,
        chi=torch.zeros_like(p.b),
        lam=rows.clone(),
        xi=torch.zeros_like(p.fixed),
        status=torch.full_like(count, int(Status.INVALID_DATA)),
        residual=torch.full((n,), torch.inf, dtype=p.q.dtype, device=device),
        iterations=count,
    )


def _valid(p: FlatPrograms) -> Tensor:
    """Which QPs have finite data and lb <= ub, ``(B,)``."""
    matrices = torch.stack([m.isfinite().flatten(1).all(1) for m in (p.H, p.C, p.G)]).all(0)
    vectors = torch.stack([v.isfinite().all(-1) for v in (p.q, p.b, p.fixed)]).all(0)
    vectors &= p.c.isfinite()
    # A comparison with NaN is false, and an empty interval is one whose bounds are crossed.
    bounds = ((p.lb <= p.ub) & (p.lb < torch.inf) & (p.ub > -torch.inf) & (p.w >= 0)).all(-1)
    return matrices[p.group] & vectors & bounds


def _finite_matrices(p: FlatPrograms) -> tuple[Tensor, Tensor, Tensor]:
    """H, C and G; a triple with NaN or inf, which nothing uses, becomes zero."""
    if all(m.isfinite().all() for m in (p.H, p.C, p.G)):
        return p.H, p.C, p.G
    return p.H.nan_to_num(0, 0, 0), p.C.nan_to_num(0, 0, 0), p.G.nan_to_num(0, 0, 0)
