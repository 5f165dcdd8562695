"""Invariant sets: against a plain computation, samples of the policy, and policies that leave."""

from functools import partial
from itertools import count

import numpy as np
import pytest
import torch
from scipy.optimize import linprog

from tests.integrator import BOX, A, B, integrator
from tests.refused import refused
from torch_qpmpc import QPMPC, QPError
from torch_qpmpc.proofs import Plant, Polytope, invariant, invariant_set

NOISE = Polytope.box([-0.01, -0.01], [0.01, 0.01])
PLANT = Plant.of(A, B, disturbances=NOISE)
scheme = partial(integrator, state_bounds=None)


@pytest.fixture
def one_gain(monkeypatch):
    """Leave out the candidates of saturated laws, which take longer."""
    monkeypatch.setattr(invariant, "GAINS", (1.0,))


def bounded(low: float, slack: float) -> QPMPC:
    return scheme(state_bounds=([low, -np.inf], [np.inf, np.inf]), state_slack=slack)


def stays(mpc: QPMPC, plants: list[Plant], polytope: Polytope, steps: int = 10) -> bool:
    generator = np.random.default_rng(0)
    x = generator.uniform(polytope.lower, polytope.upper, (1000, 2))
    x = np.concatenate((x[(x @ polytope.A.T <= polytope.b).all(1)], polytope.vertices()))
    for _ in range(steps):
        plant = plants[generator.integers(len(plants))]
        u = mpc.policy(torch.tensor(x)).detach().numpy()
        x = x @ plant.A.T + u @ plant.B.T + generator.choice([-0.01, 0.01], x.shape)
        if (x @ polytope.A.T > polytope.b + 1e-9).any():
            return False
    return True


def test_it_is_the_linear_laws_largest_invariant_set():
    """Without noise: all p from which 60 steps of the law keep both bounds, row by row."""
    mpc = scheme()
    answer = invariant_set(mpc, Plant.of(A, B), BOX)
    assert (answer.scale, answer.gain) == (1.0, 1.0)
    assert answer.proof.proved
    K = torch.autograd.functional.jacobian(mpc.policy, torch.zeros(2).double()).numpy()
    rows = np.concatenate((BOX.A, K, -K))
    stacked = np.concatenate([rows @ np.linalg.matrix_power(A + B @ K, t) for t in range(60)])
    right = np.tile(np.append(BOX.b, [1.0, 1.0]), 60)
    for turn in np.linspace(0, np.pi, 16):
        direction = np.array([np.cos(turn), np.sin(turn)])
        ends = [
            -linprog(-direction, rows, limits, bounds=(None, None)).fun
            for rows, limits in ((stacked, right), (answer.set.A, answer.set.b))
        ]
        assert ends[1] == pytest.approx(ends[0], abs=1e-3)
        assert ends[1] < ends[0] + 1e-9


@pytest.mark.parametrize("structure", ["tied", "free"])
def test_no_sample_leaves_the_set(structure):
    mpc = scheme(structure=structure, state_bounds=(BOX.lower, BOX.upper))
    if structure == "free":
        with torch.no_grad():
            noise = torch.randn(mpc.C.shape, generator=torch.Generator().manual_seed(0))
            mpc.C.add_(0.02 * noise)
    plants = [PLANT, Plant.of(A, 0.8 * B, disturbances=NOISE)]
    answer = invariant_set(mpc, plants, BOX)
    assert stays(mpc, plants, answer.set)


@pytest.mark.parametrize("slack", [100.0, np.inf], ids=["soft", "hard"])
def test_a_set_that_the_policy_leaves_shrinks(slack, one_gain):
    whole = invariant_set(scheme(), PLANT, BOX).set
    mpc = bounded(-0.5, slack)
    answer = invariant_set(mpc, PLANT, BOX)
    assert answer.scale < 1
    assert (answer.set.lower > whole.lower).all()
    assert stays(mpc, [PLANT], answer.set)
    if np.isfinite(slack):
        assert not stays(mpc, [PLANT], whole)


def test_a_policy_that_saturates_has_a_larger_set_than_its_linear_law():
    """A nearly free u has gains at which the law itself violates u's bounds almost everywhere."""
    mpc = scheme(stage_weight=[1.0, 1.0, 1e-3], action_bounds=([-0.3], [0.3]))
    answer = invariant_set(mpc, PLANT, BOX)
    assert answer.gain < 1
    assert answer.proof.binaries > 0
    assert stays(mpc, [PLANT], answer.set)
    K = torch.autograd.functional.jacobian(mpc.policy, torch.zeros(2).double()).numpy()
    assert np.abs(answer.set.vertices() @ K.T).max() > 0.6


def test_the_set_lies_about_the_equilibrium(one_gain):
    """The disturbances' middle and the plant's offset move it; x = 0.4 then is the centre."""
    K = torch.autograd.functional.jacobian(scheme().policy, torch.zeros(2).double()).numpy()
    shift, middle = np.array([0.4, 0.0]), np.array([0.0, 0.01])
    offset = shift - (A + B @ K) @ shift - middle
    noise = Polytope.box(NOISE.lower + middle, NOISE.upper + middle)
    plant = Plant.of(A, B, offset=offset, disturbances=noise)
    around = Polytope.box(BOX.lower + shift, BOX.upper + shift)
    mpc = bounded(-0.1, 100.0)
    answer = invariant_set(mpc, plant, around)
    assert answer.scale < 1
    assert (answer.set.lower + answer.set.upper) / 2 == pytest.approx(shift, abs=1e-4)


def test_all_candidates_share_the_seconds(monkeypatch):
    """With seconds for each facet of each, a call of 3 s took minutes."""
    clock, given = count(), []
    monkeypatch.setattr(invariant.time, "perf_counter", lambda: float(next(clock)))
    monkeypatch.setattr(invariant, "_proof", lambda *parts: given.append(parts[-1]))
    with pytest.raises(QPError, match="or more seconds"):
        invariant_set(scheme(), PLANT, BOX, seconds=5.0)
    assert sum(given) < 5.0
    assert given


@refused(
    (lambda: invariant_set(scheme(), PLANT, BOX, seconds=-1.0), r".*seconds: got -1\.0"),
    (lambda: invariant_set(scheme(), Plant.of(2 * A, B), BOX), ".*without its inequalities"),
    (
        lambda: invariant_set(
            scheme(), Plant.of(A, B, disturbances=Polytope.box([-0.5] * 2, [0.5] * 2)), BOX
        ),
        ".*a set without a part that is proved invariant",
    ),
    (lambda: invariant_set(scheme(), PLANT, Polytope.box([0.0], [1.0])), ".*n_p = 2"),
    (lambda: invariant_set(scheme(), Plant.of([[1.0]], [[1.0]]), BOX), r".*plant\.B"),
)
def test_errors(ask, one_gain):
    ask()
