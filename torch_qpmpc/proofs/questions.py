"""Questions about a policy on a set of states, each answered by a proof or a counterexample."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch

from torch_qpmpc.checks import check_kind
from torch_qpmpc.errors import QPError, SolverError
from torch_qpmpc.export.tables import Tables, make_tables
from torch_qpmpc.mpc.module import QPMPC
from torch_qpmpc.mpc.validation import check_no_levels
from torch_qpmpc.proofs.encoding import encode
from torch_qpmpc.proofs.plant import Plant, Polytope, check_plants
from torch_qpmpc.proofs.program import Affine, Array, Program

#: A worst case up to this counts as zero: HiGHS' feasibility tolerance is 1e-6.
TOLERANCE = 1e-5
#: A replayed worst case differs from the program's by at most this, relatively.
AGREEMENT = 1e-4
#: Combinations of models over the steps.
MOST_MODELS = 64


@dataclass(frozen=True, eq=False)
class Answer:
    """The worst case on a set.

    Attributes:
        question: the function that is maximised.
        value: its largest value that a point of the set is known to have, by `QPMPC.policy`.
        bound: no point of the set has a larger one, but for HiGHS' tolerances.
        states: the worst states p_0, .., p_k, ``(k + 1, n_p)``.
        disturbances: the worst d of each step, ``(n_d,)``.
        seconds, nodes, binaries: the effort, and the size of the largest program.
        digest: SHA-256 of the QP that it is about, as in its tables.
    """

    question: str
    value: float
    bound: float
    states: Array
    disturbances: tuple[Array, ...]
    seconds: float
    nodes: int
    binaries: int
    digest: str

    @property
    def proved(self) -> bool:
        """True if the function is nowhere positive on the set."""
        return self.bound <= TOLERANCE

    @property
    def refuted(self) -> bool:
        """True if the function is positive at ``states``."""
        return self.value > TOLERANCE

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
        seconds: time limit of each mixed-integer program.

    Raises:
        QPError: an argument is invalid, or the QP has no plan with slack in its hard rows
            somewhere on the way.
        SolverError: HiGHS gives no bound in time.

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
    rows, right = [], []
    for sign, bound in ((-1.0, lower), (1.0, upper)):
        bound = np.full(n, np.inf) if bound is None else sign * np.array(bound, float)
        if bound.shape != (n,) or np.isnan(bound).any():
            raise QPError.expected("lower and upper", f"{bound}", f"({n},) numbers")
        kept = np.isfinite(bound)
        rows.append(sign * np.eye(n)[kept])
        right.append(bound[kept])
    A, b = np.concatenate(rows), np.concatenate(right)
    if not len(b):
        raise QPError.expected("lower and upper", "no finite bound", "at least one")
    question = f"largest violation in {steps} step{'s' * (steps > 1)}"
    return _worst(question, mpc, plant, states, A, b, steps, seconds)


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
    length = np.linalg.norm(states.A, axis=1)
    question = f"outside the set after {steps} step{'s' * (steps > 1)}"
    A, b = states.A / length[:, None], states.b / length
    return _worst(question, mpc, plant, states, A, b, steps, seconds)


def largest_difference(
    first: QPMPC, second: QPMPC, states: Polytope, *, seconds: float = 60.0
) -> Answer:
    """Find the largest difference of two policies' actions, in any entry.

    Raises:
        QPError: the QPs know or do different things, or as in `largest_violation`.
        SolverError: HiGHS gives no bound in time.
    """
    n = check_states(first, states)
    check_states(second, states)
    if first.n_u != second.n_u:
        raise QPError.expected("second", f"{second.n_u} actions", f"{first.n_u}")
    program, tables = Program(), make_tables(first)
    p, vertices = _known(program, states), states.vertices()
    u, other = (encode(program, x, p, vertices) for x in (tables, make_tables(second)))
    difference = u + other.times(-np.eye(first.n_u))
    signs = np.concatenate((np.eye(first.n_u), -np.eye(first.n_u)))

    def replay(x: Array) -> tuple[Array, Array, tuple[Array, ...]]:
        at = p.at(x)
        return signs @ (action(first, at) - action(second, at)), at[None], ()

    worst = _Worst("largest difference of the policies", tables.digest, np.full((1, n), np.nan))
    worst.maximise(program, difference.times(signs), replay, seconds)
    return worst.answer()


def check_states(mpc: QPMPC, states: Polytope) -> int:
    """Return n_p; raise unless the states have that many entries."""
    check_kind("mpc", mpc, QPMPC)
    check_no_levels(mpc, "proofs")
    check_kind("states", states, Polytope, "Make one with Polytope.box(lower, upper).")
    if len(states.lower) != mpc.n_p:
        got, want = f"{len(states.lower)} dimensions", f"n_p = {mpc.n_p}"
        raise QPError.expected("states", got, want)
    return mpc.n_p


def _known(program: Program, states: Polytope) -> Affine:
    """Add p in the set of states."""
    p = program.add(states.lower, states.upper)
    if not states.is_box():
        program.constrain(p.times(states.A), upper=states.b)
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
    if steps < 1 or len(plants) ** steps > MOST_MODELS:
        got = f"{steps} steps of {len(plants)} plants"
        raise QPError.expected("steps", got, f"at least one step, and {MOST_MODELS} combinations")
    tables, program = make_tables(mpc), Program()
    start = _known(program, states)
    worst = _Worst(question, tables.digest, np.full((steps + 1, mpc.n_p), np.nan))
    for branch in _branches(program, tables, start, states.vertices(), plants, steps):

        def replay(x: Array, branch: _Branch = branch) -> tuple[Array, Array, tuple[Array, ...]]:
            noise = tuple(np.zeros(0) if d is None else d.at(x) for d in branch.noise)
            run = _replay(mpc, branch.models, start.at(x), noise)
            return A @ run[-1] - b, run, noise

        worst.maximise(branch.program, branch.p.times(A).plus(-b), replay, seconds)
    return worst.answer()


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


class _Worst:
    """The largest of several maxima, each replayed by the policies; ``run`` has no point yet."""

    def __init__(self, question: str, digest: str, run: Array) -> None:
        self.question, self.digest, self.run, self.noise = question, digest, run, ()
        self.value, self.bound, self.nodes, self.binaries = -np.inf, -np.inf, 0, 0
        self.began = time.perf_counter()

    def maximise(
        self,
        program: Program,
        rows: Affine,
        replay: Callable[[Array], tuple[Array, Array, tuple[Array, ...]]],
        seconds: float,
    ) -> None:
        """Maximise each row; ``replay`` maps variables to all rows' values, the run and its d."""
        self.binaries = max(self.binaries, program.binaries)
        for i in range(len(rows.constant)):
            maximum = program.maximise(rows.part([i]), seconds=seconds)
            self.bound, self.nodes = max(self.bound, maximum.bound), self.nodes + maximum.nodes
            if not np.isfinite(maximum.value):
                continue
            values, run, noise = replay(maximum.x)
            if abs(values[i] - maximum.value) > AGREEMENT * (1 + abs(values[i])):
                raise SolverError(
                    f"The policy gives {values[i]:.6g} where the program says {maximum.value:.6g}: "
                    "the program's tolerances are too wide for this QP. Scale the states to "
                    "numbers of order one, or lower the prices w of soft rows."
                )
            if values.max() > self.value:
                self.value, self.run, self.noise = float(values.max()), run, noise

    def answer(self) -> Answer:
        seconds = time.perf_counter() - self.began
        of = self.value, self.bound, self.run, self.noise, seconds, self.nodes, self.binaries
        return Answer(self.question, *of, self.digest)


def _reached(program: Program, p: Affine) -> Polytope:
    """Return a box that contains p, by linear programs."""
    ends = []
    for sign in (-1.0, 1.0):
        rows = p.times(sign * np.eye(len(p.constant)))
        most = [program.maximise(rows.part([i]), relaxed=True) for i in range(len(p.constant))]
        ends.append(sign * np.array([x.bound + TOLERANCE for x in most]))
    return Polytope.box(*ends)


def _replay(mpc: QPMPC, models: Sequence[Plant], p: Array, noise: Sequence[Array]) -> Array:
    """Run the policy on the plants from p; return the states."""
    states = [p]
    for model, d in zip(models, noise, strict=True):
        p = model.A @ p + model.B @ action(mpc, p) + model.offset + model.E @ d
        states.append(p)
    return np.array(states)
