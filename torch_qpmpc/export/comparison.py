"""An exported policy beside an exact solver: random states of every kind, solutions, differences.

Where policy and solver differ, the solution is refined in twice the working precision.
"""

from dataclasses import dataclass

import numpy as np
import scipy  # imports scipy.optimize at its first use: a third of a second
import torch

from torch_qpmpc.errors import QPError
from torch_qpmpc.export.library import Library
from torch_qpmpc.export.tables import TINY, Array, Tables, far
from torch_qpmpc.export.writer import CONSTANTS, NEAR, Examples
from torch_qpmpc.mpc.module import QPMPC
from torch_qpmpc.qp.pipeline.arrays import BatchSolution
from torch_qpmpc.qp.pipeline.batch import Programs
from torch_qpmpc.qp.pipeline.refinement import refine
from torch_qpmpc.qp.pipeline.solve import solve_programs
from torch_qpmpc.qp.program import Status

#: Number of random states that the compiled policy is compared at; at least `LEAST` for a `LARGE`
#: QP, whose cold solves take long.
COMPARED, LEAST = 400, 40
#: QPs of more rows are solved by the interior point, and from its active sets where in doubt.
LARGE = 200
#: Differences above this, relative to the largest action or value, are worth an exact solution.
DOUBTFUL = 1e-9
#: Examples of each kind.
EACH = 3
#: A centre that is nearer to a bound, relative to the distance of both, is at that bound.
CENTRED = 1e-6
#: Most times that the distance of an infeasible state to the centre is halved.
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


@torch.no_grad()
def programs(mpc: QPMPC, p: Array) -> Programs:
    """Return V's QPs at p ``(B, n_p)``, with actions between their levels."""
    return Programs.of(*mpc.quadratic_program().tensors(), torch.as_tensor(p))[0]


def reference(mpc: QPMPC, p: Array, solver: str | None = None) -> BatchSolution:
    """Return the certified solutions of V at p ``(B, n_p)`` by a solver of the package."""
    if mpc.levels is not None:
        with torch.no_grad():
            best = mpc._solve(torch.as_tensor(p), None, on_failure="mask")
        return BatchSolution._make(getattr(best, x).numpy() for x in BatchSolution._fields)
    qps = programs(mpc, p)
    return solve_programs(qps, solver or ("torch" if _is_large(qps) else "daqp"))


def actions(mpc: QPMPC, solution: BatchSolution) -> Array:
    """Return u_0 of V's solutions, ``(B, n_u)``."""
    return solution.z[:, mpc.n_p : mpc.n_p + mpc.n_u]


def _is_large(qps: Programs) -> bool:
    """Return True for more than `LARGE` rows with a bound."""
    lb, ub = qps.theta.lb, qps.theta.ub
    return int((np.isfinite(lb) | np.isfinite(ub)).any(0).sum()) > LARGE


def sharpen(mpc: QPMPC, p: Array, coarse: BatchSolution, which: Array) -> BatchSolution:
    """Refine the solutions of ``coarse`` at the indices ``which``, or others if they are loose."""
    qps, exact = programs(mpc, p), coarse.at(np.arange(len(p)))
    if mpc.levels is not None or not len(which):  # with levels, each plan has a QP of its own
        return exact
    if _is_large(qps):  # a refinement takes long, and an interior point stops short of bounds
        exact.put(which, solve_programs(qps.take(which), "daqp", exact.active[which]))
        return exact
    if len(loose := which[exact.value_error[which] > DOUBTFUL]):
        exact.put(loose, reference(mpc, p[loose], "torch"))
    refine(qps, exact, which, last=True)
    return exact


def states(mpc: QPMPC, tables: Tables, dtype: str) -> tuple[Array, BatchSolution]:
    """Draw states in the policy's numbers, most of which have solutions, and solve for them.

    Of four infeasible ones three are halved in their distance to the centre until they have one:
    the p with a plan are a convex set.
    """
    count = int(COMPARED * min(1.0, LARGE / max(len(tables.Q), 1)) ** 2) * (not mpc.levels)
    away = draw(tables, max(count, min(LEAST, COMPARED))) - tables.centre
    few, halved = np.arange(len(away)) % 4 > 0, np.zeros(len(away))
    halved[few] = np.ceil(-np.log2(reaches(tables, away[few])))
    p = (tables.centre + away * 0.5 ** halved[:, None]).astype(dtype).astype(np.float64)
    exact = reference(mpc, p)
    while (moved := few & (exact.status == Status.INFEASIBLE) & (halved < HALVINGS)).any():
        halved += moved
        p[moved] = ((p[moved] + tables.centre) / 2).astype(dtype)
        exact.put(moved, reference(mpc, p[moved]))
    return p, exact


def draw(tables: Tables, count: int, seed: int = 0) -> Array:
    """Draw p ``(count, n_p)`` about the centre, up to ten times as far away as the bounds.

    Those nearest to reaching the bounds come first. An entry's size is a quantile, at most the
    median, over the rows that contain it, of that at which the row without multipliers is at its
    nearest bound: rows of late stages reach theirs for absurd p only. It is one for an entry
    without an effect on them, and `Tables.usual` without any row. Constants stay, and p satisfies
    hard rows with equal bounds.
    """
    rng = np.random.default_rng(seed)
    Y, lower, upper, *_ = map(np.concatenate, zip(tables.rows, tables.known, strict=True))
    reach = np.abs(np.stack((lower, upper))) / np.abs(Y).max(1, initial=TINY)
    acts = ~far(reach, np.isfinite(reach) & (reach > 0))
    span = np.where(np.isfinite(reach).all(0) & acts.all(0), upper - lower, 0.0)
    ends = np.where(acts, np.abs(np.stack((lower, upper)) - Y @ tables.centre), np.inf)
    near = np.where(ends > CENTRED * span, ends, np.inf).min(0)  # a centre may be at a bound
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


def reaches(tables: Tables, away: Array) -> Array:
    """Return how far, at most 1, a plan keeps the hard rows on the ways ``away`` from the centre.

    It is 1, too, where a linear program is not solved.
    """
    Y, lower, upper, w, *_ = map(np.concatenate, zip(tables.rows, tables.known, strict=True))
    at, R = Y @ tables.centre, np.pad(tables.R, ((0, len(tables.known.Y)), (0, 0)))
    room, Y, R = np.append(upper - at, at - lower), np.vstack((Y, -Y)), np.vstack((R, -R))
    acts = np.isfinite(room) & np.tile(np.isinf(w), 2)
    if not acts.any():
        return np.ones(len(away))
    room, Y, R, found = room[acts], Y[acts], R[acts], []
    size = np.median(np.abs(room)) or 1.0
    cost, ends = -np.eye(1, R.shape[1] + 1)[0], [(0, 1), *[(None, None)] * R.shape[1]]
    for way in away:
        rows = np.column_stack((Y @ way / size, R))
        best = scipy.optimize.linprog(cost, rows, room / size, bounds=ends)
        found.append(1.0 if best.x is None else best.x[0])
    return np.maximum(found, 0.5**HALVINGS)


def choose(mpc: QPMPC, p: Array, coarse: BatchSolution) -> tuple[Examples, BatchSolution]:
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
    if not solved.any():
        got = f"no solution of its QP at {len(p)} states"
        remedy = "See mpc.solve(s): hard rows may contradict levels or each other; a slack softens."
        raise QPError.expected("mpc", got, "a QP that a solver solves", remedy)
    qp, n_p = mpc.quadratic_program(), mpc.n_p
    H, G = (x.detach().double().abs().cpu().numpy() for x in (qp.H, qp.G))
    terms = ((np.abs(p) @ H[:n_p, :n_p]) * np.abs(p)).sum(-1) / 2
    u, value = actions(mpc, exact), np.where(solved, exact.value, 0.0)
    forces = (np.abs(exact.lam) * (np.abs(exact.z) @ G.T)).sum(-1)  # what an error of a row costs
    size = np.fmax(np.fmax(np.abs(value), _size(value, solved)), np.where(solved, forces, 0.0))
    names = [kind for kind, indices in chosen.items() for _ in indices]
    parts = p, np.where(solved, 0, INFEASIBLE), u, value, size, terms
    at = np.concatenate([*chosen.values()])
    return Examples._make((names, *(part[at] for part in parts), _size(u, solved))), exact


def _size(x: Array, solved: Array) -> Array:
    """Return a typical size of the solved x: those of far states are larger, most may be zero."""
    sizes = np.abs(x[solved]) if solved.any() else np.ones((1, *x.shape[1:]))
    return np.fmax(np.quantile(sizes, 0.9, axis=0), 1e-3 * sizes.max(0)).clip(1e-9)


def compare(
    mpc: QPMPC, tables: Tables, library: Library, p: Array, exact: BatchSolution
) -> tuple[Agreement, float]:
    """Return the agreement, and the largest error of an action relative to its size.

    An error within the tolerances of the rows that the action follows from counts as none.
    """
    states = library.states(len(p))
    steps = library.steps(states, p, tables.n_u)
    solvable = exact.status == Status.SOLVED
    both = solvable & (steps.codes == 0)

    @np.errstate(invalid="ignore")  # a QP without a solution has an infinite value
    def differences(exact: BatchSolution) -> tuple[Array, Array]:
        u = np.abs(steps.u - actions(mpc, exact)).max(-1)
        return u, np.abs(steps.value - exact.value) / (np.abs(exact.value) + 1e-300)

    u, value = differences(exact)
    # Relative to the state's own action, or to a usual one: some drawn states have huge ones.
    sizes = np.abs(actions(mpc, exact)).max(-1)
    sizes = np.fmax(sizes, _size(sizes, both))
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
    for i in np.flatnonzero(errors > NEAR[str(library.real)]):
        lam = library.multipliers(states, len(tables.Q))[i]
        errors[i] *= u[i] > _tolerance(tables, str(library.real), p[i], lam)
    return agreement, float(errors.max(initial=0))


def _tolerance(tables: Tables, dtype: str, p: Array, lam: Array) -> float:
    """Return the largest error of u_0 that the tolerances of the held rows allow.

    A held row of policy.c is at its bound to within ``TOLERANCE size + ROUNDING |lam|``. An error
    dy of the held rows h is, by the tables, an error ``F_h Q_hh^-1 dy`` of u_0.
    """
    own = CONSTANTS[dtype]
    tight, rounding = (float(own[key].rstrip("f")) for key in ("TOLERANCE", "ROUNDING"))
    held = (lam != 0) & (np.abs(lam) < tables.rows.w)
    bound = np.where(lam > 0, tables.rows.upper, tables.rows.lower)
    size = tables.rows.size + np.abs(tables.rows.Y) @ np.abs(p) + np.abs(bound)
    error = tight * size[held] + rounding * np.abs(lam).sum()
    gain = np.linalg.lstsq(tables.Q[np.ix_(held, held)], tables.F[:, held].T, rcond=None)[0]
    return float((error @ np.abs(gain)).max(initial=0))
