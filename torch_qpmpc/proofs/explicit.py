"""The explicit law: the regions of states on which the policy is affine and V is quadratic.

The walk begins with the choice of rows (`torch_qpmpc.proofs.choices`) of one state, which a solver
makes, and steps over the facets of each region; a point beyond, in no region yet, is solved. Facets
need not be shared by two regions only, so that random states without a region are solved, too.

The law of each region is exact. That no region is missing is not proved: `ExplicitLaw.covered` is
the share of other random states that are in a region.

References: Bemporad, Morari, Dua and Pistikopoulos (2002), "The explicit linear quadratic regulator
for constrained systems", Automatica 38; Tøndel, Johansen and Bemporad (2003), "An algorithm for
multi-parametric quadratic programming and explicit MPC solutions", Automatica 39; on facets of
several regions, Spjøtvold, Kerrigan, Jones, Tøndel and Johansen (2006), "On the facet-to-facet
property of solutions to convex parametric quadratic programs", Automatica 42.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NoReturn

import numpy as np
from scipy.spatial import Delaunay

from torch_qpmpc.checks import check_kind
from torch_qpmpc.errors import QPError
from torch_qpmpc.export.tables import Tables, make_tables
from torch_qpmpc.mpc.module import QPMPC
from torch_qpmpc.proofs.choices import CONSTANT, Region, Sliced, volume_of
from torch_qpmpc.proofs.polytope import Polytope, facets
from torch_qpmpc.qp.program import Status

Array = np.ndarray
#: Entries of s.
MOST_ENTRIES = 3
#: Steps over a facet, relative to the set's size: a longer one is taken where a shorter one is too
#: near to the facet for the solver, or in a region without an interior.
STEPS = (1e-6, 1e-5, 1e-4, 1e-3)
#: Points are in a polytope within this, relative to the size of the law's set.
INSIDE = 1e-8
#: Random states that are solved if no region contains them.
SAMPLES = 1000
#: Random states that are counted for the share in the regions.
COUNTED = 10_000
#: Outcomes of a point.
WITHIN, INFEASIBLE, NEITHER = range(3)
#: States that are evaluated at once.
CHUNK = 4096


@dataclass(frozen=True, eq=False)
class ExplicitLaw:
    """The policy and the value as functions of s, where p = origin + basis s.

    Attributes:
        set: the s of the set of states at which the QP is feasible.
        regions: its parts.
        origin, basis: ``(n_p,)`` and ``(n_p, d)``.
        tables: the QP's tables.
    """

    set: Polytope
    regions: tuple[Region, ...]
    origin: Array
    basis: Array
    tables: Tables

    @cached_property
    def covered(self) -> float:
        """The share of 10,000 random states, uniform in the set, that are in a region.

        If all are, less than 0.03% of the set is without a region, with 95% confidence.
        """
        return float((self.index(_uniform(_vertices(self.set), COUNTED)) >= 0).mean())

    @cached_property
    def volume(self) -> float:
        """The sum of the regions' volumes relative to the set's; overlaps count twice.

        It is 1 if no region is missing and none overlap.
        """
        return sum(x.volume for x in self.regions) / volume_of(_vertices(self.set))

    def index(self, s: Any) -> Array:
        """Return the region of each s ``(*batch, d)``, -1 outside all, ``(*batch,)``.

        Raises:
            QPError: s has another shape, here and in the functions below.
        """
        s = check_points(s, self.basis.shape[1])
        flat = s.reshape(-1, s.shape[-1])
        chunks = range(0, max(len(flat), 1), CHUNK)
        parts = [_nearest(self.regions, flat[i : i + CHUNK]) for i in chunks]
        at, off = map(np.concatenate, zip(*parts, strict=True))
        return np.where(off <= INSIDE * size_of(self.set), at, -1).reshape(s.shape[:-1])

    def policy(self, s: Any) -> Array:
        """Return u_0 ``(*batch, n_u)``, NaN outside all regions."""
        at, s = self.index(s), np.asarray(s, float)
        K, k = (np.stack([getattr(x, name) for x in self.regions]) for name in ("K", "k"))
        u = (K[at] @ s[..., None])[..., 0] + k[at]
        return np.where(at[..., None] < 0, np.nan, u)

    def value(self, s: Any) -> Array:
        """Return V ``(*batch,)``, NaN outside all regions."""
        at, s = self.index(s), np.asarray(s, float)
        P, g, c = (np.stack([getattr(x, name) for x in self.regions]) for name in ("P", "g", "c"))
        half = (P[at] @ s[..., None])[..., 0] / 2
        return np.where(at < 0, np.nan, ((half + g[at]) * s).sum(-1) + c[at])

    def __str__(self) -> str:
        laws = len({(*x.K.ravel().round(9), *x.k.round(9)) for x in self.regions})
        share = f"{self.covered:.2%} of {COUNTED:,} random states covered"
        return f"{len(self.regions)} regions, {laws} laws, {share}"


def explicit_law(
    mpc: QPMPC, states: Polytope, *, origin: Any = None, basis: Any = None
) -> ExplicitLaw:
    """Compute the policy's affine laws on a set of states, region by region.

    Args:
        mpc: the QP.
        states: the set of s, of at most three dimensions.
        origin, basis: a slice of the known entries, p = origin + basis s; ``(n_p,)`` and
            ``(n_p, d)``. By default s is p.

    Raises:
        QPError: an argument is invalid, the set is flat, or the QP is infeasible at all samples.

    Example:
        >>> import torch_qpmpc as qm
        >>> A, B = [[1.0, 0.2], [0.0, 1.0]], [[0.02], [0.2]]
        >>> mpc = qm.QPMPC.from_model(
        ...     A, B, 3, stage_weight=[1.0, 1.0, 0.1], action_bounds=([-0.5], [0.5])
        ... )
        >>> law = explicit_law(mpc, Polytope.box([-1.0, -1.0], [1.0, 1.0]))
        >>> print(law)
        7 regions, 3 laws, 100.00% of 10,000 random states covered
    """
    check_kind("mpc", mpc, QPMPC)
    check_kind("states", states, Polytope, "Make one with Polytope.box(lower, upper).")
    d = len(states.lower)
    origin = np.zeros(mpc.n_p) if origin is None else np.array(origin, float)
    basis = np.eye(mpc.n_p) if basis is None else np.array(basis, float)
    if d > MOST_ENTRIES:
        remedy = "Take a slice: basis=(n_p, 2) and an origin."
        raise QPError.expected("states", f"{d} dimensions", f"at most {MOST_ENTRIES}", remedy)
    if origin.shape != (mpc.n_p,) or basis.shape != (mpc.n_p, d):
        got, want = f"shapes {origin.shape} and {basis.shape}", f"({mpc.n_p},) and ({mpc.n_p}, {d})"
        raise QPError.expected("origin and basis", got, want)
    tables = make_tables(mpc)
    walk = _Walk(Sliced.of(tables, origin, basis), _possible(tables, states, origin, basis))
    walk.run()
    whole = facets(walk.A, walk.b)
    if whole is None or not walk.regions:
        _raise_infeasible()
    feasible = Polytope.of(whole.A, whole.b)
    return ExplicitLaw(feasible, tuple(walk.regions), origin, basis, tables)


def check_points(s: Any, d: int) -> Array:
    """Return s ``(*batch, d)`` as an array; raise `QPError` unless it has that shape."""
    s = np.asarray(s, float)
    if s.shape[-1:] != (d,):
        raise QPError.expected("s", f"shape {s.shape}", f"(*batch, {d})")
    return s


def _raise_infeasible() -> NoReturn:
    want = "one with an interior, in which the QP is feasible"
    raise QPError.expected("states", "a set without a region", want)


def size_of(states: Polytope) -> float:
    """Return the longest side of the bounding box."""
    return float((states.upper - states.lower).max())


def _vertices(states: Polytope) -> Array:
    """Return the vertices of a set with an interior."""
    body = facets(states.A, states.b)
    assert body is not None
    return body.vertices


def _uniform(vertices: Array, count: int) -> Array:
    """Draw points uniform in the hull of ``vertices``: of its simplices, by their volumes."""
    generator, n = np.random.default_rng(1), vertices.shape[1]
    simplices = vertices[None] if n == 1 else vertices[Delaunay(vertices).simplices]
    volumes = np.abs(np.linalg.det(simplices[:, 1:] - simplices[:, :1]))
    at = generator.choice(len(volumes), count, p=volumes / volumes.sum())
    return (generator.dirichlet(np.ones(n + 1), count)[..., None] * simplices[at]).sum(1)


def _possible(tables: Tables, states: Polytope, origin: Array, basis: Array) -> Polytope:
    """Return the states that satisfy the hard rows of p alone."""
    known = tables.known
    hard = np.isinf(known.w)
    Y, y_0 = known.Y[hard] @ basis, known.Y[hard] @ origin
    b = np.concatenate((known.upper[hard] - y_0, y_0 - known.lower[hard]))
    kept = np.isfinite(b)
    A, b = np.concatenate((states.A, np.concatenate((Y, -Y))[kept])), np.append(states.b, b[kept])
    moves = np.abs(A).sum(1) > CONSTANT * np.abs(known.Y).max(initial=1.0)
    body = None if (b[~moves] < -INSIDE).any() else facets(A[moves], b[moves])
    if body is None:
        _raise_infeasible()
    return Polytope.of(body.A, body.b)


def _nearest(regions: tuple[Region, ...] | list[Region], s: Array) -> tuple[Array, Array]:
    """Return the region that contains each s or is nearest to it, and the largest violation."""
    A = np.concatenate([x.set.A for x in regions])
    b = np.concatenate([x.set.b for x in regions])
    ends = np.cumsum([0, *(len(x.set.b) for x in regions)])[:-1]
    off = np.maximum.reduceat(s @ A.T - b, ends, axis=1)
    at = off.argmin(1)
    return at, off[np.arange(len(s)), at]


class _Walk:
    """The regions so far; ``A s <= b`` are the states and the limits of feasibility so far."""

    def __init__(self, tables: Sliced, states: Polytope) -> None:
        self.tables, self.states, self.size = tables, states, size_of(states)
        self.A, self.b = states.A, states.b
        self.regions: list[Region] = []
        self._choices: set[bytes] = set()

    def run(self) -> None:
        """Walk from random states, until none of them is outside all regions."""
        generator, n = np.random.default_rng(0), len(self.states.lower)
        while True:
            s = generator.uniform(self.states.lower, self.states.upper, (SAMPLES, n))
            s = self._outside(s[(s @ self.A.T <= self.b).all(1)])
            before = len(self.regions)
            fresh, _ = self._add(s if self.regions else s[: SAMPLES // 10])
            while fresh:
                fresh = self._cross(fresh)
            if len(self.regions) == before:
                return

    def _outside(self, s: Array) -> Array:
        """Return the points in no region."""
        if not self.regions or not len(s):
            return s
        return s[_nearest(self.regions, s)[1] > INSIDE * self.size]

    def _add(self, s: Array) -> tuple[list[Region], Array]:
        """Solve at points, and return their new regions.

        Beside them is the outcome for each point: WITHIN a region, INFEASIBLE, or NEITHER.
        """
        outcome = np.full(len(s), NEITHER)
        fresh: list[Region] = []
        if not len(s):
            return fresh, outcome
        choices, multipliers, status = self.tables.solve(s)
        outcome[status == Status.INFEASIBLE] = INFEASIBLE
        for i in np.flatnonzero(status == Status.SOLVED):
            active = self.tables.independent(choices[i], multipliers[i])
            known = active.tobytes() in self._choices
            region = None if known else self.tables.region(active, self.states)
            if region is not None:
                self._choices.add(active.tobytes())
                fresh.append(region)
            inside = [*self.regions, *fresh]
            if inside and _nearest(inside, s[i : i + 1])[1][0] <= INSIDE * self.size:
                outcome[i] = WITHIN
        self.regions += fresh
        return fresh, outcome

    def _cross(self, regions: list[Region]) -> list[Region]:
        """Step over all facets of regions, and return the new ones there."""
        starts, normals, limits, fresh = [], [], [], []
        for region in regions:
            A, b, V = region.set.A, region.set.b, region.vertices
            for a, limit in zip(A, b, strict=True):
                on = V[abs(V @ a - limit) < INSIDE * self.size]
                if len(on):
                    starts.append(on.mean(0))
                    normals.append(a)
                    limits.append(limit)
        s, a, b = np.array(starts), np.array(normals), np.array(limits)
        for step in STEPS:
            beyond = s + step * self.size * a
            kept = np.flatnonzero((beyond @ self.A.T <= self.b).all(1))
            kept = kept[_nearest(self.regions, beyond[kept])[1] > INSIDE * self.size]
            more, outcome = self._add(beyond[kept])
            fresh += more
            limits = kept[outcome == INFEASIBLE]
            self.A, self.b = np.concatenate((self.A, a[limits])), np.append(self.b, b[limits])
            kept = kept[outcome == NEITHER]
            s, a, b = s[kept], a[kept], b[kept]
        return fresh
