"""An exported policy beside an exact solver: random states of every kind, solutions, differences.

A certified solution gives the active set; for a fixed one, the KKT conditions of the whole plan are
linear equations. Their solution, with iterative refinement, is exact up to rounding if it confirms
the active set, and else corrects it. Where this does not settle, the interior point is the most
accurate solver.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
import scipy
import torch

from torch_qpmpc.errors import QPError
from torch_qpmpc.export.library import Library
from torch_qpmpc.export.tables import Array, Tables
from torch_qpmpc.export.writer import CONSTANTS, NEAR, Example, Examples
from torch_qpmpc.mpc.module import QPMPC
from torch_qpmpc.qp.program import QuadraticProgram, Status
from torch_qpmpc.qp.solution import row_states
from torch_qpmpc.qp.solve import solve_qp

#: Number of random states that the compiled policy is compared at; at least `LEAST` for a `LARGE`
#: QP, whose cold solves take long.
COMPARED, LEAST = 400, 40
#: QPs of more rows are solved by the interior point alone.
LARGE = 200
#: Most steps from one active set to the next.
MAX_STEPS = 20
#: A correction is kept if the value changes by no more than this fraction.
CERTIFIED = 1e-5
#: Differences above this, relative to the largest action or value, are worth an exact solution.
DOUBTFUL = 1e-9
#: Examples of each kind.
EACH = 3
#: A centre that is nearer to a bound, relative to the distance of both, is at that bound.
CENTRED = 1e-6
#: Most times that an infeasible state is moved half way to the centre.
HALVINGS = 12
#: What a step of an infeasible state returns.
INFEASIBLE = 2


@dataclass(frozen=True)
class Agreement:
    """A compiled policy compared with an exact solver at random states, some far out of bounds.

    Attributes:
        states: the number of states.
        solved: the number of those that both solve, where actions and values are compared.
        infeasible: the number of those that both call infeasible.
        u: the largest difference of an action.
        value: the largest difference of a value, relative to the value.
        unsolved: the number of states that the solver solves and the policy does not.
        iterations: the most iterations from an empty active set.
    """

    states: int
    solved: int
    infeasible: int
    u: float
    value: float
    unsolved: int
    iterations: int


class Reference(NamedTuple):
    """Solutions of V at B states.

    Attributes:
        status: `Status` of each, ``(B,)``.
        u, value: the actions ``(B, n_u)`` and costs to go ``(B,)``, NaN where unsolved.
        active: the active sets, as in `QPSolution`, ``(B, n_g)``.
    """

    status: Array
    u: Array
    value: Array
    active: Array


@torch.no_grad()
def reference(mpc: QPMPC, p: Array, solver: str | None = None) -> Reference:
    """Return the certified solutions of V at p ``(B, n_p)`` by a solver of the package."""
    qp = mpc.quadratic_program()
    solver = solver or ("torch" if _is_large(qp) else "daqp")
    fixed = torch.as_tensor(p, dtype=qp.q.dtype, device=qp.q.device)
    solution = solve_qp(qp, fixed, solver=solver, on_failure="mask")
    solved = (solution.status == Status.SOLVED).cpu().numpy()
    u = solution.z[:, mpc.n_p : mpc.n_p + mpc.n_u].double().cpu().numpy()
    value = solution.value.double().cpu().numpy()
    return Reference(
        solution.status.cpu().numpy().copy(),
        np.where(solved[:, None], u, np.nan),
        np.where(solved, value, np.nan),
        solution.active.cpu().numpy().copy(),
    )


def _is_large(qp: QuadraticProgram) -> bool:
    """Return True for more than `LARGE` rows with a bound."""
    return int((qp.lb.isfinite() | qp.ub.isfinite()).sum()) > LARGE


def sharpen(mpc: QPMPC, p: Array, coarse: Reference, which: Array) -> Reference:
    """Replace solutions of ``coarse`` at the indices ``which`` by exact ones."""
    qp = mpc.quadratic_program()
    if _is_large(qp):
        return coarse
    data = [x.detach().double().cpu().numpy() for x in qp.tensors()]
    u, value = coarse.u.copy(), coarse.value.copy()
    for i in which:
        z = _exact(data, np.asarray(p[i], dtype=np.float64), coarse.active[i])
        if z is None:
            other = reference(mpc, p[i : i + 1], "torch")
            if other.status[0] == Status.SOLVED:
                u[i], value[i] = other.u[0], other.value[0]
            continue
        cost = _cost(data, z)
        if abs(cost - value[i]) <= CERTIFIED * (1 + abs(value[i])):
            u[i], value[i] = z[mpc.n_p : mpc.n_p + mpc.n_u], cost
    return coarse._replace(u=u, value=value)


def _exact(data: list[Array], p: Array, active: Array) -> Array | None:
    """Return the z that the KKT conditions of an active set give, None if it does not settle."""
    H, q, _, C, b, G, lb, ub, w = data
    n_p, n_c = len(p), len(C)
    n = H.shape[0] - n_p
    held = (np.abs(active) == 1) | ((lb == ub) & (np.abs(active) < 2))
    level = np.where(active > 0, ub, lb)
    fixed = np.where(np.abs(active) == 2, np.sign(active) * np.where(np.isinf(w), 0, w), 0.0)
    held &= np.abs(G[:, n_p:]).max(-1) > 0
    previous = None
    for _ in range(MAX_STEPS):
        A = G[held, n_p:]
        B = np.concatenate((C[:, n_p:], A))
        kkt = np.block([[H[n_p:, n_p:], B.T], [B, np.zeros((len(B), len(B)))]])
        right = np.concatenate(
            (
                -q[n_p:] - H[n_p:, :n_p] @ p - G[:, n_p:].T @ fixed,
                b - C[:, :n_p] @ p,
                level[held] - G[held, :n_p] @ p,
            )
        )
        x = _solve(kkt, right)
        z = np.concatenate((p, x[:n]))
        lam = fixed.copy()
        lam[held] = x[n + n_c :]
        level, held, fixed = row_states(G @ z + lam, lb, ub, w)
        held &= np.abs(G[:, n_p:]).max(-1) > 0
        fixed = np.where(held, 0.0, fixed)
        fixed[~(np.abs(G[:, n_p:]).max(-1) > 0)] = 0.0
        states = held, np.where(held, level, 0), fixed
        if previous is not None and all(map(np.array_equal, states, previous)):
            return z
        previous = states
    return None


def _solve(matrix: Array, right: Array) -> Array:
    """Solve a linear system with two refinements, by least squares if it is singular."""
    lu, pivots, _ = scipy.linalg.lapack.dgetrf(matrix)

    def regular(right: Array) -> Array:
        return scipy.linalg.lapack.dgetrs(lu, pivots, right)[0]

    x, solve = regular(right), regular
    with np.errstate(all="ignore"):  # of a singular matrix
        error = np.abs(matrix @ x - right).max()
    if not error <= 1e-8 * (1 + np.abs(right).max()):
        inverse = np.linalg.pinv(matrix, rcond=1e-13, hermitian=True)
        x, solve = inverse @ right, partial(np.matmul, inverse)
    wide = matrix.astype(np.longdouble)
    for _ in range(2):
        x = x + solve((right - wide @ x).astype(np.float64))
    return x


def _cost(data: list[Array], z: Array) -> float:
    H, q, c, _, _, G, lb, ub, w = data
    z, y = z.astype(np.longdouble), G @ z
    off = np.maximum(np.maximum(lb - y, y - ub), 0)
    return float(z @ (H @ z) / 2 + q @ z + c + np.where(np.isinf(w), 0, w) @ off)


def states(mpc: QPMPC, tables: Tables, dtype: str) -> tuple[Array, Reference]:
    """Draw states in the policy's numbers, most of which have solutions, and solve for them."""

    def solve(p: Array) -> Reference:
        return reference(mpc, p.astype(dtype).astype(np.float64))

    count = int(COMPARED * min(1.0, LARGE / max(len(tables.rows), 1)) ** 2)
    p, exact = nearer(tables, draw(tables, max(count, min(LEAST, COMPARED))), solve)
    return p.astype(dtype).astype(np.float64), exact


def draw(tables: Tables, count: int, seed: int = 0) -> Array:
    """Draw p ``(count, n_p)`` about the centre, up to ten times as far away as the bounds.

    Those nearest to reaching the bounds come first. An entry's size is a quantile, at most the
    median, over the rows that contain it, of that at which the row without multipliers is at its
    nearest bound: rows of late stages reach theirs for absurd p only. It is one for an entry
    without an effect on them, and `Tables.usual` without any row. Constants stay, and p satisfies
    hard rows with equal bounds.
    """
    rng = np.random.default_rng(seed)
    pairs = zip(tables.rows.parts(), tables.known.parts(), strict=True)
    Y, lower, upper, *_ = (np.concatenate(pair) for pair in pairs)
    span = np.where(np.isfinite(upper - lower), upper - lower, 0.0)  # a centre may be at a bound
    distances = (np.abs(x - Y @ tables.centre) for x in (lower, upper))
    near = np.minimum(*(np.where(x > CENTRED * span, x, np.inf) for x in distances))
    quantiles = rng.uniform(0, 0.5, count)
    scale = np.tile(np.ones(tables.n_p) if len(Y) else tables.usual, (count, 1))
    rounding = 1e-13 * np.abs(Y).max(initial=0)  # of entries without an effect
    for j, column in enumerate(np.abs(Y).T):
        reaches = np.isfinite(near) & (column > max(1e-9 * column.max(initial=0), rounding))
        if reaches.any():
            scale[:, j] = np.quantile(near[reaches] / column[reaches], quantiles)
    exponents = rng.uniform(-2, 1, count)
    exponents = exponents[np.abs(exponents).argsort()]
    away = 10 ** exponents[:, None] * scale * rng.standard_normal((count, tables.n_p))
    p = tables.centre + away
    p[:, [*tables.constants]] = [*tables.constants.values()]
    known = tables.known
    equal = np.isinf(known.w) & (known.lower == known.upper)
    Y = known.Y[equal]
    return p - (p @ Y.T - known.lower[equal]) @ np.linalg.pinv(Y).T


def nearer(
    tables: Tables, p: Array, solve: Callable[[Array], Reference]
) -> tuple[Array, Reference]:
    """Draw infeasible p nearer to the centre until they have solutions, and solve for all p.

    The p with a plan are a convex set. One infeasible p in four stays what it is.
    """
    p, exact = p.copy(), solve(p)
    for _ in range(HALVINGS):
        infeasible = np.flatnonzero(exact.status == Status.INFEASIBLE)
        moved = infeasible[infeasible % 4 > 0]
        if not len(moved):
            break
        p[moved] = (p[moved] + tables.centre) / 2
        solution = solve(p[moved])
        for whole, part in zip(exact, solution, strict=True):
            whole[moved] = part
    return p, exact


def choose(mpc: QPMPC, p: Array, coarse: Reference) -> tuple[Examples, Reference]:
    """Choose a few states of each kind, and return exact solutions of them.

    Raises:
        QPError: no state is solved.
    """
    solved, states = coarse.status == Status.SOLVED, np.abs(coarse.active)
    kinds = {
        "interior": solved & (states == 0).all(-1),
        "at bounds": solved & (states == 1).any(-1) & (states != 2).all(-1),
        "saturated": solved & (states == 2).any(-1),
        "infeasible": coarse.status == Status.INFEASIBLE,
    }
    chosen = {kind: np.flatnonzero(mask)[:EACH] for kind, mask in kinds.items()}
    exact = sharpen(mpc, p, coarse, np.concatenate([chosen[kind] for kind in [*kinds][:3]]))
    codes = {"infeasible": 2}
    if not solved.any():
        got = f"no solution of its QP at {len(p)} states"
        remedy = (
            "See mpc.solve(s): hard rows may contradict each other; a finite slack softens them."
        )
        raise QPError.expected("mpc", got, "a QP that a solver solves", remedy)
    H = mpc.quadratic_program().H.detach().double().cpu().numpy()[: mpc.n_p, : mpc.n_p]
    terms = ((np.abs(p) @ np.abs(H)) * np.abs(p)).sum(-1) / 2
    examples = [
        Example(kind, p[i], codes.get(kind, 0), exact.u[i], float(exact.value[i]), float(terms[i]))
        for kind, indices in chosen.items()
        for i in indices
    ]
    return Examples(examples, _size(exact.u, solved), float(_size(exact.value, solved))), exact


def _size(x: Array, solved: Array) -> Array:
    """Return a typical size of the solved x: those of far states are larger."""
    return np.quantile(np.abs(x[solved]), 0.9, axis=0) if solved.any() else np.ones(x.shape[1:])


def compare(
    mpc: QPMPC, tables: Tables, library: Library, p: Array, exact: Reference
) -> tuple[Agreement, float]:
    """Return the agreement, and the largest error of an action relative to its size.

    An error within the tolerances of the rows that the action follows from counts as none.
    """
    states = library.states(len(p))
    steps = library.steps(states, p, tables.n_u)
    solvable = exact.status == Status.SOLVED
    both = solvable & (steps.codes == 0)

    def differences(exact: Reference) -> tuple[Array, Array]:
        u = np.abs(steps.u - exact.u).max(-1)
        return u, np.abs(steps.value - exact.value) / (np.abs(exact.value) + 1e-300)

    u, value = differences(exact)
    # Relative to the state's own action, or to a usual one: some drawn states have huge ones.
    sizes = np.abs(exact.u).max(-1)
    sizes = np.fmax(sizes, np.median(sizes[both]) if both.any() else 0).clip(1e-9)
    doubtful = both & ((u > DOUBTFUL * sizes) | (value > DOUBTFUL))
    if library.real == np.float64:
        u, value = differences(sharpen(mpc, p, exact, np.flatnonzero(doubtful)))
    agreement = Agreement(
        states=len(p),
        solved=int(both.sum()),
        infeasible=int(((exact.status == Status.INFEASIBLE) & (steps.codes == INFEASIBLE)).sum()),
        u=float(u[both].max(initial=0)),
        value=float(value[both].max(initial=0)),
        unsolved=int((solvable & ~both).sum()),
        iterations=int(steps.iterations.max(initial=0)),
    )
    errors = np.where(both, u / sizes, 0)
    for i in np.flatnonzero(errors > NEAR[str(library.real)].u):
        lam = library.multipliers(states, len(tables.rows))[i]
        if u[i] <= _tolerance(tables, str(library.real), p[i], lam):
            errors[i] = 0
    return agreement, float(errors.max(initial=0))


def _tolerance(tables: Tables, dtype: str, p: Array, lam: Array) -> float:
    """Return the largest error of u_0 that the tolerances of the held rows allow.

    A held row of policy.c is at its bound to within ``TOLERANCE size + ROUNDING |lam|``. An error
    dy of the held rows h is, by the tables, an error ``F_h Q_hh^-1 dy`` of u_0.
    """
    tight, rounding = (
        float(CONSTANTS[dtype][key].rstrip("f")) for key in ("TOLERANCE", "ROUNDING")
    )
    held = (lam != 0) & (np.abs(lam) < tables.rows.w)
    size = tables.rows.size + np.abs(tables.rows.Y) @ np.abs(p)
    error = tight * size[held] + rounding * np.abs(lam).sum()
    gain = np.linalg.lstsq(tables.Q[np.ix_(held, held)], tables.F[:, held].T, rcond=None)[0]
    return float((error @ np.abs(gain)).max(initial=0))
