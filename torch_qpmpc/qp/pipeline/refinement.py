"""Refinement: the solution of an active set in twice the working precision, in all entries of z.

It takes the QPs that the certificate rejects. For fixed states of the rows (free, held at a bound,
saturated at |lam| = w) the KKT conditions are linear in z, chi and the multipliers of held rows.
Iterative refinement with residuals in twice the working precision solves them, without elimination
of C z = b (Higham, "Accuracy and stability of numerical algorithms", chapter 12). Rows that
contradict their states change them, and the new set is solved. The result is judged before it is
rounded: where rows are nearly parallel, rounding alone violates them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch

from torch_qpmpc.qp.kernels.batched import null_space_inverses
from torch_qpmpc.qp.kernels.linalg import compiled
from torch_qpmpc.qp.kernels.sample import CANCELLED, FLOOR
from torch_qpmpc.qp.pipeline.arrays import CONTRADICTED, BatchSolution, Theta
from torch_qpmpc.qp.pipeline.batch import Programs
from torch_qpmpc.qp.program import TOLERANCE, Status

#: Largest number of active sets from one start: what is solved at all takes one or two.
MAX_SETS = 6
#: Fewer are tried if their number times the third power of the equations' exceeds this.
MAX_WORK = 2e8
#: Largest number of refinements of one set.
MAX_PASSES = 15
#: A row contradicts its state by more than this, relatively; ..
EXACT = 1e-20
#: .. or by more than this if active rows are equal up to rounding.
ROUNDING = 1e-14
#: Sizes count as at least this share of the largest, or of all terms: less may be rounding.
LEAST = ROUNDING / TOLERANCE
#: Rows are dependent if a singular value, relative to the largest, is below this, ..
SINGULAR = 2e-15
#: .. and H is flat in a direction whose curvature is, relative to its largest entry.
FLAT = 1e-14
#: A z this many times as large as that of least norm is not a start.
RUNAWAY = 1e3
#: A multiplier is zero up to rounding if its force is this small, relative to the largest.
WEAK = 1e-10
#: Splits a number into two halves of 26 bits.
SPLIT = 134217729.0
TINY = np.finfo(float).tiny


class Twice(NamedTuple):
    """Numbers in twice the working precision, ``high + low``."""

    high: np.ndarray
    low: np.ndarray

    def plus(self, x: np.ndarray) -> Twice:
        high, low = _two_sum(self.high, x)
        return Twice(*_two_sum(high, low + self.low))

    def minus(self, x: np.ndarray) -> np.ndarray:
        """Return the difference, rounded; x may be infinite."""
        high, low = _two_sum(self.high, -x)
        return np.where(np.isfinite(x), high + (low + self.low), high)


def refine(
    programs: Programs, solution: BatchSolution, which: np.ndarray, last: bool = False
) -> None:
    """Refine the solutions at the indices ``which`` in place.

    Large QPs, for which all other ways together are quicker, are left until the ``last``.
    """
    if not last and sum(programs.theta.C.shape[1:]) ** 3 > MAX_WORK:
        return
    for i in which:
        try:
            refined = _solve(programs.one(i), solution.z[i], solution.lam[i])
        except (np.linalg.LinAlgError, RuntimeError):  # of numbers that overflowed
            refined = None
        if refined is not None and not refined.status:
            chi, xi = np.split(refined.chi, [solution.chi.shape[1]])
            iterations = solution.iterations[i] + refined.iterations
            solution.put(i, refined._replace(chi=chi, xi=xi, iterations=iterations))


@np.errstate(all="ignore")  # a set without a solution has none that is finite
def _solve(qp: Theta, z: np.ndarray, lam: np.ndarray) -> BatchSolution | None:
    """Solve from the rows whose multiplier is larger than their slack; None if no set has one."""
    force, sign, slip, x = np.abs(lam) * np.abs(qp.G).sum(-1), np.sign(lam), EXACT, None
    share, below = force / max(force.max(initial=0.0), TINY), 1 - np.abs(lam) / (qp.w + TINY)
    beyond = sign * (qp.G @ z - np.where(lam > 0, qp.ub, qp.lb)) / (_row_sizes(qp, z) + TINY)
    held = (share > np.maximum(np.abs(beyond), WEAK)) | ((qp.lb == qp.ub) & (qp.w > 0))
    saturated = (qp.w < np.inf) & (lam != 0) & (below <= np.maximum(beyond, 0))
    codes = np.where(saturated, 2 * sign, held * np.where(sign == 0, 1, sign)).astype(np.int8)
    work = (len(qp.q) + len(qp.b) + np.count_nonzero(codes)) ** 3
    for sets in range(1, int(min(MAX_SETS, 3 + MAX_WORK / work)) + 1):
        system = _System.of(qp, codes)
        x = system.solution(x if x is not None else system.start(z, lam))
        if x is None:
            return None
        if system.solver.dependent:
            slip = ROUNDING
        point = _Point.of(qp, codes, x)
        contradiction, states = point.contradictions(slip)
        if not contradiction.any():
            solution = point.judged(system.errors(x), sets)
            if not solution.status or slip == EXACT:
                return solution
            contradiction, states = point.contradictions(EXACT)
        codes = np.where(contradiction > 0, states, codes)
    return None


def _row_sizes(qp: Theta, z: np.ndarray) -> np.ndarray:
    """Return the size of the terms that each row compares: |G| |z|, and the nearer bound."""
    y = qp.G @ z
    near = np.where(np.abs(y - qp.lb) < np.abs(y - qp.ub), qp.lb, qp.ub)
    return np.abs(qp.G) @ np.abs(z) + np.where(np.isfinite(near), np.abs(near), 0)


class _System(NamedTuple):
    """The equations ``matrix x = right`` in x = (z, chi, lam), of which ``free`` are unknown."""

    matrix: np.ndarray
    right: np.ndarray
    free: np.ndarray
    known: np.ndarray
    solver: _Solver

    @classmethod
    def of(cls, qp: Theta, codes: np.ndarray) -> _System:
        (n_c, n_z), n_g = qp.C.shape, len(qp.w)
        held = np.flatnonzero(np.abs(codes) == 1)
        top = np.hstack((qp.H, qp.C.T, qp.G.T))
        rows = np.vstack((qp.C, qp.G[held]))
        matrix = np.vstack((top, np.pad(rows, ((0, 0), (0, n_c + n_g)))))
        level = np.where(codes > 0, qp.ub, qp.lb)[held]
        right = np.concatenate((-qp.q, qp.b, level))
        free = np.concatenate((np.arange(n_z + n_c), n_z + n_c + held))
        known = np.zeros(n_z + n_c + n_g)
        known[n_z + n_c :] = np.where(np.abs(codes) == 2, np.sign(codes) * qp.w, 0)
        solver = _Solver.of(matrix[:, free], n_z)
        return cls(matrix, right, free, known, solver)

    def start(self, z: np.ndarray, lam: np.ndarray) -> Twice:
        """Return z and lam as a start, or zeros if z ran away along a flat direction."""
        x, nothing = self.known.copy(), np.zeros_like(self.known)
        least = self.solution(Twice(x, nothing))
        if least is not None:
            shortest = np.abs(least.high[: len(z)]).max(initial=0.0)
            if np.abs(z).max(initial=0.0) <= RUNAWAY * shortest:
                x[: len(z)] = z
                x[len(x) - len(lam) :] = lam
        return Twice(x, nothing)

    def solution(self, start: Twice) -> Twice | None:
        """Return the solution nearest to ``start``; None if the refinement diverges."""
        x = Twice(self.known.copy(), np.zeros_like(self.known))
        for part, given in zip(x, start, strict=True):
            part[self.free] = given[self.free]
        last = np.inf
        for _ in range(MAX_PASSES):
            step = np.zeros_like(self.known)
            step[self.free], size = self.solver.solve(-self.errors(x))
            if not np.isfinite(size):
                return None
            if size >= 0.5 * last:
                break
            x, last = x.plus(step), size
        return x

    def errors(self, x: Twice) -> np.ndarray:
        """Return the errors of the equations."""
        return _product(self.matrix, x).minus(self.right)


class _Solver(NamedTuple):
    """Factors of a KKT matrix ``[[H, A'], [A, 0]]``, scaled by ``scale`` on both sides.

    ``A`` and ``H_null`` are the `null_space_inverses`.
    """

    scale: np.ndarray
    H: np.ndarray
    A: np.ndarray
    H_null: np.ndarray
    dependent: bool

    @classmethod
    def of(cls, K: np.ndarray, n: int) -> _Solver:
        scale = _equilibrated(K)
        K = K * scale * scale[:, None]
        H, A = K[:n, :n], K[n:, :n]
        if not np.isfinite(K).all():
            return cls(scale, H, np.full_like(A.T, np.nan), H, False)
        one = torch.from_numpy(H)[None], torch.from_numpy(A)[None]
        of_A, of_H, (rank,) = (x.numpy() for x in null_space_inverses(*one, SINGULAR, FLAT))
        return cls(scale, H, of_A[0], of_H[0], bool(rank < len(A)))

    def solve(self, right: np.ndarray) -> tuple[np.ndarray, float]:
        """Return the solution, and the size of its scaled form."""
        n = len(self.H)
        right = right * self.scale
        z = self.A @ right[n:]
        z = z + self.H_null @ (right[:n] - self.H @ z)
        x = np.concatenate((z, self.A.T @ (right[:n] - self.H @ z)))
        return x * self.scale, float(np.abs(x).max(initial=0.0))


class _Point(NamedTuple):
    """A solution of the equations of an active set."""

    qp: Theta
    codes: np.ndarray
    z: Twice
    chi: Twice
    lam: Twice
    y: Twice
    slope: Twice

    @classmethod
    def of(cls, qp: Theta, codes: np.ndarray, x: Twice) -> _Point:
        n_c, n_z = qp.C.shape
        ends = (n_z, n_z + n_c)
        z, chi, lam = map(Twice, *(np.split(part, ends) for part in x))
        return cls(qp, codes, z, chi, lam, _product(qp.G, z), _product(qp.H, z))

    def contradictions(self, slip: float) -> tuple[np.ndarray, np.ndarray]:
        """Return how much each row contradicts its state, relatively, and the state it takes."""
        qp, codes = self.qp, self.codes
        size = np.maximum(_row_sizes(qp, self.z.high), TINY)
        above, below = self.y.minus(qp.ub) / size, -self.y.minus(qp.lb) / size
        lam, sign = self.lam.high, np.sign(codes)
        row = np.abs(qp.G).sum(-1)
        force = max((np.abs(lam) * row).max(initial=0.0), np.abs(self.slope.high + qp.q).max())
        free, held, saturated = codes == 0, np.abs(codes) == 1, np.abs(codes) == 2
        over = held * (np.abs(lam) - qp.w) / np.maximum(qp.w, TINY)
        inwards = held * (qp.lb < qp.ub) * -lam * sign * row / max(force, TINY)
        outside = free * (qp.w > 0) * np.maximum(above, below)
        back = saturated * np.where(codes > 0, -above, -below)
        # Of 0 times inf, the state that a row is not in.
        by = np.nan_to_num(np.stack((over, inwards, outside, back)), nan=0)
        at_bound = np.where(above > below, 1, -1)
        states = (2 * np.sign(lam), 0 * sign, at_bound, sign)
        state = np.choose(by.argmax(0), states).astype(np.int8)
        by = by.max(0, initial=0.0)
        # A soft row that the equations put beyond its bound is not held, but saturated.
        beyond = np.where(held & (qp.w < np.inf), np.maximum(above, below), 0.0)
        if beyond.max(initial=0.0) > slip:
            by, state = beyond, 2 * at_bound
        return np.where(by > slip, by, 0.0), state

    def judged(self, errors: np.ndarray, sets: int) -> BatchSolution:
        """Return the solution with its value and errors; ``errors`` are those of the equations."""
        qp, z, chi, lam = self.qp, self.z.high, self.chi.high, self.lam.high
        n_z, n_c, hard = len(z), len(qp.b), np.isinf(qp.w)
        beyond = np.maximum(np.maximum(self.y.minus(qp.ub), -self.y.minus(qp.lb)), 0)
        charge = np.where(hard, 0, qp.w * beyond)
        linear, quadratic = _dot(self.z, Twice(qp.q, 0 * qp.q)), _dot(self.z, self.slope) / 2
        cost = linear + quadratic + charge.sum()
        scale = max(map(abs, (cost, linear, quadratic, charge.sum())))
        bound = np.where(lam > 0, qp.ub, np.where(lam < 0, qp.lb, 0))
        gap = np.where(lam == 0, charge, charge - lam * self.y.minus(bound))
        of_slope, of_C, _ = np.split(np.abs(errors), (n_z, n_z + n_c))
        slip = of_slope @ np.abs(z) + np.abs(gap).sum() + of_C @ np.abs(chi)
        force = np.stack((np.abs(qp.H) @ np.abs(z) + np.abs(qp.q), np.abs(qp.G.T) @ np.abs(lam)))
        force = force.sum(0) + np.abs(qp.C.T) @ np.abs(chi)
        scale = max(min(scale, CANCELLED * abs(cost)), FLOOR, LEAST * (force @ np.abs(z)))
        short = np.concatenate((np.abs(qp.C) @ np.abs(z) + np.abs(qp.b), _row_sizes(qp, z)))
        # Rows that contradict each other are held in the middle: no further than is infeasible.
        off = np.concatenate((of_C, hard * beyond)) * (TOLERANCE / CONTRADICTED)
        residual, error = max(_ratio(of_slope, force), _ratio(off, short)), slip / scale
        right = residual <= TOLERANCE and error <= TOLERANCE
        status = int(Status.SOLVED if right else Status.NOT_CONVERGED)
        xi, value = chi[n_c:], cost + qp.c
        return BatchSolution(value, z, chi, lam, xi, status, residual, error, sets, self.codes)


def _ratio(errors: np.ndarray, sizes: np.ndarray) -> float:
    """Return the largest relative error, without those of terms that all but vanish."""
    least = max(LEAST * sizes.max(initial=0.0), FLOOR)
    return float((errors / np.maximum(sizes, least)).max(initial=0.0))


def _equilibrated(K: np.ndarray) -> np.ndarray:
    """Return powers of two that scale a symmetric K to rows of about unit size (Ruiz, 2001)."""
    scale = np.ones(len(K))
    for _ in range(5):
        largest = np.abs(K * scale * scale[:, None]).max(-1, initial=0.0)
        largest[~((largest > 0) & (largest < np.inf))] = 1.0
        scale *= np.ldexp(1.0, -np.frexp(np.sqrt(largest))[1] + 1)
    return scale


def _product(matrix: np.ndarray, x: Twice) -> Twice:
    """Return matrix x in twice the working precision."""
    return Twice(*_two_sum(*products(matrix, x.high, x.low)))


@compiled
def products(matrix, high, low):
    """Return compensated sums of matrix (high + low), and their errors (Ogita et al., 2005)."""
    m, n = matrix.shape
    sums, errors, upper, infinite = np.zeros(m), np.zeros(m), np.empty(n), np.empty(n, np.bool_)
    for j in range(n):
        infinite[j] = not np.isfinite(high[j] + low[j])
        spread = SPLIT * high[j]
        upper[j] = spread - (spread - high[j])
    for i in range(m):
        for j in range(n):
            a, x = matrix[i, j], high[j]
            if a == 0.0 and not infinite[j]:
                continue
            # The product and its error (Dekker), then the sum and its error (Knuth).
            product, spread, x_upper = a * x, SPLIT * a, upper[j]
            a_upper = spread - (spread - a)
            a_lower, x_lower = a - a_upper, x - x_upper
            error = (a_upper * x_upper - product) + a_upper * x_lower + a_lower * x_upper
            error += a_lower * x_lower + a * low[j]
            total = sums[i] + product
            part = total - sums[i]
            errors[i] += (sums[i] - (total - part)) + (product - part) + error
            sums[i] = total
    return sums, errors


def _dot(x: Twice, y: Twice) -> float:
    product = _product(x.high[None], y)
    return float(product.high[0] + (product.low[0] + x.low @ y.high))


def _two_sum(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return x + y rounded, and its error (Knuth)."""
    total = x + y
    part = total - x
    return total, (x - (total - part)) + (y - part)
