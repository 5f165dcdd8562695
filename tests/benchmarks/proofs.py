"""Worst cases of policies beside a million samples: effort, and the size at which it is too much.

    python -m tests.benchmarks.proofs

Each row asks for the largest violation of the state's bounds from a box of starts, with noise, and
attacks the bound by a million starts with noise at its corners, and by gradient ascent from the
worst of them. Seconds are the process's. A dash is a program that HiGHS gave no bound of in time.
"""

from __future__ import annotations

import argparse
import sys
import time
from typing import NamedTuple

import numpy as np
import torch

from torch_qpmpc import QPMPC, SolverError
from torch_qpmpc.envs import PointMass
from torch_qpmpc.proofs import Plant, Polytope, largest_violation

SAMPLES = 1_000_000
TITLES = ("problem", "steps", "worst case", "bound", "attack", "binaries / nodes", "CPU, s")
#: Limit of each mixed-integer program.
SECONDS = 30.0


class Problem(NamedTuple):
    """A policy, its plant, a box of starts and the bounds of the state."""

    mpc: QPMPC
    plant: Plant
    starts: Polytope
    bound: np.ndarray


def point_mass(horizon: int, structure: str) -> Problem:
    """The paper's point mass; starts within half of the bounds."""
    physics = PointMass()
    A, B = physics.A.numpy(), physics.B.numpy()
    bound = physics.ub_s.numpy()
    bounds = {
        "state_bounds": (physics.lb_s, physics.ub_s),
        "action_bounds": (physics.lb_a, physics.ub_a),
        "solver": "daqp",
    }
    W = [*(2 * physics.W.diagonal()).tolist(), 0.1, 0.1]
    mpc = QPMPC.linear_mpc(A, B, horizon, stage_weight=W, structure=structure, **bounds)
    _disturb(mpc)
    noise = Polytope.box(-0.02 * np.ones(4), 0.02 * np.ones(4))
    return Problem(
        mpc, Plant.of(A, B, disturbances=noise), Polytope.box(-bound / 2, bound / 2), bound
    )


def _disturb(mpc: QPMPC) -> None:
    """Move a free C off the model, as learning does."""
    if mpc.structure == "free":
        with torch.no_grad():
            noise = torch.randn(mpc.C.shape, generator=torch.Generator().manual_seed(0))
            mpc.C.add_(0.01 * noise)


def attack(problem: Problem, steps: int) -> float:
    """Return the largest violation of a million samples, and of ascent from the worst hundred."""
    mpc, plant, starts, bound = problem
    generator = torch.Generator().manual_seed(1)
    A, B = torch.as_tensor(plant.A), torch.as_tensor(plant.B)
    assert plant.disturbances is not None
    size = torch.as_tensor(plant.disturbances.upper)
    low, high = torch.as_tensor(starts.lower), torch.as_tensor(starts.upper)

    def violation(s: torch.Tensor, signs: torch.Tensor) -> torch.Tensor:
        for k in range(steps):
            s = s @ A.mT + mpc.policy(s) @ B.mT + signs[k] * size
        return (s.abs() - torch.as_tensor(bound)).amax(-1)

    chunks, worst = [], -np.inf
    for _ in range(SAMPLES // 50_000):
        s = low + (high - low) * torch.rand(50_000, len(low), generator=generator).double()
        signs = torch.randint(0, 2, (steps, *s.shape), generator=generator).double() * 2 - 1
        with torch.no_grad():
            values = violation(s, signs)
        worst = max(worst, float(values.max()))
        top = values.topk(5).indices
        chunks.append((s[top], signs[:, top]))
    s = torch.cat([x for x, _ in chunks])
    signs = torch.cat([x for _, x in chunks], dim=1)
    for k in range(100):
        s.requires_grad_()
        values = violation(s, signs)
        worst = max(worst, values.max().item())
        (gradient,) = torch.autograd.grad(values.sum(), s)
        step = 0.1 * (high - low) * 0.95**k
        s = (s.detach() + step * gradient.sign()).clamp(low, high)
    return worst


def measured(horizon: int, structure: str, steps: int) -> list[str]:
    """Measure one row of the table."""
    problem = point_mass(horizon, structure)
    problem.mpc.policy(torch.zeros(len(problem.bound)).double())  # compiles, once
    began = time.process_time()
    try:
        answer = largest_violation(
            problem.mpc,
            problem.plant,
            problem.starts,
            -problem.bound,
            problem.bound,
            steps=steps,
            seconds=SECONDS,
        )
    except SolverError:
        answer = None
    seconds = time.process_time() - began
    return [
        f"point mass, N = {horizon}, {structure}",
        str(steps),
        f"{answer.value:.4f}" if answer else "-",
        f"{answer.bound:.4f}" if answer else "-",
        f"{attack(problem, steps):.4f}",
        f"{answer.binaries} / {answer.nodes:,}" if answer else "-",
        f"{seconds:.1f}",
    ]


def main(arguments: list[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.proofs", description=__doc__)
    parser.add_argument("--horizons", type=int, nargs="*", default=[10])
    parser.add_argument("--steps", type=int, nargs="*", default=[1, 2])
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    print(" | ".join(TITLES))
    for horizon in options.horizons:
        for structure in ("tied", "free"):
            for steps in options.steps:
                print(" | ".join(measured(horizon, structure, steps)), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
