"""Explicit laws: their regions, search trees and C code beside the on-line solver.

    python -m tests.benchmarks.explicit --write

A million random states of each set are compared: the tree's C code with the exported QP solver,
which certifies each step (`torch_qpmpc.CompiledPolicy`). *Covered* is the share of 10,000 random
states in a region, and *volume* the sum of the regions' over the set's. Double integrators are also
enumerated: all active sets of at most N rows. Seconds are the process's.
"""

from __future__ import annotations

import time
from typing import Any, NamedTuple

import numpy as np
import torch

from tests.benchmarks.proofs import double_integrator, point_mass
from tests.benchmarks.rows import PAGE, main
from tests.enumeration import double_integrator as textbook
from tests.enumeration import enumerated
from tests.law_code import actions
from torch_qpmpc import QPMPC, CompiledPolicy
from torch_qpmpc.proofs import Polytope, SearchTree, explicit_law
from torch_qpmpc.proofs.plots import law_figure

SAMPLES = 1_000_000
CHUNK = 50_000
TITLES = (
    *("QP", "regions (enumerated)", "laws", "covered, volume", "nodes, depth, bytes"),
    *("largest difference", "CPU, s"),
)


class Problem(NamedTuple):
    """A QP, the set of s, a slice of the known entries and the regions by enumeration."""

    mpc: QPMPC
    states: Polytope
    options: dict[str, Any]
    regions: int | None = None


def triple_integrator(horizon: int) -> Problem:
    """Position, velocity and acceleration; the first two have soft bounds."""
    A, B = [[1.0, 0.2, 0.02], [0.0, 1.0, 0.2], [0.0, 0.0, 1.0]], [[0.0], [0.02], [0.2]]
    bound = [1.0, 0.5, np.inf]
    mpc = QPMPC.linear_mpc(
        A, B, horizon, stage_weight=[1.0, 1.0, 0.1, 0.1], action_bounds=([-1.0], [1.0]),
        state_bounds=([-x for x in bound], bound), solver="daqp",
    )  # fmt: skip
    return Problem(mpc, Polytope.box([-1.0] * 3, [1.0] * 3), {})


def hard(horizon: int) -> Problem:
    box = Polytope.box([-5.0] * 2, [5.0] * 2)
    return Problem(textbook(horizon), box, {}, len(enumerated(horizon)))


def soft(horizon: int, structure: str) -> Problem:
    problem = double_integrator(horizon, structure)
    return Problem(problem.mpc, problem.starts, {})


def slice_of_four(horizon: int, structure: str) -> Problem:
    """x and its velocity at y = 0.3 with a velocity of 0.1, within all bounds."""
    problem = point_mass(horizon, structure)
    options = {"origin": [0.0, 0.3, 0.0, 0.1], "basis": np.eye(4)[:, [0, 2]]}
    box = Polytope.box(-problem.bound[[0, 2]], problem.bound[[0, 2]])
    return Problem(problem.mpc, box, options)


PROBLEMS = {
    **{f"double integrator, hard, N = {N}": (hard, N) for N in (2, 3, 4, 5)},
    **{
        f"double integrator, soft, N = {N}, {structure}": (soft, N, structure)
        for N in (3, 10)
        for structure in ("tied", "free")
    },
    **{f"triple integrator, soft, N = {N}": (triple_integrator, N) for N in (3, 5)},
    **{
        f"point mass, slice, N = {N}, {structure}": (slice_of_four, N, structure)
        for N in (3, 10)
        for structure in ("tied", "free")
    },
}


def difference(tree: SearchTree, mpc: QPMPC) -> tuple[float, int]:
    """Return the largest difference of the actions, and the states that both call feasible."""
    law, solver, generator = tree.law, CompiledPolicy(mpc), np.random.default_rng(2)
    worst, count = 0.0, 0
    s = generator.uniform(law.set.lower, law.set.upper, (SAMPLES, len(law.set.lower)))
    u, codes = actions(tree, s, "float64")
    for i in range(0, SAMPLES, CHUNK):
        p = torch.as_tensor(law.origin + s[i : i + CHUNK] @ law.basis.T)
        inside = codes[i : i + CHUNK] == 0
        solved = solver(p[torch.as_tensor(inside)]).numpy()
        worst = max(worst, float(abs(solved - u[i : i + CHUNK][inside]).max()))
        count += int(inside.sum())
    return worst, count


def measured(name: str) -> list[str]:
    """Measure one row of the table."""
    make, *arguments = PROBLEMS[name]
    problem = make(*arguments)
    began = time.process_time()
    law = explicit_law(problem.mpc, problem.states, **problem.options)
    tree = SearchTree.of(law)
    seconds = time.process_time() - began
    worst, count = difference(tree, problem.mpc)
    print(f"{name}: {count:,} states inside")
    size = 8 * tree.numbers + 4 * tree.children.size
    return [
        name,
        f"{len(law.regions):,}" + ("" if problem.regions is None else f" ({problem.regions})"),
        str(len(tree.laws)),
        f"{law.covered:.2%}, {law.volume:.6f}",
        f"{len(tree.planes)}, {tree.depth}, {size:,}",
        f"{worst:.0e}",
        f"{seconds:.1f}",
    ]


def _figure() -> None:
    """Draw the page's figure: the double integrator with cheap soft bounds."""
    mpc = QPMPC.linear_mpc(
        [[1.0, 0.2], [0.0, 1.0]], [[0.02], [0.2]], 5, stage_weight=[1.0, 1.0, 0.1],
        action_bounds=([-1.0], [1.0]), state_bounds=([-1.0, -0.5], [1.0, 0.5]), state_slack=2.0,
    )  # fmt: skip
    law = explicit_law(mpc, Polytope.box([-1.2, -0.8], [1.2, 0.8]))
    law_figure(law).savefig(PAGE.with_name("prove-regions.png"), dpi=80)


if __name__ == "__main__":
    explicit_law(textbook(1), Polytope.box([-1.0] * 2, [1.0] * 2))  # compiles the loops
    if main("explicit", "explicit laws", TITLES, PROBLEMS, measured):
        _figure()
