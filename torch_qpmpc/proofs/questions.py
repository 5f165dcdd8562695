"""Questions about a policy on a set of states, each answered by a proof or a counterexample."""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch

from torch_qpmpc.checks import check_kind, check_whole
from torch_qpmpc.errors import QPError, SolverError
from torch_qpmpc.export.tables import Tables, make_tables
from torch_qpmpc.mpc.module import QPMPC
from torch_qpmpc.mpc.validation import check_no_levels, read_numbers
from torch_qpmpc.proofs.encoding import encode
from torch_qpmpc.proofs.plant import Plant, Polytope, check_plants, positive
from torch_qpmpc.proofs.program import Affine, Array, Program

#: A worst case up to this, relative to the set, counts as zero: HiGHS' tolerance is 1e-6.
TOLERANCE = 1e-5
#: Combinations of models over the steps.
MOST_MODELS = 64


@dataclass(eq=False)
class Answer:
    """The worst case on a set.

    Attributes:
        question: the function that is maximised.
        proved: it is nowhere positive on the set, but for 1e-5 of the set's size.
        refuted: it exceeds that at some state.
        value: its largest value that a point of the set is known to have, by `QPMPC.policy`.
        bound: no point of the set has a larger one, but for HiGHS' tolerances.
        states: the worst states p_0, .., p_k, ``(k + 1, n_p)``.
        disturbances: the worst d of each step, ``(n_d,)``.
        seconds, nodes, binaries: HiGHS' effort, and the size of the largest program.
        digest: SHA-256 of the QP that it is about, as in its tables.
    """

    question: str
    digest: str
    states: Array
    disturbances: tuple[Array, ...] = ()
    proved: bool = True
    refuted: bool = False
    value: float = -np.inf
    bound: float = -np.inf
    seconds: float = 0.0
    nodes: int = 0
    binaries: int = 0

    def __str__(self) -> str:
        outcome = f"undecided, between {self.value:.4g} and {self.bound:.4g}"
        if self.proved:
            outcome = f"proved, at most {self.bound:.3g}"
        elif self.refuted:
            at = np.array2string(self.states[0], precision=4, separator=", ")
            outcome = f"{self.value:.4g} from p = {at}"
        effort = f"{self.seconds:.1f} s, {self.nodes:,} nodes, {self.binaries} binaries"
        return f"{self.question}: {outcome} ({effort})"


def largest_violation(
    mpc: QPMPC,
    plant: Plant | Sequence[Plant],
    states: Polytope,
    lower: Any = None,
    upper: Any = None,
    *,
    steps: int = 1,
    seconds: float = 60.0,
) -> Answer:
    """Find the largest violation of bounds of the state after ``steps`` steps.

    Args:
        mpc: the QP.
        plant: the plant; of several, each step may be any, which also covers their convex hull
            for one step.
        states: the set of p_0.
        lower, upper: bounds of p_steps, ``(n_p,)``; None or inf for no bound.
        steps: the number of steps.
        seconds: time limit, after which what is left stays undecided.

    Raises:
        QPError: an argument is invalid, or the QP has no plan with slack in its hard rows
            somewhere on the way.
        SolverError: prices are too high for HiGHS, or it does not bound the states in time.

    Example:
        >>> import torch_qpmpc as qm
        >>> A, B = [[1.0, 0.2], [0.0, 1.0]], [[0.0], [0.2]]
        >>> mpc = qm.QPMPC.from_model(
        ...     A, B, 3, stage_weight=[1.0, 1.0, 0.1], action_bounds=([-1.0], [1.0])
        ... )
        >>> box = Polytope.box([-1.0, -0.5], [1.0, 0.5])
        >>> largest_violation(mpc, Plant.of(A, B), box, upper=[1.2, 0.6]).proved
        True
    """
    n = check_states(mpc, states)
    lower = read_numbers("lower", [-np.inf] * n if lower is None else lower).numpy()
    upper = read_numbers("upper", [np.inf] * n if upper is None else upper).numpy()
    if not (lower.shape == upper.shape == (n,) and np.minimum(-lower, upper).min() > -np.inf):
        want = f"({n},) numbers, below inf and above -inf"
        raise QPError.expected("lower and upper", f"{lower} and {upper}", want)
    A, b = np.concatenate((-np.eye(n), np.eye(n))), np.concatenate((-lower, upper))
    if not (kept := np.isfinite(b)).any():
        raise QPError.expected("lower and upper", "no finite bound", "at least one")
    return _worst("largest violation in", mpc, plant, states, A[kept], b[kept], steps, seconds)


def invariance(
    mpc: QPMPC,
    plant: Plant | Sequence[Plant],
    states: Polytope,
    *,
    steps: int = 1,
    seconds: float = 60.0,
) -> Answer:
    """Prove that p is in the set again after ``steps`` steps, or find a p that leaves it.

    The answer's value is the distance from the worst facet. Arguments and errors are those of
    `largest_violation`.
    """
    check_states(mpc, states)
    length = positive(np.linalg.norm(states.A, axis=1))
    A, b = states.A / length[:, None], states.b / length
    return _worst("outside the set after", mpc, plant, states, A, b, steps, seconds)


def largest_difference(
    first: QPMPC, second: QPMPC, states: Polytope, *, seconds: float = 60.0
) -> Answer:
    """Find the largest difference of two policies' actions, in any entry.

    Raises:
        QPError: the QPs know or do different things, or as in `largest_violation`.
        SolverError: as there.
    """
    n = max(check_states(one, states) for one in (first, second))
    if first.n_u != second.n_u:
        raise QPError.expected("second", f"{second.n_u} actions", f"{first.n_u}")
    program, tables = Program(seconds), [make_tables(x) for x in (first, second)]
    p, vertices = _known(program, states), states.vertices()
    u, other = (encode(program, x, p, vertices) for x in tables)
    signs = np.concatenate((np.eye(first.n_u), -np.eye(first.n_u)))
    rows = u.times(signs) + other.times(-signs)

    def replay(x: Array) -> tuple[Array, Array, tuple[Array, ...]]:
        at = p.at(x)
        return signs @ (action(first, at) - action(second, at)), at[None], ()

    answer = Answer("largest difference of the policies", tables[0].digest, np.full((1, n), np.nan))
    free = [np.abs(x.K) @ states.size + np.abs(x.k) for x in tables]
    bounds = [np.maximum(np.abs(x.u_lower), np.abs(x.u_upper)) for x in tables]
    sizes = np.tile(positive(np.minimum(free, bounds).max(0)), 2)
    _maximise(answer, program, rows, sizes, replay)
    return answer


def check_states(mpc: QPMPC, states: Polytope) -> int:
    """Return n_p; raise unless the states have that many entries."""
    check_kind("mpc", mpc, QPMPC)
    check_no_levels(mpc, "proofs")
    check_kind("states", states, Polytope, "Make one with Polytope.box(lower, upper).")
    if len(states.lower) != mpc.n_p:
        raise QPError.expected("states", f"{len(states.lower)} dimensions", f"n_p = {mpc.n_p}")
    return mpc.n_p


def _known(program: Program, states: Polytope) -> Affine:
    """Add p in the set of states."""
    unit = positive(states.size)
    size = positive(np.abs(states.A) @ unit)
    p = program.add(states.lower / unit, states.upper / unit).times(np.diag(unit))
    if not states.is_box():
        program.constrain(p.times(states.A / size[:, None]), upper=states.b / size)
    return p


def action(mpc: QPMPC, p: Array) -> Array:
    """Return the policy's u_0 ``(*batch, n_u)`` at p ``(*batch, n_p)``."""
    with torch.no_grad():
        return mpc.policy(torch.as_tensor(p, dtype=torch.float64)).numpy()


def _worst(
    question: str,
    mpc: QPMPC,
    plant: Plant | Sequence[Plant],
    states: Polytope,
    A: Array,
    b: Array,
    steps: int,
    seconds: float,
) -> Answer:
    """Maximise ``max_i A_i p_steps - b_i`` over the set, the disturbances and the plants."""
    plants = check_plants(plant, mpc.n_p, mpc.n_u)
    check_whole("steps", steps, 1)
    if len(plants) ** steps > MOST_MODELS:
        got, want = f"{steps} steps of {len(plants)} plants", f"{MOST_MODELS} combinations"
        raise QPError.expected("steps", got, want)
    tables, program = make_tables(mpc), Program(seconds)
    start = _known(program, states)
    question += f" {steps} step{'s' * int(steps > 1)}"
    answer = Answer(question, tables.digest, np.full((steps + 1, mpc.n_p), np.nan))
    sizes = positive(np.abs(A) @ states.size, positive(np.abs(b)))
    for branch in _branches(program, tables, start, states.vertices(), plants, steps):

        def replay(x: Array, branch: _Branch = branch) -> tuple[Array, Array, tuple[Array, ...]]:
            noise = tuple(np.zeros(0) if d is None else d.at(x) for d in branch.noise)
            run = [start.at(x)]
            for model, d in zip(branch.models, noise, strict=True):
                u = action(mpc, run[-1])
                run.append(model.A @ run[-1] + model.B @ u + model.offset + model.E @ d)
            return A @ run[-1] - b, np.array(run), noise

        _maximise(answer, branch.program, branch.p.times(A).plus(-b), sizes, replay)
    return answer


class _Branch(NamedTuple):
    """A program of one plant for each step, its last p, the plants and their disturbances."""

    program: Program
    p: Affine
    models: tuple[Plant, ...]
    noise: tuple[Affine | None, ...]


def _branches(
    program: Program, tables: Tables, p: Affine, vertices: Array, plants: list[Plant], steps: int
) -> Iterator[_Branch]:
    """Add ``steps`` steps of the policy and each plant from p, in the hull of ``vertices``."""
    u = encode(program, tables, p, vertices)
    for model in plants:
        branch = program.copy()
        following = (p.times(model.A) + u.times(model.B)).plus(model.offset)
        d = None if model.disturbances is None else _known(branch, model.disturbances)
        if d is not None:
            following = following + d.times(model.E)
        if steps == 1:
            yield _Branch(branch, following, (model,), (d,))
            continue
        reached = _reached(branch, following).vertices()
        for rest in _branches(branch, tables, following, reached, plants, steps - 1):
            yield rest._replace(models=(model, *rest.models), noise=(d, *rest.noise))


def _maximise(
    answer: Answer,
    program: Program,
    rows: Affine,
    sizes: Array,
    replay: Callable[[Array], tuple[Array, Array, tuple[Array, ...]]],
) -> None:
    """Maximise rows of these sizes; ``replay`` maps variables to all rows, the run and its d."""
    began, answer.binaries = time.perf_counter(), max(answer.binaries, program.binaries)
    for i in range(len(rows.constant)):
        maximum = program.maximise(rows.part([i]))
        answer.bound, answer.nodes = max(answer.bound, maximum.bound), answer.nodes + maximum.nodes
        answer.proved &= bool(maximum.bound <= TOLERANCE * sizes[i])
        if not np.isfinite(maximum.value):
            continue
        values, run, noise = replay(maximum.x)
        if values[i] > maximum.bound + 10 * TOLERANCE * (sizes[i] + abs(values[i])):
            raise SolverError(
                f"The policy gives {values[i]:.6g} where the program says {maximum.bound:.6g} at "
                "most: its tolerances are too wide for this QP. Lower the prices w of soft rows."
            )
        answer.refuted |= bool((values > TOLERANCE * sizes).any())
        if values.max() > answer.value:
            answer.value, answer.states, answer.disturbances = float(values.max()), run, noise
    answer.seconds += time.perf_counter() - began


def _reached(program: Program, p: Affine) -> Polytope:
    """Return a box that contains p, by linear programs."""
    ends, sizes = [], np.abs(p.matrix).sum(1) + np.abs(p.constant)
    for sign in (-1.0, 1.0):
        rows = [p.times(sign * row[None]) for row in np.eye(len(sizes))]
        most = [program.maximise(row, relaxed=True).bound for row in rows]
        if np.isinf(most).any():
            raise SolverError("HiGHS does not bound the states in time: allow more seconds.")
        ends.append(sign * (np.array(most) + TOLERANCE * sizes))
    return Polytope.box(*ends)
