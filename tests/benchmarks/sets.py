"""Sets that a policy never leaves, attacked; Gros and Zanon's back-off told from none.

    python -m tests.benchmarks.sets --write

A set is that of `invariant_set` or, where the policy rests at a soft bound, of `grown_set` from a
box of 0.001 around the resting state; `invariance` proves each by mixed-integer programs. The
attack steps from a million states of the set, with the worst noise of each facet, and by gradient
ascent through the QP from the worst hundred. Beside it are the largest violation of the bounds one
step later, and the most iterations of the exported solver at these states, from no active set.
Seconds are the process's, without the attack. Dashes are a policy without a set that is proved.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch

from tests.benchmarks.proofs import double_integrator, point_mass
from tests.benchmarks.rows import main
from torch_qpmpc import QPMPC, CompiledPolicy, QPError
from torch_qpmpc.envs import GrosZanonLTI
from torch_qpmpc.mpc.tightening import BackOff
from torch_qpmpc.proofs import (
    Plant,
    Polytope,
    explicit_law,
    grown_set,
    invariance,
    invariant_set,
    largest_violation,
)

SAMPLES = 1_000_000
CHUNK = 50_000
SECONDS = 30.0
TITLES = (
    "policy",
    "facets",
    "bound of the proof",
    "attack",
    "violation of bounds",
    "iterations",
    "CPU, s",
)


class Subject(NamedTuple):
    """A policy, its plant, the state's bounds and the set that it stays in."""

    mpc: QPMPC
    plant: Plant
    bounds: Polytope
    set: Polytope


def gros_zanon(horizon: int, probability: float | None) -> Subject:
    """Use the true model; the back-off counts the uniform noise with its variance."""
    physics = GrosZanonLTI()
    A, B, offset = (x.numpy() for x in physics.true_model())
    bounds = Polytope.box(physics.lb_s.numpy(), physics.ub_s.numpy())
    mpc = QPMPC.from_model(
        A, B, horizon, offset=offset, structure="tied", hessian="block", gamma=0.9, solver="daqp",
        stage_weight=[1.0, 1.0, 0.5], state_bounds=(bounds.lower, bounds.upper), state_slack=50.0,
        discount_slack=True, action_bounds=(physics.lb_a, physics.ub_a),
    )  # fmt: skip
    if probability is not None:
        BackOff(mpc, probability).tighten(torch.diag(torch.tensor([0.1**2 / 12, 0.0]).double()))
    noise = Polytope.box([-0.1], [0.0])
    plant = Plant.of(A, B, E=[[1.0], [0.0]], disturbances=noise)
    law = explicit_law(mpc, Polytope.box([-0.6, -1.0], [1.0, 1.0]))
    s = np.array([0.2, 0.2])
    for _ in range(2000):
        s = A @ s + B @ law.policy(s) + [-0.05, 0.0]
    return Subject(mpc, plant, bounds, grown_set(law, plant, Polytope.box(s - 1e-3, s + 1e-3)))


def of_bounds(name: str, horizon: int, structure: str) -> Subject:
    """Use the largest invariant set that is proved within the bounds, with a noise of 0.01."""
    make = {"double integrator": double_integrator, "point mass": point_mass}[name]
    mpc, plant, _, bound = make(horizon, structure)
    noise = Polytope.box(-0.01 * np.ones(len(bound)), 0.01 * np.ones(len(bound)))
    plant = Plant.of(plant.A, plant.B, disturbances=noise)
    bounds = Polytope.box(-bound, bound)
    return Subject(mpc, plant, bounds, invariant_set(mpc, plant, bounds, seconds=SECONDS).set)


SUBJECTS: dict[str, Callable[[], Subject]] = {
    **{
        f"Gros-Zanon, N = {N}, {f'back-off of {x:.0%}' if x else 'no back-off'}": (
            lambda N=N, x=x: gros_zanon(N, x)
        )
        for N in (5, 10)
        for x in (None, 0.95, 0.99)
    },
    **{
        f"{name}, N = 3, {structure}": lambda name=name, x=structure: of_bounds(name, 3, x)
        for name in ("double integrator", "point mass")
        for structure in ("tied", "free")
    },
}


class Attack(NamedTuple):
    """The largest distance from the set after one step, and the most iterations."""

    outside: float
    iterations: int


def attack(subject: Subject) -> Attack:
    """Step from a million states of the set, and ascend from the worst ones."""
    mpc, plant, _, inside = subject
    generator = np.random.default_rng(3)
    length = np.linalg.norm(inside.A, axis=1)
    rows, b = inside.A / length[:, None], inside.b / length
    vertices = inside.vertices()
    push = np.zeros(len(rows))
    if plant.disturbances is not None:
        push = (plant.disturbances.vertices() @ plant.E.T @ rows.T).max(0)
    A, B, rows_, V = (torch.as_tensor(x) for x in (plant.A, plant.B, rows, vertices))
    offset, limit = torch.as_tensor(plant.offset), torch.as_tensor(b - push)

    def outside(p: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
        return ((p @ A.mT + u @ B.mT + offset) @ rows_.mT - limit).amax(-1)

    solver, worst, iterations, tops = CompiledPolicy(mpc), -np.inf, 0, []
    for _ in range(SAMPLES // CHUNK):
        # Sparse weights reach the facets, too.
        weights = generator.exponential(size=(CHUNK, len(V))) ** 4
        weights = torch.as_tensor(weights / weights.sum(1, keepdims=True))
        p = weights @ V
        solver.reset()
        values = outside(p, solver(p))
        assert solver.last is not None
        iterations = max(iterations, int(solver.last.iterations.max()))
        worst = max(worst, float(values.max()))
        tops.append(weights[values.topk(5).indices])
    logits = torch.cat(tops).log()
    for k in range(100):
        logits.requires_grad_()
        p = logits.softmax(-1) @ V
        values = outside(p, mpc.policy(p))
        worst = max(worst, values.max().item())
        (gradient,) = torch.autograd.grad(values.sum(), logits)
        logits = logits.detach() + 0.97**k * gradient.sign()
    return Attack(worst, iterations)


def measured(name: str) -> list[str]:
    """Measure one row of the table."""
    began = time.process_time()
    try:
        subject = SUBJECTS[name]()
    except QPError as error:
        print(f"{name}: {error}")
        return [name, *["-"] * 5, f"{time.process_time() - began:.1f}"]
    mpc, plant, bounds, inside = subject
    proof = invariance(mpc, plant, inside, seconds=SECONDS)
    answer = largest_violation(mpc, plant, inside, bounds.lower, bounds.upper, seconds=SECONDS)
    seconds = time.process_time() - began
    print(f"{name}: {proof}\n{answer}: {answer.states.tolist()}, {answer.disturbances}")
    assert proof.proved
    attacked = attack(subject)
    return [
        name,
        str(len(inside.b)),
        f"{proof.bound:.1e}",
        f"{attacked.outside:.1e}",
        f"{answer.value:.4f}" + (" (proved)" if answer.proved else " (refuted)"),
        str(attacked.iterations),
        f"{seconds:.1f}",
    ]


if __name__ == "__main__":
    main("sets", "sets", TITLES, SUBJECTS, measured)
