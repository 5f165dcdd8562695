"""A robustly positively invariant polytope of a policy: where the state stays for ever.

Without multipliers the policy is affine, u_0 = K p + k, and p+ = A_K p + c + E d. Of the states
within X the largest set that this law never leaves, for any d, is

    O = {p: p_t in X for all t >= 0 and all d},

a polytope of the rows ``a'p <= b`` of X and of their predecessors ``(A_K'a)'p <= b - a'c - h(a)``,
h(a) = max_d a'E d, until all new ones are redundant. In O the QP's other rows may bend the policy
away from the law, so that O is a candidate, and `invariance` of the policy itself decides.

References: Gilbert and Tan (1991), "Linear systems with state and control constraints: the theory
and application of maximal output admissible sets", IEEE TAC 36; with disturbances, Kolmanovsky and
Gilbert (1998), "Theory and computation of disturbance invariant sets for discrete-time linear
systems", Mathematical Problems in Engineering 4.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linprog

from torch_qpmpc.errors import QPError, SolverError
from torch_qpmpc.export.tables import Tables, make_tables
from torch_qpmpc.mpc.module import QPMPC
from torch_qpmpc.proofs.polytope import Polytope
from torch_qpmpc.proofs.questions import (
    TOLERANCE,
    Answer,
    Plant,
    action,
    check_plants,
    check_states,
    invariance,
)

Array = np.ndarray
#: Fractions of the bounds that are tried, the largest first.
SCALES = np.arange(10, 0, -1) / 10
#: Rows of a candidate, which a law near the limit of stability would exceed.
MOST_ROWS = 500
#: Distance from its facets that the linear law keeps in a candidate: above HiGHS' tolerances.
MARGIN = 2 * TOLERANCE


@dataclass(frozen=True, eq=False)
class InvariantSet:
    """A set that the policy provably never leaves.

    Attributes:
        set: the polytope.
        scale: the fraction of the bounds within which it is the linear law's largest.
        proof: the answer of `invariance`.
    """

    set: Polytope
    scale: float
    proof: Answer


def invariant_set(
    mpc: QPMPC, plant: Plant | Sequence[Plant], states: Polytope, *, seconds: float = 60.0
) -> InvariantSet:
    """Find a set within ``states`` that the policy never leaves, for any disturbance.

    The candidates are the largest such sets of the law without multipliers, within ``states`` and
    the bounds of u, both scaled about the law's equilibrium: by 1, 0.9, .., 0.1. The first that
    `invariance` proves is returned.

    Args:
        mpc: the QP.
        plant: the plant, or several, of which each step may be any.
        states: the set to stay in, such as the states' bounds.
        seconds: time limit of each mixed-integer program.

    Raises:
        QPError: an argument is invalid, the law without multipliers does not stabilise a plant, or
            no candidate is proved.

    Example:
        >>> import torch_qpmpc as qm
        >>> A, B = [[1.0, 0.2], [0.0, 1.0]], [[0.02], [0.2]]
        >>> mpc = qm.QPMPC.from_model(
        ...     A, B, 3, stage_weight=[1.0, 1.0, 0.1], action_bounds=([-1.0], [1.0])
        ... )
        >>> noise = Polytope.box([-0.02, -0.02], [0.02, 0.02])
        >>> plant = Plant.of(A, B, disturbances=noise)
        >>> answer = invariant_set(mpc, plant, Polytope.box([-1.0, -0.5], [1.0, 0.5]))
        >>> answer.scale, answer.proof.proved
        (1.0, True)
    """
    check_states(mpc, states)
    plants, tables = check_plants(mpc, plant), make_tables(mpc)
    closed = [one.A + one.B @ tables.K for one in plants]
    radius = max(float(np.abs(np.linalg.eigvals(A)).max()) for A in closed)
    if radius >= 1:
        want = "a linear law with a spectral radius below 1"
        raise QPError.expected("mpc", f"{radius:.4g} without its inequalities", want)
    A, b = _bounds(tables, states)
    centre = _equilibrium(tables, plants[0], closed[0])
    for scale in SCALES:
        candidate = _largest(tables, plants, A, scale * b + (1 - scale) * A @ centre)
        if candidate is None:
            break
        proof = _proof(mpc, plants, candidate, seconds)
        if proof is not None and proof.proved:
            return InvariantSet(candidate, float(scale), proof)
    raise QPError.expected(
        "states",
        "a set without a part that is proved invariant",
        "one that the linear law can stay in, with these disturbances, as the policy does",
        "Allow smaller disturbances, larger states or more seconds.",
    )


def _bounds(tables: Tables, states: Polytope) -> tuple[Array, Array]:
    """Return the rows of the states and of the bounds of u without multipliers, of length 1."""
    A = np.concatenate((states.A, tables.K, -tables.K))
    b = np.concatenate((states.b, tables.u_upper - tables.k, tables.k - tables.u_lower))
    length = np.linalg.norm(A, axis=1)
    kept = np.isfinite(b) & (length > 0)
    return A[kept] / length[kept, None], b[kept] / length[kept]


def _equilibrium(tables: Tables, plant: Plant, closed: Array) -> Array:
    """Return the state at which the law without multipliers rests, at the disturbances' middle."""
    shift = plant.B @ tables.k + plant.offset
    if plant.disturbances is not None:
        shift = shift + plant.E @ (plant.disturbances.lower + plant.disturbances.upper) / 2
    return np.linalg.solve(np.eye(len(closed)) - closed, shift)


def _largest(tables: Tables, plants: list[Plant], A: Array, b: Array) -> Polytope | None:
    """Return the linear law's largest invariant set in A p <= b; None without one of few rows."""
    i = 0
    while i < len(b):
        for plant in plants:
            row = A[i] @ (plant.A + plant.B @ tables.K)
            shift = A[i] @ (plant.B @ tables.k + plant.offset) + _push(plant, A[i])
            right, most = b[i] - shift - MARGIN, _most(A, b, row)
            if most > right:
                length = float(np.linalg.norm(row)) or 1.0
                A, b = np.vstack((A, row / length)), np.append(b, right / length)
        i += 1
        if len(b) > MOST_ROWS or _most(A, b, A[0]) == -np.inf:
            return None
    kept = np.ones(len(b), bool)
    for i in range(len(b)):
        kept[i] = False
        kept[i] = _most(A[kept], b[kept], A[i]) > b[i]
    return Polytope.of(A[kept], b[kept])


def _most(A: Array, b: Array, row: Array) -> float:
    """Return the largest ``row'x`` with A x <= b: inf if unbounded, -inf if the set is empty."""
    result = linprog(-row, A, b, bounds=(None, None), method="highs")
    return -result.fun if result.status == 0 else np.inf if result.status == 3 else -np.inf


def _push(plant: Plant, row: Array) -> float:
    """Return h(row), the most that a disturbance adds to it."""
    d = plant.disturbances
    return 0.0 if d is None else _most(d.A, d.b, row @ plant.E)


def _proof(mpc: QPMPC, plants: list[Plant], candidate: Polytope, seconds: float) -> Answer | None:
    """Prove that the policy stays in the candidate; None if a vertex already refutes it."""
    p = candidate.vertices()
    try:
        u = action(mpc, p)
        for one in plants:
            push = np.array([_push(one, row) for row in candidate.A])
            after = p @ one.A.T + u @ one.B.T + one.offset
            if (after @ candidate.A.T + push > candidate.b + TOLERANCE).any():
                return None
        return invariance(mpc, plants, candidate, seconds=seconds)
    except (QPError, SolverError):  # no plan with slack somewhere in the candidate
        return None
