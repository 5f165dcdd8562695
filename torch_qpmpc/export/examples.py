"""Random states of every kind for the self-test and the comparison with an exact solver."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from torch_qpmpc.errors import QPError
from torch_qpmpc.export.reference import Reference, sharpen
from torch_qpmpc.export.tables import Array, Tables
from torch_qpmpc.export.writer import Example, Examples
from torch_qpmpc.mpc.module import QPMPC
from torch_qpmpc.qp.program import Status

#: Examples of each kind.
EACH = 3
#: Most times that an infeasible state is moved half way to the centre.
HALVINGS = 12


def draw(tables: Tables, count: int, seed: int = 0) -> Array:
    """Draw p ``(count, n_p)`` about the centre, up to ten times as far away as the bounds.

    Those nearest to reaching the bounds come first. An entry's size is a quantile, at most the
    median, over the rows that contain it, of that at which the row without multipliers is at its
    nearest bound: rows of late stages reach theirs for absurd p only. It is one for an entry
    without an effect. Constants stay, and p satisfies hard rows with equal bounds.
    """
    rng = np.random.default_rng(seed)
    pairs = zip(tables.rows.parts(), tables.known.parts(), strict=True)
    Y, lower, upper, *_ = (np.concatenate(pair) for pair in pairs)
    distances = (np.abs(x - Y @ tables.centre) for x in (lower, upper))
    near = np.minimum(*(np.where(x > 0, x, np.inf) for x in distances))
    quantiles, scale = rng.uniform(0, 0.5, count), np.ones((count, tables.n_p))
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
        for whole, part in zip(exact.parts(), solution.parts(), strict=True):
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
    examples = [
        Example(kind, p[i], codes.get(kind, 0), exact.u[i], float(exact.value[i]))
        for kind, indices in chosen.items()
        for i in indices
    ]
    return Examples(examples, _size(exact.u, solved), float(_size(exact.value, solved))), exact


def _size(x: Array, solved: Array) -> Array:
    """Return a typical size of the solved x: those of far states are larger."""
    return np.quantile(np.abs(x[solved]), 0.9, axis=0) if solved.any() else np.ones(x.shape[1:])
