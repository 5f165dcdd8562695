"""A robustly positively invariant polytope of a policy: where the state stays for ever.

The candidates are the largest such sets O of the affine law without multipliers, u(p) = K p + k,
saturated by the bounds of u: all p from which no law ``u_c + theta (u - u_c)`` of each saturated
u_i leaves the bounds, u_c the action at the equilibrium. O has the rows ``a'p <= b`` of the bounds
and of their predecessors ``(A_j'a)'p <= b - a'c_j - h(a)`` by each law ``p+ = A_j p + c_j + E d``,
h(a) = max_d a'E d, until all new ones are redundant. The QP does not just saturate its affine law:
`invariance` of the policy itself decides.

References: Gilbert and Tan (1991), IEEE TAC 36; with disturbances, Kolmanovsky and Gilbert (1998),
Mathematical Problems in Engineering 4; saturated, Hu, Lin and Chen (2002), Systems & Control
Letters 45.
"""

import itertools
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from torch_qpmpc.errors import QPError, SolverError
from torch_qpmpc.export.tables import Tables, make_tables
from torch_qpmpc.mpc.module import QPMPC
from torch_qpmpc.proofs.plant import Plant, Polytope, check_plants, positive, support
from torch_qpmpc.proofs.program import Array, Program
from torch_qpmpc.proofs.questions import TOLERANCE, Answer, action, check_states, invariance

#: Fractions of the bounds that are tried, the largest first.
SCALES = (1.0, 0.8, 0.6, 0.4, 0.2)
#: Fractions theta of the gain of a saturated law, all of them at each scale.
GAINS = (1.0, 1 / 4, 1 / 16)
#: Rows of a candidate, which a law near the limit of stability would exceed.
MOST_ROWS = 200
#: Distance from its facets that the linear law keeps in a candidate: above HiGHS' tolerances.
MARGIN = 2 * TOLERANCE


@dataclass(frozen=True, eq=False)
class InvariantSet:
    """A set that the policy provably never leaves.

    Attributes:
        set: the polytope.
        scale: the fraction of the bounds within which it is the saturated law's largest.
        gain: theta, the fraction of the law's gain that keeps these bounds of u.
        proof: the answer of `invariance`.
    """

    set: Polytope
    scale: float
    gain: float
    proof: Answer


def invariant_set(
    mpc: QPMPC, plant: Plant | Sequence[Plant], states: Polytope, *, seconds: float = 60.0
) -> InvariantSet:
    """Find a set within ``states`` that the policy never leaves, for any disturbance.

    The candidates are the largest such sets of the law without multipliers, saturated, within
    ``states`` and the bounds of u, both scaled about the law's equilibrium: by 1, 0.8, .., 0.2. The
    first that `invariance` proves is returned.

    Args:
        mpc: the QP.
        plant: the plant, or several, of which each step may be any.
        states: the set to stay in, such as the states' bounds.
        seconds: time limit, of which each proof may take half of what is left.

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
    until = Program(seconds).until
    plants, tables = check_plants(plant, mpc.n_p, mpc.n_u), make_tables(mpc)
    laws = _laws(tables, plants, np.zeros(mpc.n_u), 1.0)
    if (radius := _radius(laws)) >= 1:
        want = "a linear law with a spectral radius below 1"
        raise QPError.expected("mpc", f"{radius:.4g} without its inequalities", want)
    centre = _equilibrium(laws[0])
    u = tables.K @ centre + tables.k
    for scale, gain in itertools.product(SCALES, GAINS):
        laws, left = _laws(tables, plants, u, gain), until - time.perf_counter()
        if _radius(laws) >= 1 or left <= 0:
            continue
        A, b = _bounds(tables, states, u, gain)
        candidate = _largest(laws, A, scale * b + (1 - scale) * A @ centre, positive(states.size))
        if candidate and (proof := _proof(mpc, plants, candidate, left / 2)) and proof.proved:
            return InvariantSet(candidate, scale, gain, proof)
    got = f"a set without a part that is proved invariant about p = {centre}, u = {u}"
    want = "one that the linear law can stay in, with these disturbances, as the policy does"
    remedy = "Allow smaller disturbances, larger states or more seconds."
    raise QPError.expected("states", got, want, remedy)


def _laws(tables: Tables, plants: list[Plant], u: Array, gain: float) -> list[Plant]:
    """Return the plants in a loop with the affine law, each bounded u_i by itself or ``gain``."""
    bounded = np.isfinite(tables.u_lower) | np.isfinite(tables.u_upper)
    laws = []
    for gains in itertools.product(*[{1.0, gain} if one else {1.0} for one in bounded]):
        K, k = np.diag(gains) @ tables.K, u + gains * (tables.k - u)
        laws += [replace(x, A=x.A + x.B @ K, offset=x.B @ k + x.offset) for x in plants]
    return laws


def _radius(laws: list[Plant]) -> float:
    return max(float(np.abs(np.linalg.eigvals(law.A)).max()) for law in laws)


def _equilibrium(law: Plant) -> Array:
    """Return the state at which a law rests, at the disturbances' middle."""
    shift = law.offset
    if law.disturbances is not None:
        shift = shift + law.E @ (law.disturbances.lower + law.disturbances.upper) / 2
    return np.linalg.solve(np.eye(len(shift)) - law.A, shift)


def _bounds(tables: Tables, states: Polytope, u: Array, gain: float) -> tuple[Array, Array]:
    """Return rows of the states, and of the bounds of ``u + gain (K p + k - u)``, of length 1."""
    K, k = gain * tables.K, u + gain * (tables.k - u)
    A = np.concatenate((states.A, K, -K))
    b = np.concatenate((states.b, tables.u_upper - k, k - tables.u_lower))
    length = np.linalg.norm(A * positive(states.size), axis=1)
    kept = np.isfinite(b) & (length > 0)
    return A[kept] / length[kept, None], b[kept] / length[kept]


def _largest(laws: list[Plant], A: Array, b: Array, unit: Array) -> Polytope | None:
    """Return the largest set in A p <= b that no law leaves; None without one of few rows."""
    i = 0
    while i < len(b):
        for law in laws:
            row = A[i] @ law.A
            right = b[i] - A[i] @ law.offset - _push(law, A[i]) - MARGIN
            reached = support(A, b, row)
            if reached == -np.inf or not np.isfinite(right) or len(b) > MOST_ROWS:
                return None
            if not reached <= right:  # undecided ones are kept
                length = float(np.linalg.norm(row * unit)) or 1.0
                A, b = np.vstack((A, row / length)), np.append(b, right / length)
        i += 1
    kept = np.ones(len(b), bool)
    for i in range(len(b)):
        kept[i] = False
        kept[i] = not support(A[kept], b[kept], A[i]) <= b[i]
    return Polytope.of(A[kept], b[kept])


def _push(plant: Plant, row: Array) -> float:
    """Return h(row), the most that a disturbance adds to it."""
    d = plant.disturbances
    return 0.0 if d is None else support(d.A, d.b, row @ plant.E)


def _proof(mpc: QPMPC, plants: list[Plant], candidate: Polytope, seconds: float) -> Answer | None:
    """Prove that the policy stays in the candidate; None if a vertex refutes it or if undecided."""
    try:
        p = candidate.vertices()
        u = action(mpc, p)
        for one in plants:
            push = np.array([_push(one, row) for row in candidate.A])
            after = p @ one.A.T + u @ one.B.T + one.offset
            if (after @ candidate.A.T + push > candidate.b + TOLERANCE).any():
                return None
        return invariance(mpc, plants, candidate, seconds=seconds)
    except (QPError, SolverError):  # flat, without a plan with slack somewhere, or out of time
        return None
