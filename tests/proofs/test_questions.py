"""Worst cases: against closed forms, samples and the plant itself."""

from typing import Any, cast

import numpy as np
import pytest
import torch

from tests.integrator import BOX, A, B
from tests.integrator import integrator as scheme
from tests.refused import refused
from torch_qpmpc import QPMPC, SolverError
from torch_qpmpc.proofs import (
    Plant,
    Polytope,
    invariance,
    largest_difference,
    largest_violation,
    questions,
)

NOISE = Polytope.box([-0.02, -0.02], [0.02, 0.02])
BOUNDS: dict[str, Any] = {"lower": BOX.lower, "upper": BOX.upper}


def two_actions() -> QPMPC:
    return QPMPC.from_model(A, np.eye(2), 3, stage_weight=[1.0, 1.0, 1.0, 1.0])


def test_the_corner_is_the_worst_start_of_a_double_integrator():
    """From x = (1, 0.5), u = -1 leaves 1.08 and 0.3, and the noise adds 0.02."""
    answer = largest_violation(scheme(), Plant.of(A, B, disturbances=NOISE), BOX, **BOUNDS)
    assert answer.bound == pytest.approx(0.1, abs=1e-6)
    assert answer.value == pytest.approx(0.1, abs=1e-6)
    assert answer.refuted
    assert not answer.proved
    assert np.abs(answer.states[0]) == pytest.approx([1.0, 0.5], abs=1e-6)
    assert np.abs(answer.disturbances[0][0]) == pytest.approx(0.02, abs=1e-6)
    assert "from p = [" in str(answer)


@pytest.mark.parametrize("steps", [1, np.int64(2)])
def test_no_sample_exceeds_a_proved_bound(steps):
    mpc, small = scheme(), Polytope.box([-0.6, -0.3], [0.6, 0.3])
    answer = largest_violation(
        mpc, Plant.of(A, B, disturbances=NOISE), small, **BOUNDS, steps=steps
    )
    assert answer.proved
    assert answer.value <= answer.bound + 1e-6
    generator = np.random.default_rng(0)
    x = generator.uniform(small.lower, small.upper, (4000, 2))
    for _ in range(steps):
        u = mpc.policy(torch.tensor(x)).detach().numpy()
        x = x @ A.T + u @ B.T + generator.choice([-0.02, 0.02], (4000, 2))
    assert (np.abs(x) - BOX.upper).max() <= answer.bound + 1e-6
    assert str(answer).startswith(f"largest violation in {steps} step")
    assert "proved" in str(answer)


def test_invariance_is_proved_of_one_polytope_and_refuted_of_another():
    mpc, plant = scheme(state_bounds=None), Plant.of(A, B)
    # A level set of a quadratic Lyapunov function of the unconstrained law, as a polytope.
    K = -torch.autograd.functional.jacobian(mpc.policy, torch.zeros(2).double()).numpy()
    closed = A - B @ K
    P = np.eye(2)
    for _ in range(500):
        P = np.eye(2) + closed.T @ P @ closed
    turns = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    rows = np.column_stack((np.cos(turns), np.sin(turns))) @ np.linalg.cholesky(P).T
    inside = Polytope.of(rows, 0.3 * np.ones(16))
    assert invariance(mpc, plant, inside).proved
    outside = invariance(mpc, plant, BOX)
    assert outside.refuted
    assert (BOX.A @ outside.states[1] - BOX.b).max() == pytest.approx(outside.value)


@pytest.mark.parametrize("unit", [1e-6, 1e6])
def test_a_proof_does_not_depend_on_units(unit):
    """A loop that violates its bounds by 10 % of them is refuted in any unit of the state."""
    mpc = QPMPC.from_model(
        A,
        unit * B,
        3,
        stage_weight=[1 / unit**2, 1 / unit**2, 0.1],
        state_bounds=(unit * BOX.lower, unit * BOX.upper),
        state_slack=100.0 / unit,
        action_bounds=([-1.0], [1.0]),
    )
    at = Polytope.box(unit * BOX.lower, unit * BOX.upper)
    plant = Plant.of(A, unit * B, disturbances=Polytope.box(unit * NOISE.lower, unit * NOISE.upper))
    answer = largest_violation(mpc, plant, at, lower=at.lower, upper=at.upper)
    assert answer.value / unit == pytest.approx(0.1, abs=1e-6)
    assert answer.bound / unit == pytest.approx(0.1, abs=1e-6)
    assert answer.refuted
    assert not answer.proved
    # The start at zero velocity has no size there, but the bound has.
    rest = Polytope.box([-unit, 0.0], [unit, 0.0])
    assert not largest_violation(mpc, plant, rest, upper=[np.inf, 0.02 * unit]).proved


@pytest.mark.parametrize("bounds", [([-np.inf], [1.0]), ([-1.0], [np.inf]), ([-1e10], [1.0])])
def test_hard_bounds_of_one_side_leave_slack(bounds):
    """From x = (1, 0.5), u = -1 leaves 1.08; without a lower bound of u it leaves less."""
    mpc = scheme(state_bounds=None, action_bounds=bounds)
    answer = largest_violation(mpc, Plant.of(A, B), BOX, **BOUNDS)
    x = np.array(answer.states[0])
    u = mpc.policy(torch.tensor(x)).detach().numpy()
    assert (np.abs(A @ x + B @ u) - BOX.upper).max() == pytest.approx(answer.bound, abs=1e-5)


def test_high_prices_loosen_the_bound_alone():
    """HiGHS' worst case in another row is not the policy's; the corner's is."""
    answer = largest_violation(scheme(state_slack=1e5), Plant.of(A, B), BOX, **BOUNDS)
    assert answer.value == pytest.approx(0.08, abs=1e-6)
    assert answer.value <= answer.bound + 1e-6
    # The second is what HiGHS of older SciPy says.
    wrong = r"could miss a worst case: .* Lower the prices w of soft|gave no bound of the worst"
    with pytest.raises(SolverError, match=wrong):
        largest_violation(scheme(state_slack=1e8), Plant.of(A, B), BOX, **BOUNDS)


def test_the_worst_of_several_plants_counts():
    """From x = (1, 0.5), u = -1 leaves 1.09 with half of B, and 1.08 with B."""
    half, whole, near = Plant.of(A, 0.5 * B), Plant.of(A, B), Polytope.box([0.8, 0.3], BOX.upper)
    for plants, worst in (
        (half, 0.09),
        (whole, 0.08),
        ([half, whole], 0.09),
        ([whole, half], 0.09),
    ):
        answer = largest_violation(scheme(), plants, near, **BOUNDS)
        assert answer.value == pytest.approx(worst, abs=1e-6)


def test_two_linear_policies_differ_by_their_gains():
    first, second = (
        scheme(state_bounds=None, action_bounds=None, stage_weight=[1.0, 1.0, r])
        for r in (0.1, 1.0)
    )
    zero = torch.zeros(2, dtype=torch.float64)
    gains = [torch.autograd.functional.jacobian(x.policy, zero) for x in (first, second)]
    exact = float(((gains[0] - gains[1]).abs() @ torch.tensor(BOX.upper)).max())
    answer = largest_difference(first, second, BOX)
    assert answer.value == pytest.approx(exact, abs=1e-6)
    assert largest_difference(first, first, BOX).bound <= 1e-6


def test_an_answer_that_the_policy_contradicts_is_an_error(monkeypatch):
    monkeypatch.setattr(questions, "action", lambda mpc, p: np.array([0.123]))
    with pytest.raises(SolverError, match="tolerances are too wide for this QP"):
        largest_violation(scheme(), Plant.of(A, B), BOX, **BOUNDS)


def test_a_question_without_time_stays_undecided():
    answer = largest_violation(scheme(), Plant.of(A, B), BOX, **BOUNDS, seconds=1e-9)
    assert (answer.proved, answer.refuted, answer.bound) == (False, False, np.inf)
    assert "undecided" in str(answer)
    with pytest.raises(SolverError, match="does not bound the states in time: allow more seconds"):
        largest_violation(scheme(), Plant.of(A, B), BOX, **BOUNDS, steps=2, seconds=1e-9)


@refused(
    (lambda: Plant.of(A, B, offset=[0.0]), r".*\(n, n\), \(n, n_u\), \(n,\) and \(n, 0\)"),
    (lambda: largest_violation(scheme(), Plant.of(A, B), BOX), ".*no finite bound"),
    (lambda: largest_violation(scheme(), Plant.of(A, B), BOX, [0.0]), r".*\(2,\) numbers"),
    (lambda: largest_violation(scheme(), Plant.of(A, B), BOX, [0.0, np.inf]), ".*below inf"),
    (lambda: largest_violation(scheme(), Plant.of(A, B), BOX, None, [-np.inf, 0.0]), ".*above -"),
    (lambda: largest_violation(scheme(), Plant.of(A, B), BOX, "high"), ".*lower: got 'high'"),
    (lambda: Plant.of([[np.nan, 0.0], [0.0, 1.0]], B), ".*A: got NaN or inf"),
    (lambda: Plant.of(A, B, disturbances=cast(Any, [0.1, 0.1])), ".*disturbances: got list"),
    (
        lambda: largest_violation(scheme(), Plant.of([[1.0]], [[1.0]]), BOX, BOX.lower),
        r".*plant\.B",
    ),
    (
        lambda: largest_violation(scheme(), Plant.of(A, B), BOX, BOX.lower, steps=0),
        ".*a whole number >= 1",
    ),
    (lambda: invariance(scheme(), Plant.of(A, B), Polytope.box([0.0], [1.0])), ".*n_p = 2"),
    (lambda: largest_difference(scheme(), two_actions(), BOX), ".*2 actions"),
    (lambda: largest_difference(scheme(), scheme(), BOX, seconds=np.nan), ".*seconds: got nan"),
    (lambda: invariance(scheme(), Plant.of(A, B), BOX, seconds=-1.0), r".*seconds: got -1\.0"),
    (lambda: invariance(scheme(), Plant.of(A, B), BOX, seconds=cast(Any, None)), ".*got None"),
)
def test_errors(ask):
    ask()
