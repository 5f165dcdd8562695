"""The policy of a QP as mixed-integer linear constraints.

In the tables of `torch_qpmpc.export.tables` the plan's deviation from its minimiser without
inequalities is nu, in coordinates in which the cost is ``|nu|^2 / 2``. The rows are
``y = Y p + R nu`` with unit rows of R, ``nu = -R'lam``, and u_0 is affine in p and lam. A binary
for each bound says that the row is at the bound or beyond it, another that its multiplier is at the
soft row's price w. What the binaries switch needs bounds of y and lam: by the least cost, which is
convex in p and so largest at a vertex, by w or, of hard rows, by the cost of a plan with slack, and
then by linear programs over the relaxation.

Reference: the encoding is that of Schwan, Jones and Kuhn (2023), "Stability verification of neural
network controllers using mixed-integer programming", IEEE TAC, for multi-parametric QPs.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.optimize import linprog

from torch_qpmpc.errors import QPError, SolverError
from torch_qpmpc.export.tables import Tables
from torch_qpmpc.proofs.program import Affine, Array, Program
from torch_qpmpc.qp.program import QuadraticProgram, Status
from torch_qpmpc.qp.solve import solve_qp

#: The largest multiplier in units of the rows: one over HiGHS' tolerance of a binary.
LARGEST = 1e6
#: Rounds of bound tightening.
ROUNDS = 2
#: Margin by which a bound may be exceeded through the solvers' tolerances, relative to its size.
MARGIN = 1e-6


@dataclass(eq=False)
class Reach:
    """Bounds of the rows' values y and of the multipliers at upper and lower bounds, ``(r,)``."""

    y_low: Array
    y_high: Array
    at_upper: Array
    at_lower: Array


def encode(program: Program, tables: Tables, p: Affine, vertices: Array) -> Affine:
    """Add the policy's optimality conditions, and return u_0 as a function of the variables.

    Args:
        program, tables: the program, which contains p and the rows that bound it; the policy.
        p, vertices: the known entries, ``(n_p,)``; points whose hull contains p, ``(count, n_p)``.

    Raises:
        QPError: the QP is infeasible at a vertex, or its hard rows leave no interior there.
        SolverError: multipliers are too large for HiGHS.
    """
    # HiGHS' tolerances are absolute, so y and lam are in units of the largest y.
    size = np.abs(vertices @ tables.rows.Y.T).max(initial=0.0) or 1.0
    units = {name: getattr(tables.rows, name) / size for name in ("Y", "lower", "upper", "w")}
    tables = replace(tables, rows=tables.rows._replace(**units), F=size * tables.F)
    reach = _derived(tables, vertices)
    for _ in range(ROUNDS):
        _tighten(program, tables, p, reach)
    lam, _ = _add_rows(program, tables, p, reach)
    if (most := program.upper[lam.columns].max(initial=0.0)) > LARGEST:
        text = f"HiGHS could miss a worst case: multipliers reach {most:.1e} times their rows."
        raise SolverError(f"{text} Lower the prices w of soft rows, or take a smaller set.")
    return (p.times(tables.K) + lam.times(-tables.F)).plus(tables.k)


def _derived(tables: Tables, vertices: Array) -> Reach:
    """Derive bounds of y and lam from the least cost at the vertices."""
    rows, y_free = tables.rows, vertices @ tables.rows.Y.T
    _check_known(tables, vertices)
    hard = np.isinf(rows.w)
    lower, upper = rows.lower - y_free, rows.upper - y_free
    radius = np.sqrt(2 * _least_cost(tables.R, lower, upper, rows.w, vertices)) * (1 + MARGIN)
    low, high = y_free.min(0) - radius, y_free.max(0) + radius
    # Rows out of reach never act.
    lower = np.where(low < rows.lower, lower, -np.inf)
    upper = np.where(high > rows.upper, upper, np.inf)
    acts, most = hard & (np.isfinite(lower) | np.isfinite(upper)).any(0), rows.w
    if acts.any():
        slack = _slack(tables.R[acts], lower[:, acts], upper[:, acts], vertices) / 2
        slack_of = acts * slack[:, None]
        cost = _least_cost(tables.R, lower + slack_of, upper - slack_of, rows.w, vertices)
        most = np.where(hard, cost * (1 + MARGIN) / slack.min(), rows.w)
    forces = (np.where(np.isfinite(x).any(0), most, 0.0) for x in (upper, lower))
    return Reach(low, high, *forces)


def _least_cost(R: Array, lower: Array, upper: Array, w: Array, vertices: Array) -> float:
    """Return the largest ``min |nu|^2 / 2 + sum_i w_i dist(R_i nu, [lower_i, upper_i])``."""
    n, zeros = R.shape[1], torch.zeros(1, dtype=torch.float64)
    rows = [torch.as_tensor(x) for x in (R, lower, upper, w)]
    cost = (torch.eye(n).double(), zeros.expand(n), zeros[0], zeros.expand(0, n), zeros[:0])
    qp = QuadraticProgram(*cost, *rows)  # pyright: ignore[reportArgumentType] - nine tensors
    solution = solve_qp(qp, solver="daqp", on_failure="mask")
    for p in vertices[(solution.status != Status.SOLVED).numpy()]:
        _raise_infeasible(p)
    return solution.value.numpy().max(initial=0.0)


def _check_known(tables: Tables, vertices: Array) -> None:
    """Raise if hard rows of p alone are violated at a vertex."""
    known = tables.known
    y, hard = vertices @ known.Y.T, np.isinf(known.w)
    slip = MARGIN * (1 + known.size)
    outside = ((y > known.upper + slip) | (y < known.lower - slip)) & hard
    if outside.any():
        _raise_infeasible(vertices[outside.any(1)][0])


def _raise_infeasible(p: Array) -> None:
    at = np.array2string(p, precision=4, separator=", ")
    got = f"p = {at}, where the hard rows leave no plan with slack"
    want = "states with a plan strictly inside all hard bounds"
    remedy = "Make bounds of states soft (finite w), or take a smaller set."
    raise QPError.expected("the set of states", got, want, remedy)


def _slack(R: Array, lower: Array, upper: Array, vertices: Array) -> Array:
    """Return the largest slack, up to 1, that all rows can have at each vertex, ``(count,)``."""
    slack, n = np.zeros(len(vertices)), R.shape[1]
    matrix = np.column_stack((np.concatenate((R, -R)), np.ones(2 * len(R))))
    for i, p in enumerate(vertices):
        right = np.concatenate((upper[i], -lower[i]))
        kept = np.isfinite(right)
        bounds = [(None, None)] * n + [(0, 1)]
        result = linprog([0] * n + [-1], matrix[kept], right[kept], bounds=bounds, method="highs")
        if result.status != 0 or result.x[-1] <= 0:
            _raise_infeasible(p)
        slack[i] = result.x[-1]
    return slack


def _tighten(program: Program, tables: Tables, p: Affine, reach: Reach) -> None:
    """Tighten the bounds in place by linear programs, over the encoding's relaxation."""
    relaxed = program.copy()
    _, (y, up, low) = _add_rows(relaxed, tables, p, reach)
    rows = tables.rows

    def most(of: Affine, i: int, sign: float) -> float:
        bound = relaxed.maximise(of.part([i]).times(sign * np.eye(1)), relaxed=True).bound
        return bound + MARGIN * (1 + abs(bound))

    for i in range(len(rows.Y)):
        if reach.y_high[i] > rows.upper[i]:
            reach.y_high[i] = min(reach.y_high[i], most(y, i, 1.0))
            reach.at_upper[i] = min(reach.at_upper[i], max(most(up, i, 1.0), 0.0))
        if reach.y_low[i] < rows.lower[i]:
            reach.y_low[i] = max(reach.y_low[i], -most(y, i, -1.0))
            reach.at_lower[i] = min(reach.at_lower[i], max(most(low, i, 1.0), 0.0))


def _add_rows(
    program: Program, tables: Tables, p: Affine, reach: Reach
) -> tuple[Affine, tuple[Affine, Affine, Affine]]:
    """Add multipliers, their binaries and the rows' conditions.

    Returns:
        lam, and of it y and the multipliers at upper and at lower bounds.
    """
    rows = tables.rows
    r, hard = len(rows.Y), np.isinf(rows.w)
    equal = hard & (rows.lower == rows.upper)
    possible = reach.y_high > rows.upper, reach.y_low < rows.lower
    up = program.add(np.zeros(r), np.where(possible[0] | equal, reach.at_upper, 0.0))
    low = program.add(np.zeros(r), np.where(possible[1] | equal, reach.at_lower, 0.0))
    lam = up + low.times(-np.eye(r))
    y = p.times(rows.Y) + lam.times(-tables.Q)
    program.constrain(y, reach.y_low, reach.y_high)
    program.constrain(y, np.where(hard, rows.lower, -np.inf), np.where(hard, rows.upper, np.inf))
    sides = (
        (1.0, up, reach.at_upper, rows.upper, reach.y_low, reach.y_high),
        (-1.0, low, reach.at_lower, -rows.lower, -reach.y_high, -reach.y_low),
    )
    for (sign, force, most, bound, least, largest), side in zip(sides, possible, strict=True):
        at = np.flatnonzero(side & ~equal)
        if not len(at):
            continue
        # held = 0: no force. held = 1: y at the bound or beyond it.
        held = program.add(np.zeros(len(at)), np.ones(len(at)), binary=True)
        program.constrain(force.part(at) + held.times(np.diag(-most[at])), upper=0.0)
        signed = y.part(at).times(sign * np.eye(len(at)))
        gap = np.maximum(bound[at] - least[at], 0.0)
        program.constrain(signed + held.times(np.diag(-gap)), lower=bound[at] - gap)
        # beyond = 0: y within the bound. beyond = 1: the force is the price w.
        soft = np.flatnonzero(~hard[at] & (most[at] >= rows.w[at]))
        within = np.setdiff1d(np.arange(len(at)), soft)
        program.constrain(signed.part(within), upper=bound[at][within])
        if len(soft):
            beyond = program.add(np.zeros(len(soft)), np.ones(len(soft)), binary=True)
            w, over, limit = (x[at][soft] for x in (rows.w, largest - bound, bound))
            program.constrain(force.part(at[soft]) + beyond.times(np.diag(-w)), lower=0.0)
            program.constrain(signed.part(soft) + beyond.times(np.diag(-over)), upper=limit)
    return lam, (y, up, low)
