"""Questions by regions: against mixed-integer programs, samples and closed forms."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch

from tests.integrator import BOX, A, B, integrator
from torch_qpmpc import QPMPC, QPError, SolverError
from torch_qpmpc.envs import GrosZanonLTI
from torch_qpmpc.mpc.tightening import BackOff
from torch_qpmpc.proofs import (
    Plant,
    Polytope,
    explicit_law,
    grown_set,
    invariance,
    largest_increase,
    largest_violation,
    regions,
)

HALF = Polytope.box([-0.5, -0.25], [0.5, 0.25])
WIDE = Polytope.box([-1.5, -1.5], [1.5, 1.5])
scheme = partial(integrator, 2, QPMPC.linear_mpc, gamma=1.0)


@pytest.fixture(scope="module")
def mpc():
    return scheme()


@pytest.fixture(scope="module")
def law(mpc):
    return explicit_law(mpc, WIDE)


def plant(noise: float = 0.0) -> Plant:
    box = Polytope.box([-noise] * 2, [noise] * 2) if noise else None
    return Plant.of(A, B, disturbances=box)


def test_the_mixed_integer_program_proves_a_grown_set(mpc, law):
    starts = Polytope.box([-0.3, -0.2], [0.3, 0.2])
    grown = grown_set(law, plant(0.02), starts)
    assert invariance(mpc, plant(0.02), grown).proved
    assert (starts.vertices() @ grown.A.T <= grown.b + 1e-9).all()


def test_the_back_off_of_gros_and_zanons_system_is_proved_and_its_absence_refuted():
    """The set that is reached from near the resting state, and its distance from the bounds."""
    physics = GrosZanonLTI()
    A, B, offset = physics.true_model()
    scheme = QPMPC.from_model(
        A, B, 2, offset=offset, structure="tied", hessian="block", gamma=0.9, solver="daqp",
        stage_weight=[1.0, 1.0, 0.5],
        state_bounds=(physics.lb_s, physics.ub_s), action_bounds=(physics.lb_a, physics.ub_a),
        state_slack=50.0,
    )  # fmt: skip
    noise = Polytope.box([-0.1], [0.0])
    true = Plant.of(A.numpy(), B.numpy(), E=[[1.0], [0.0]], disturbances=noise)
    W = torch.diag(torch.tensor([0.1**2 / 12, 0.0], dtype=torch.float64))
    for probability in (None, 0.99):
        if probability:
            BackOff(scheme, probability).tighten(W)
        law = explicit_law(scheme, Polytope.box([-0.6, -1.0], [1.0, 1.0]))
        s = np.array([0.2, 0.2])
        for _ in range(200):
            s = true.A @ s + true.B @ law.policy(s) + [-0.05, 0.0]
        grown = grown_set(law, true, Polytope.box(s - 1e-3, s + 1e-3))
        answer = largest_violation(scheme, true, grown, lower=[0.0, -1.0], upper=[1.0, 1.0])
        assert invariance(scheme, true, grown).proved
        assert answer.proved == (probability is not None)
        if probability is None:
            u = law.policy(answer.states[0])
            after = true.A @ answer.states[0] + true.B @ u + true.E @ answer.disturbances[0]
            assert -after[0] == pytest.approx(answer.value, abs=1e-6)
            assert answer.value > 0.04


@pytest.mark.parametrize(("noise", "weight"), [(0.0, np.eye(2)), (0.02, None)])
def test_no_sample_has_a_larger_increase_of_v(mpc, law, noise, weight):
    answer = largest_increase(mpc, law, plant(noise), HALF, weight=weight)
    p = np.random.default_rng(0).uniform(HALF.lower, HALF.upper, (20_000, 2))
    cost = 0 if weight is None else ((p @ weight) * p).sum(1) / 2
    corners = noise * np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]])
    after = p @ A.T + law.policy(p) @ B.T
    sampled = max((law.value(after + d) - law.value(p) + cost).max() for d in corners)
    assert sampled <= answer.bound + 1e-9
    assert sampled == pytest.approx(answer.bound, abs=0.05 * (1 + answer.bound))
    assert answer.proved == (noise == 0)
    assert answer.value == pytest.approx(answer.bound, abs=1e-5)


def test_another_set_is_reached_in_a_step(mpc):
    """The next position is at most 0.3 + 0.2 * 0.2 + 0.02, and the action slows down."""
    whole = Polytope.box([-0.3, -0.2], [0.3, 0.2])
    for position, proved in ((0.36, True), (0.3, False)):
        into = Polytope.box([-position, -0.4], [position, 0.4])
        answer = invariance(mpc, plant(), whole, into=into)
        assert (answer.proved, answer.refuted) == (proved, not proved)


THREE: Any = 3
LIST: Any = [1.0]
FAR = Polytope.box([2.0, 2.0], [3.0, 3.0])
OVER = Polytope.box([0.0, 0.0], [1.6, 0.1])
FLAT = Polytope.box([0.1, 0.0], [0.1, 0.2])
CUBE = Polytope.box([0.0] * 3, [0.1] * 3)


def holed(law):
    """The law without its smallest region."""
    regions = sorted(law.regions, key=lambda x: x.volume)[1:]
    return replace(law, regions=tuple(regions))


SLICE = explicit_law(scheme(), Polytope.box([-0.1], [0.1]), basis=[[1.0], [0.0]])


@pytest.mark.parametrize(
    ("ask", "sentence"),
    [
        (lambda mpc, law: grown_set(SLICE, plant(), BOX), "a slice of the known entries"),
        (lambda mpc, law: grown_set(law, Plant.of([[1.0]], [[1.0]]), BOX), "plant.B"),
        (lambda mpc, law: grown_set(law, [], BOX), "plant: got an empty list, expected at least"),
        (lambda mpc, law: grown_set(law, THREE, BOX), "plant: got int, expected a Plant"),
        (lambda mpc, law: grown_set(THREE, plant(), BOX), "law: got int, expected an ExplicitLaw"),
        (lambda mpc, law: grown_set(law, plant(), LIST), "starts: got list, expected a"),
        (lambda mpc, law: grown_set(law, plant(), CUBE), "starts: got 3 dimensions, expected n_p"),
        (lambda mpc, law: grown_set(law, plant(), FAR), "states outside the law's set by 1.5"),
        (lambda mpc, law: grown_set(law, plant(), FLAT), "starts: got a flat set, expected a set"),
        (lambda mpc, law: grown_set(holed(law), plant(), BOX), "expected regions of all of them"),
        *(
            (
                lambda mpc, law, rows=rows: grown_set(law, plant(), HALF, directions=rows),
                "expected finite rows (m, 2) that are not zero",
            )
            for rows in ([[0.0, 0.0]], [1.0, 0.0, 1.0], [[np.nan, 1.0]], [[1.0, 0.0, 0.0]])
        ),
        (
            lambda mpc, law: grown_set(law, plant(), HALF, directions=[[1.0, 0.0]]),
            "directions: got an unbounded set, expected rows that bound one",
        ),
        (lambda mpc, law: grown_set(law, plant(0.4), BOX), "grows out of the law's set"),
        (
            lambda mpc, law: largest_increase(THREE, law, plant(), HALF),
            "mpc: got int, expected a QPMPC",
        ),
        (lambda mpc, law: largest_increase(mpc, law, LIST, HALF), "plant: got list"),
        (lambda mpc, law: largest_increase(mpc, law, plant(), FAR), "states outside the law's set"),
        (
            lambda mpc, law: largest_increase(mpc, law, plant(), OVER),
            "outside the law's set by 0.1",
        ),
        (lambda mpc, law: largest_increase(mpc, law, plant(), FLAT), "states: got a flat set"),
        (lambda mpc, law: largest_increase(mpc, holed(law), plant(), HALF), "regions of all of"),
        (
            lambda mpc, law: largest_increase(scheme(gamma=0.9), law, plant(), HALF),
            "law: got that of another QP, expected that of mpc",
        ),
        (lambda mpc, law: largest_increase(mpc, law, plant(), BOX, weight=[1.0]), "(2, 2)"),
        (lambda mpc, law: largest_increase(mpc, law, plant(0.9), BOX), "a law of all next states"),
    ],
)
def test_errors(ask, sentence, mpc, law):
    with pytest.raises(QPError) as raised:
        ask(mpc, law)
    assert sentence in str(raised.value)


def test_a_set_that_never_ends_to_grow_is_given_up(law, monkeypatch):
    monkeypatch.setattr(regions, "MOST_STEPS", 1)
    with pytest.raises(QPError, match="still grows after 1 steps"):
        grown_set(law, plant(0.02), Polytope.box([-0.3, -0.2], [0.3, 0.2]))


def test_an_increase_that_the_qp_contradicts_is_an_error(mpc, law, monkeypatch):
    monkeypatch.setattr(regions, "action", lambda mpc, p: np.array([0.123]))
    with pytest.raises(SolverError, match="where the program says"):
        largest_increase(mpc, law, plant(), Polytope.box([-0.1] * 2, [0.1] * 2))
