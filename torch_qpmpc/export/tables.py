"""Tables of a QP whose first entries are known: all that a solver needs besides these entries p.

C z = b leaves z = T_p p + T_v v + z_b with a free v. Where H_v = T_v'H T_v is positive definite, v
and with it u_0 and the rows y = G z are affine in p and in the multipliers lam of the rows,

    y = y_free(p) - Q lam,   Q = G_v H_v^-1 G_v',   G_v = G T_v,

and the dual problem is a QP in lam alone, with -w <= lam <= w. The rows are scaled to Q_ii = 1.
"""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch

from torch_qpmpc.errors import QPError
from torch_qpmpc.mpc.levels import Levels
from torch_qpmpc.mpc.module import QPMPC
from torch_qpmpc.mpc.validation import check_one_model
from torch_qpmpc.qp.pipeline.condensing import ENTERS, null_space
from torch_qpmpc.qp.pipeline.scaling import ROUNDING, lengths
from torch_qpmpc.qp.program import EVENT_SHAPES, INFINITE, QuadraticProgram, Status, crossed
from torch_qpmpc.qp.solve import solve_qp

#: H_v is singular if its smallest eigenvalue is below this fraction of the largest.
SINGULAR = 1e-12
#: A length that is no divisor.
TINY = 1e-300
#: Weight of entries without bounds at the centre, relative to those with.
CENTRED = 1e-6
#: A bound this many times further away than another one does not act.
FAR = 1e6

Array = np.ndarray


class Rows(NamedTuple):
    """Rows ``lower <= Y p + .. <= upper`` with weights w; the offset of y is in the bounds."""

    Y: Array  # ``(r, n_p)``, y without multipliers is ``Y p``
    #: ``(r,)``, infinite where there is no bound or the row is hard.
    lower: Array
    upper: Array
    w: Array
    #: ``(r,)``, the terms of y without p and multipliers; in rows of p alone with a floor.
    size: Array
    unit: Array  # ``(r,)``, y in the units of G's row is ``unit`` times that of the table


@dataclass(frozen=True, eq=False)
class Tables:
    """The tables of a policy in float64."""

    #: The numbers of known entries and of actions.
    n_p: int
    n_u: int
    #: The rows that v changes, scaled to Q_ii = 1, and their places in G.
    rows: Rows
    places: Array
    known: Rows  # the rows that p alone determines
    Q: Array  # ``(r, r)``
    R: Array  # ``(r, d)`` with Q = R R', where d is the size of v
    #: ``(n_u, n_p)`` and ``(n_u,)``; u_0 without multipliers is ``K p + k``.
    K: Array
    k: Array
    F: Array  # ``(n_u, r)``, the response of u_0 to multipliers is ``-F lam``
    #: ``(n_p, n_p)``, ``(n_p,)`` and a number; the value without multipliers is
    #: ``p'Pp / 2 + g'p + c``.
    P: Array
    g: Array
    c: float
    #: ``(n_u,)``, the hard bounds of rows that contain one action only.
    u_lower: Array
    u_upper: Array
    condition: float  # the condition number of H_v in an orthonormal basis of the plan
    #: ``(n_p,)``, a p with a plan near the middle of its bounds, zero if there is none.
    centre: Array
    #: ``(n_p,)``, the size of an entry of p whose own cost is a half, one without a cost.
    usual: Array
    constants: Mapping[int, float]  # entries of p with one value only
    #: Those of actions, None without any, and their arrays by names in C.
    levels: Levels | None
    decisions: dict[str, Array]
    digest: str  # SHA-256 of the nine tensors of the QP


def make_tables(mpc: QPMPC) -> Tables:
    """Make the tables of the current theta.

    Raises:
        QPError: theta is not finite, has crossed bounds or dynamics, or its cost is singular on
            the plan.
    """
    check_one_model(mpc)
    qp = mpc.quadratic_program()
    H, q, c, C, b, G, lb, ub, w = (x.detach().double().cpu().numpy() for x in qp.tensors())
    _check(qp)
    n_p, n_u = mpc.n_p, mpc.n_u
    H = (H + H.T) / 2
    lb, ub = np.where(lb <= -INFINITE, -np.inf, lb), np.where(ub >= INFINITE, np.inf, ub)
    # In units of the free entries of z that equilibrate H, C and G; p, u_0 and y keep their own.
    # Rows of C are scaled by their free entries: those of p may be in any unit.
    units = lengths(H[None], np.concatenate((C, G))[None])[0]
    sizes = np.abs(C * units)
    free = sizes[:, n_p:].max(-1, initial=0.0)
    has_free = free > ROUNDING * sizes.max(-1, initial=0.0)
    units[:n_p] = 1.0
    of_C = np.where(has_free, free, np.maximum(np.abs(C * units).max(-1, initial=0.0), TINY))
    original, G, C = G, G * units, C * units / of_C[:, None]
    H, q, b = H * np.outer(units, units), q * units, b / of_C

    # z = T_p p + T_v v + z_b, with an orthonormal basis of v.
    (T,), (Y,), *_ = null_space(C[None], n_p)
    T_p, T_v, z_b = T[:, :n_p], T[:, n_p:], Y @ b
    T_v[np.abs(T_v).max(-1, initial=0.0) < ENTERS] = 0.0  # of states that nothing moves
    factor, condition = _factor(T_v.T @ H @ T_v)

    # The minimiser without inequalities, z = Z p + z_0.
    right = np.column_stack((H @ T_p, H @ z_b + q))
    v = np.linalg.solve(factor.T, np.linalg.solve(factor, T_v.T @ right))
    free = np.column_stack((T_p, z_b)) - T_v @ v
    Z, z_0 = free[:, :n_p], free[:, n_p]

    G_v = G @ T_v
    bounded = ((lb > -np.inf) | (ub < np.inf)) & (w > 0)
    enters = (np.abs(G_v) > ENTERS * (np.abs(G) @ np.abs(T).sum(-1, keepdims=True))).any(-1)
    on_plan = np.flatnonzero(bounded & enters)
    R = np.linalg.solve(factor, G_v[on_plan].T).T
    unit = np.linalg.norm(R, axis=1)
    R = R / unit[:, None]
    bounds = lb, ub, w
    rows = _rows(G[on_plan] @ Z, G[on_plan] @ z_0, unit, *(x[on_plan] for x in bounds))
    others = np.flatnonzero(bounded & ~enters)
    # The certificate's floor: |G_i|, or the smaller nonzero bound.
    near = np.minimum(*(np.where(x != 0, np.abs(x), np.inf) for x in (lb, ub)))
    parts = G @ T_p, G @ z_b, np.ones(len(G)), *bounds, np.minimum(np.abs(G).sum(-1), near)
    pairs = zip((x[others] for x in parts), _implied(C, T_p, z_b, b), strict=True)
    known = _rows(*map(np.concatenate, pairs))
    u = slice(n_p, n_p + n_u)
    u_lower, u_upper = _action_bounds(original, lb, ub, w, u)
    of_u, own, decisions = units[u], H.diagonal()[:n_p], {}
    if levels := mpc.levels:
        at = np.searchsorted(on_plan, levels.rows)
        values = (levels.values[:, None] - (G[on_plan] @ z_0)[at, None]) / unit[at, None]
        decisions = {"LEVEL": values.reshape(at.size, -1), "START_COST": levels.starts}
        decisions |= {"LEVEL_ROW": at, "LEVEL_ACTION": levels.actions, "LEAST_STEPS": levels.rules}
        places = (x.astype(np.int8) for x in levels.within(lb, ub))
        decisions |= dict(zip(("FIRST", "LAST"), places, strict=True))
    return Tables(
        n_p=n_p,
        n_u=n_u,
        rows=rows,
        places=on_plan,
        known=known,
        Q=R @ R.T,
        R=R,
        K=of_u[:, None] * Z[u],
        k=of_u * z_0[u],
        F=of_u[:, None] * np.linalg.solve(factor, T_v[u].T).T @ R.T,
        P=Z.T @ H @ Z,
        g=Z.T @ (H @ z_0 + q),
        c=float(c + (q + H @ z_0 / 2) @ z_0),
        u_lower=u_lower,
        u_upper=u_upper,
        condition=condition,
        centre=_centre(qp, n_p, mpc.scheme.constants),
        usual=np.where(own > 0, own, 1.0) ** -0.5,
        constants=mpc.scheme.constants,
        levels=levels,
        decisions=decisions,
        digest=digest(qp),
    )


def _check(qp: QuadraticProgram) -> None:
    for name, x in zip(EVENT_SHAPES, qp.tensors(), strict=True):
        if x.isnan().any() or (name not in ("lb", "ub", "w") and x.isinf().any()):
            remedy = "Export a theta that mpc.value can evaluate."
            raise QPError.expected(name, "NaN or inf", "a finite theta", remedy)
    if crossed(qp.lb, qp.ub).any():
        raise QPError.expected("lb", "entries above ub", "lb <= ub in every row")


def _factor(H_v: Array) -> tuple[Array, float]:
    """Return the Cholesky factor of H_v and its condition number."""
    eigenvalues = np.linalg.eigvalsh(H_v)
    lowest, highest = eigenvalues[0], eigenvalues[-1]
    if not lowest > SINGULAR * highest:
        got = f"eigenvalues from {lowest:.3g} to {highest:.3g} on the plan"
        want = "a cost that is positive definite on all plans that satisfy C z = b"
        remedy = "Give the actions a small weight, such as 1e-5, by stage_weight or LinearMPC's R, "
        remedy += "and learn H with it: without one, u_0 is not unique, nor the C exact."
        raise QPError.expected("H", got, want, remedy)
    return np.linalg.cholesky(H_v), float(highest / lowest)


def _rows(
    Y: Array, y_0: Array, unit: Array, lb: Array, ub: Array, w: Array, least: Array | float = 0.0
) -> Rows:
    upper = np.maximum(lb, ub)  # bounds that cross by rounding are equal
    below, above, size = (lb - y_0) / unit, (upper - y_0) / unit, (least + np.abs(y_0)) / unit
    return Rows(Y / unit[:, None], below, above, w * unit, size, unit)


def _implied(C: Array, T_p: Array, z_b: Array, b: Array) -> tuple[Array, ...]:
    """Return the `_rows` of p that remain of C z = b if it has dependent rows on the plan.

    The rounding of T_p and z_b is a fraction of their largest entries, and not of a row's.
    """
    Y, y_0 = C @ T_p, C @ z_b
    size = np.abs(C).sum(-1) * (np.abs(T_p).sum(-1) + np.abs(z_b)).max() + np.abs(b)
    remain = np.maximum(np.abs(Y).max(-1, initial=0), np.abs(y_0 - b)) > 1e-9 * size
    b, hard = b[remain], np.full(remain.sum(), np.inf)
    return Y[remain], y_0[remain], np.ones(len(b)), b, b, hard, size[remain]


def _action_bounds(G: Array, lb: Array, ub: Array, w: Array, u: slice) -> tuple[Array, Array]:
    """Return the tightest bounds of u_0 by hard rows that contain one of its entries only."""
    lower, upper = (np.full(u.stop - u.start, side * np.inf) for side in (-1, 1))
    for i in np.flatnonzero(np.isinf(w) & ((G != 0).sum(-1) == 1)):
        (j,) = np.flatnonzero(G[i])
        if u.start <= j < u.stop:
            ends = sorted((lb[i] / G[i, j], ub[i] / G[i, j]))
            lower[j - u.start] = max(lower[j - u.start], ends[0])
            upper[j - u.start] = min(upper[j - u.start], ends[1])
    return lower, upper


@torch.no_grad()
def _centre(qp: QuadraticProgram, n_p: int, constants: Mapping[int, float]) -> Array:
    """Return the p of the plan whose bounded rows are nearest to the middle of their bounds."""
    names = ("C", "b", "G", "lb", "ub", "w")
    C, b, G, lb, ub, w = (getattr(qp, name).detach().double().cpu() for name in names)
    half = (ub - lb) / 2
    rows = half.isfinite() & (half > 0) & (w > 0)
    rows &= ~torch.from_numpy(far(half.numpy(), rows.numpy()))
    weighted = G[rows] / half[rows, None].square()
    H = weighted.mT @ G[rows]
    H = H + CENTRED * max(float(H.diagonal().mean()), 1.0) * torch.eye(len(H)).to(H)
    q = -weighted.mT @ (lb + half)[rows]
    middle = QuadraticProgram(H, q, q.new_zeros(()), C, b, G, lb, ub, w, check_values=False)
    solution = solve_qp(middle, solver="daqp", on_failure="mask")
    p = (solution.z if solution.status == Status.SOLVED else torch.zeros_like(q))[:n_p].numpy()
    p[[*constants]] = [*constants.values()]
    return p


def far(sizes: Array, of: Array) -> Array:
    """Return the mask of sizes of bounds that cannot act beside the small ones among ``of``."""
    return sizes > FAR * (np.quantile(sizes[of], 0.1) if of.any() else np.inf)


def digest(qp: QuadraticProgram) -> str:
    """Return the SHA-256 of the nine tensors of a QP."""
    total = hashlib.sha256()
    for name, x in zip(EVENT_SHAPES, qp.tensors(), strict=True):
        total.update(f"{name}{tuple(x.shape)}".encode())
        total.update(x.detach().double().cpu().contiguous().numpy().tobytes())
    return total.hexdigest()
