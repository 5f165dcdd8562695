"""Proofs by regions: a set grown from starts until the policy never leaves it, and V's descent.

Where `explicit_law` lists the regions, a question about one step is a finite number of small
problems, one for each region, or for each pair of a region and the next state's. An affine function
of the next state is largest at a vertex of a region, and a quadratic one at a point where its
gradient vanishes along some face.

A set is grown from starts by steps of all its states: of ``{p: A p <= b}`` with fixed directions A,
each b is raised to the largest value of its row one step later, until none is (template polyhedra,
as in abstract interpretation). The result contains all that can be reached from the starts, and
the policy never leaves it.

Reference: Sankaranarayanan, Dang and Ivančić (2008), "Symbolic model checking of hybrid systems
using template polyhedra", TACAS.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.linalg import null_space

from torch_qpmpc.checks import check_kind
from torch_qpmpc.errors import QPError
from torch_qpmpc.export.tables import make_tables
from torch_qpmpc.mpc.module import QPMPC
from torch_qpmpc.proofs.choices import Region
from torch_qpmpc.proofs.explicit import INSIDE, ExplicitLaw, size_of
from torch_qpmpc.proofs.plant import Plant, check_plants
from torch_qpmpc.proofs.polytope import Body, Polytope, facets, support
from torch_qpmpc.proofs.questions import (
    TOLERANCE,
    Answer,
    action,
    compare_replay,
)

Array = np.ndarray
#: Steps after which a growing set is given up.
MOST_STEPS = 500
#: Entries of the directions of a set, before they are scaled.
DIRECTIONS = (-1.0, -0.5, 0.0, 0.5, 1.0)
#: Rows of p+ that change by less than this with p do not bound it.
CONSTANT = 1e-9
#: Regions with a smaller share of the set's volume can be missing.
MISSING = 1e-6


def grown_set(
    law: ExplicitLaw,
    plant: Plant | Sequence[Plant],
    starts: Polytope,
    *,
    directions: Any = None,
) -> Polytope:
    """Return a set that contains the starts and that the policy never leaves.

    Args:
        law: the explicit law of all known entries.
        plant: the plant, or several, of which each step may be any.
        starts: a subset of the law's set, with an interior.
        directions: rows of the set, ``(m, n_p)``; by default 16 of two entries and 98 of three.

    Raises:
        QPError: an argument is invalid, the law's regions leave a hole, or the set grows out of the
            law's set.

    Example:
        >>> import torch_qpmpc as qm
        >>> from torch_qpmpc.proofs import explicit_law
        >>> A, B = [[1.0, 0.2], [0.0, 1.0]], [[0.02], [0.2]]
        >>> mpc = qm.QPMPC.from_model(
        ...     A, B, 3, stage_weight=[1.0, 1.0, 0.1], action_bounds=([-1.0], [1.0])
        ... )
        >>> law = explicit_law(mpc, Polytope.box([-1.0, -1.0], [1.0, 1.0]))
        >>> plant = Plant.of(A, B, disturbances=Polytope.box([-0.01] * 2, [0.01] * 2))
        >>> grown = grown_set(law, plant, Polytope.box([-0.3] * 2, [0.3] * 2))
        >>> grown.upper.round(2)
        array([0.46, 0.3 ])
    """
    plants, n = _check(law, plant, "starts", starts), len(law.origin)
    if directions is None:
        grid = np.array([x for x in itertools.product(DIRECTIONS, repeat=n) if 1 in map(abs, x)])
        directions = grid / (law.set.upper - law.set.lower)
    A = np.array(directions, float)
    if A.shape[1:] != (n,) or not np.isfinite(A).all() or not A.any(1).all():
        got = f"{directions}"
        raise QPError.expected("directions", got, f"finite rows (m, {n}) that are not zero")
    A = A / np.linalg.norm(A, axis=1, keepdims=True)
    b = np.array([support(starts.A, starts.b, row) for row in A])
    pushes = [_pushes(one, A) for one in plants]
    for step in range(MOST_STEPS):
        if (worst := _outside(law, A, b)) == np.inf:
            raise QPError.expected("directions", "an unbounded set", "rows that bound one")
        if worst > INSIDE * size_of(law.set):
            got = f"a set that grows out of the law's set by {worst:.3g} in {step} steps"
            want = "a law on a larger set, smaller disturbances or more directions"
            raise QPError.expected("starts", got, want)
        reached = np.max(
            [_reached(law, x, A, b, A) + d for x, d in zip(plants, pushes, strict=True)], axis=0
        )
        if (reached + TOLERANCE <= b).all():
            return Polytope.of(A, b)
        b = np.maximum(b, reached + 2 * TOLERANCE)
    got = f"a set that still grows after {MOST_STEPS} steps"
    raise QPError.expected("starts", got, "a policy that contracts it")


def _check(
    law: ExplicitLaw, plant: Plant | Sequence[Plant], name: str, states: Polytope
) -> list[Plant]:
    """Return the plants; raise unless the regions know the law at all of the states."""
    check_kind("law", law, ExplicitLaw)
    n = len(law.origin)
    if law.basis.shape != (n, n) or (law.basis != np.eye(n)).any() or law.origin.any():
        raise QPError.expected("law", "a slice of the known entries", "all of them")
    plants = check_plants(plant, n, law.tables.n_u)
    check_kind(name, states, Polytope, "Make one with Polytope.box(lower, upper).")
    if len(states.lower) != n:
        raise QPError.expected(name, f"{len(states.lower)} dimensions", f"n_p = {n}")
    if (worst := _outside(law, states.A, states.b)) > INSIDE * size_of(law.set):
        got, remedy = f"states outside the law's set by {worst:.3g}", "Compute it on a larger set."
        raise QPError.expected(name, got, "a subset of it", remedy)
    if facets(states.A, states.b) is None:
        raise QPError.expected(name, "a flat set", "a set with an interior")
    if law.covered < 1 or law.volume < 1 - MISSING:
        got = f"regions of {law.covered:.2%} of its random states, and {law.volume:.6f} of its set"
        raise QPError.expected("law", got, "regions of all of them")
    return plants


def _outside(law: ExplicitLaw, A: Array, b: Array) -> float:
    """Return how far ``A p <= b`` leaves the law's set."""
    pairs = zip(law.set.A, law.set.b, strict=True)
    return max(support(A, b, row) - limit for row, limit in pairs)


def _reached(law: ExplicitLaw, plant: Plant, A: Array, b: Array, rows: Array) -> Array:
    """Return the largest ``rows p+`` from any p of ``A p <= b``, without disturbances."""
    most = np.full(len(rows), -np.inf)
    for region in law.regions:
        p = _common(region, A, b)
        after = p @ plant.A.T + (p @ region.K.T + region.k) @ plant.B.T + plant.offset
        most = np.maximum(most, (after @ rows.T).max(0, initial=-np.inf))
    return most


def _pushes(plant: Plant, rows: Array) -> Array:
    """Return the most that a disturbance adds to each row."""
    if (d := plant.disturbances) is None:
        return np.zeros(len(rows))
    return (d.vertices() @ plant.E.T @ rows.T).max(0)


def _common(region: Region, A: Array, b: Array) -> Array:
    """Return the vertices of a region's part in ``A p <= b``."""
    values = region.vertices @ A.T
    if (values.max(0) <= b).all():
        return region.vertices
    body = None
    if (values.min(0) < b).all():
        body = facets(np.concatenate((region.set.A, A)), np.append(region.set.b, b))
    return np.zeros((0, A.shape[1])) if body is None else body.vertices


def largest_increase(
    mpc: QPMPC,
    law: ExplicitLaw,
    plant: Plant,
    states: Polytope,
    *,
    weight: Any = None,
) -> Answer:
    """Find the largest ``V(p+) - V(p) + p'W p / 2`` of a set of states, with any disturbance.

    V is a Lyapunov function of the policy on the set if it is at most zero, and the descent is as
    fast as the stage cost if W is its weight. V is convex, so that the worst disturbance is a
    vertex. Each pair of a region of p and one of p+ is a quadratic program of few entries, which
    is not convex and is solved by its faces.

    Args:
        mpc: the QP.
        law: its explicit law, as it is now, on a set that p+ does not leave.
        plant: the plant.
        states: a subset of the law's set, with an interior.
        weight: W, ``(n_p, n_p)``; zero by default.

    Raises:
        QPError: an argument is invalid, the law is that of another QP or its regions leave a hole,
            or p+ can leave the law's set.

    Example:
        >>> import torch_qpmpc as qm
        >>> from torch_qpmpc.proofs import explicit_law
        >>> A, B = [[1.0, 0.2], [0.0, 1.0]], [[0.02], [0.2]]
        >>> mpc = qm.QPMPC.linear_mpc(
        ...     A, B, 5, stage_weight=[1.0, 1.0, 0.1], action_bounds=([-1.0], [1.0]), gamma=1.0
        ... )
        >>> law = explicit_law(mpc, Polytope.box([-1.5, -1.5], [1.5, 1.5]))
        >>> box = Polytope.box([-1.0, -0.5], [1.0, 0.5])
        >>> largest_increase(mpc, law, Plant.of(A, B), box).proved
        True
    """
    began = time.perf_counter()
    check_kind("mpc", mpc, QPMPC)
    check_kind("plant", plant, Plant, "Make one with Plant.of(A, B).")
    _check(law, plant, "states", states)
    if make_tables(mpc).digest != law.tables.digest:
        remedy = "Compute the law of this QP, after it has learned."
        raise QPError.expected("law", "that of another QP", "that of mpc", remedy)
    n = len(law.origin)
    W = np.zeros((n, n)) if weight is None else np.array(weight, float)
    if W.shape != (n, n):
        raise QPError.expected("weight", f"shape {W.shape}", f"({n}, {n})")
    left = _reached(law, plant, states.A, states.b, law.set.A) + _pushes(plant, law.set.A)
    left -= law.set.b
    if left.max() > INSIDE * size_of(law.set):
        got, remedy = f"p+ outside it by {left.max():.3g}", "Compute the law on a larger set."
        raise QPError.expected("law", got, "a law of all next states", remedy)
    d = plant.disturbances
    pushes = np.zeros((1, n)) if d is None else d.vertices() @ plant.E.T
    worst, at, push = -np.inf, np.zeros(n), 0
    for x in _transitions(law, plant, states, pushes):
        P = x.A.T @ x.following.P @ x.A - x.region.P + W
        shift = x.following.P @ x.c
        g = x.A.T @ (shift + x.following.g) - x.region.g
        value, p = _largest(P, g, x.pair)
        value += float((shift / 2 + x.following.g) @ x.c) + x.following.c - x.region.c
        if value > worst:
            worst, at, push = value, p, x.push
    following = plant.A @ at + plant.B @ action(mpc, at) + plant.offset + pushes[push]
    run = np.array([at, following])
    with torch.no_grad():
        V = mpc.value(torch.as_tensor(run)).numpy()
    replayed = float(V[1] - V[0] + at @ W @ at / 2)
    compare_replay(replayed, worst)
    noise = () if d is None else (d.vertices()[push],)
    effort = time.perf_counter() - began, 0, 0
    question = "largest increase of V"
    return Answer(question, replayed, worst, run, noise, *effort, law.tables.digest)


class _Transition(NamedTuple):
    """The p of a region whose ``p+ = A p + c`` is in another one, with a disturbance."""

    pair: Body
    region: Region
    following: Region
    A: Array
    c: Array
    push: int


def _transitions(
    law: ExplicitLaw, plant: Plant, states: Polytope, pushes: Array
) -> Iterator[_Transition]:
    for region in law.regions:
        own = facets(np.concatenate((region.set.A, states.A)), np.append(region.set.b, states.b))
        if own is None:
            continue
        A = plant.A + plant.B @ region.K
        for i, push in enumerate(pushes):
            c = plant.B @ region.k + plant.offset + push
            after = own.vertices @ A.T + c
            for other in law.regions:
                if ((after @ other.set.A.T).min(0) >= other.set.b).any():
                    continue
                rows = np.concatenate((own.A, other.set.A @ A))
                right = np.append(own.b, other.set.b - other.set.A @ c)
                varies = np.abs(rows).max(1) > CONSTANT
                pair = None if (right[~varies] < 0).any() else facets(rows[varies], right[varies])
                if pair is not None:
                    yield _Transition(pair, region, other, A, c, i)


def _largest(P: Array, g: Array, body: Body) -> tuple[float, Array]:
    """Maximise ``p'Pp / 2 + g'p`` over a polytope: at a vertex, or where it is flat along a face.

    Along a face without a unique maximum it is as large at the face's boundary.
    """
    points, n = [body.vertices], len(g)
    slack = INSIDE * np.ptp(body.vertices, axis=0).max()
    for size in range(n):
        for on in itertools.combinations(range(len(body.b)), size):
            A, b = body.A[list(on)], body.b[list(on)]
            along = null_space(A) if size else np.eye(n)
            curvature = along.T @ P @ along
            if along.shape[1] != n - size or np.linalg.eigvalsh(curvature)[-1] >= 0:
                continue
            p = np.linalg.lstsq(A, b, rcond=None)[0] if size else np.zeros(n)
            p = p - along @ np.linalg.solve(curvature, along.T @ (P @ p + g))
            if (body.A @ p <= body.b + slack).all():
                points.append(p[None])
    p = np.concatenate(points)
    values = ((p @ P) * p).sum(1) / 2 + p @ g
    return float(values.max()), p[values.argmax()]
