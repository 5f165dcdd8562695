"""Explicit laws: against enumeration and the on-line solver; dependent rows, slices and errors."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch

from tests.enumeration import double_integrator, enumerated
from tests.integrator import A, B, integrator
from torch_qpmpc import QPMPC, QPError, solve_qp
from torch_qpmpc.proofs import Polytope, SearchTree, explicit_law
from torch_qpmpc.proofs.plots import law_figure
from torch_qpmpc.qp.program import QuadraticProgram, Status

pytestmark = pytest.mark.layout

BOX = Polytope.box([-1.2, -0.8], [1.2, 0.8])
scheme = partial(integrator, stage_weight=[1.0, 0.5, 0.1])


def compare(mpc: QPMPC, states: Polytope, **options: Any) -> None:
    """Compare u and V with the on-line solver at random states, and the volumes with the set's."""
    law = explicit_law(mpc, states, **options)
    assert law.covered == 1
    assert law.volume == pytest.approx(1, abs=1e-6)
    generator = np.random.default_rng(0)
    s = generator.uniform(states.lower, states.upper, (2000, len(states.lower)))
    p = torch.as_tensor(law.origin + s @ law.basis.T)
    with torch.no_grad():
        solution = solve_qp(mpc.quadratic_program(), p, on_failure="mask")
    solved = (solution.status == Status.SOLVED).numpy()
    u, V = law.policy(s), law.value(s)
    assert (np.isnan(V) == ~solved).all()
    at = slice(mpc.n_p, mpc.n_p + mpc.n_u)
    assert u[solved] == pytest.approx(solution.z.numpy()[solved][:, at], abs=2e-6)
    assert V[solved] == pytest.approx(solution.value.numpy()[solved], rel=1e-6, abs=1e-8)


@pytest.mark.parametrize(
    "options",
    [
        {"state_slack": 2.0},
        {"state_slack": np.inf},
        {"state_bounds": ([-np.inf, 0.1], [np.inf, 0.1]), "state_slack": 1.0},
    ],
    ids=["soft", "hard", "equal bounds"],
)
def test_it_is_the_on_line_solvers_policy_and_value(options):
    compare(scheme(**options), BOX)


def test_a_free_c_and_a_slice_of_four_entries():
    two = np.kron(np.eye(2), A), np.kron(np.eye(2), B)
    mpc = QPMPC.from_model(
        *two, 2, stage_weight=[1.0, 0.5] * 2 + [0.1] * 2, structure="free",
        state_bounds=([-1.0] * 4, [1.0] * 4), action_bounds=([-1.0] * 2, [1.0] * 2), solver="daqp",
    )  # fmt: skip
    with torch.no_grad():
        mpc.C.add_(0.02 * torch.randn(mpc.C.shape, generator=torch.Generator().manual_seed(0)))
    compare(mpc, BOX, origin=[0.1, 0.0, 0.0, 0.6], basis=np.eye(4)[:, [0, 2]])


@pytest.mark.parametrize("slack", [3.0, np.inf])
@pytest.mark.parametrize("n", [1, 2])
def test_dependent_rows(slack, n):
    """x_1 = u_0, with the same bounds and pushed beyond them: one row of each pair is enough."""
    eye = np.eye(n)
    mpc = QPMPC.from_model(
        0 * eye, eye, 2, stage_weight=[1.0] * n + [0.5] * n, solver="daqp",
        state_bounds=(-np.ones(n), np.ones(n)), action_bounds=(-np.ones(n), np.ones(n)),
        state_slack=slack,
    )  # fmt: skip
    with torch.no_grad():
        mpc.q.sub_(5.0)
    compare(mpc, Polytope.box(-0.7 * np.ones(n), 0.7 * np.ones(n)))


def test_three_entries():
    A, B = [[1.0, 0.2, 0.02], [0.0, 1.0, 0.2], [0.0, 0.0, 1.0]], [[0.0], [0.02], [0.2]]
    mpc = QPMPC.from_model(
        A, B, 2, stage_weight=[1.0, 0.5, 0.1, 0.1], action_bounds=([-1.0], [1.0]), solver="daqp",
        state_bounds=([-1.0, -0.5, -np.inf], [1.0, 0.5, np.inf]),
    )  # fmt: skip
    compare(mpc, Polytope.box([-1.1] * 3, [1.1] * 3))


@pytest.mark.parametrize("horizon", [1, 2])
def test_the_regions_are_those_of_all_active_sets(horizon):
    law = explicit_law(double_integrator(horizon), Polytope.box([-5.0] * 2, [5.0] * 2))
    assert law.covered == 1
    assert law.volume == pytest.approx(1, abs=1e-6)

    def listed(laws):
        return sorted((*K.ravel().round(6) + 0.0, *k.round(6) + 0.0) for K, k in laws)

    walked = listed((x.K, x.k) for x in law.regions)
    assert len(walked) > horizon
    assert np.array(walked) == pytest.approx(np.array(listed(enumerated(horizon))), abs=1e-6)


def test_the_published_example_of_bemporad_and_others(monkeypatch):
    """Section 7.1 of their paper of 2002: H and F to four digits, nine regions and these gains."""
    H = np.array([[1.5064, 0.4838], [0.4838, 1.5258]])
    F = np.array([[9.6652, 5.2115], [7.0732, -7.0879]])
    whole = np.block([[200 * np.eye(2), F], [F.T, H]])  # z = (x_0, u_0, u_1)
    arrays = whole, np.zeros(4), 0.0, np.zeros((0, 4)), np.zeros(0), np.eye(4)[2:]
    bounds = [-2.0, -2.0], [2.0, 2.0], [np.inf, np.inf]
    tensors: Any = (torch.tensor(x, dtype=torch.float64) for x in (*arrays, *bounds))
    qp = QuadraticProgram(*tensors)
    mpc = scheme()
    monkeypatch.setattr(mpc, "quadratic_program", lambda: qp)
    law = explicit_law(mpc, Polytope.box([-1.5] * 2, [1.5] * 2))
    assert len(law.regions) == 9
    at = law.index([[0.0, 0.0], [0.5, -0.8], [1.5, 1.5]])
    laws = np.array([np.append(law.regions[i].K, law.regions[i].k) for i in at])
    expected = [[-5.9220, -6.8883, 0.0], [-6.4159, -4.6953, 0.6423], [0.0, 0.0, -2.0]]
    assert laws == pytest.approx(np.array(expected), abs=1e-3)


def test_a_figure_has_all_regions():
    law = explicit_law(scheme(), BOX)
    figure = law_figure(law)
    assert len(figure.axes[0].collections[0].get_paths()) == len(law.regions)  # pyright: ignore
    assert f"{len(law.regions)} regions, " in str(law)


def test_a_hole_is_counted_though_overlaps_hide_it_in_the_volumes():
    law = explicit_law(scheme(state_bounds=None), BOX)
    large, *others = sorted(law.regions, key=lambda x: -x.volume)
    share = large.volume / np.prod(BOX.upper - BOX.lower)
    holed = replace(law, regions=tuple(others))
    assert holed.covered == pytest.approx(1 - share, abs=0.02)
    assert holed.volume == pytest.approx(1 - share, abs=1e-6)
    twice = replace(law, regions=(large, large, large, *others[1:]))
    assert twice.volume > 1 > twice.covered


@pytest.mark.parametrize("shape", [(0, 2), (3, 0, 2)])
def test_no_points_have_no_actions(shape):
    s = np.zeros(shape)
    assert LAW.policy(s).shape == SearchTree.of(LAW).policy(s).shape == (*shape[:-1], 1)
    assert LAW.index(s).shape == LAW.value(s).shape == shape[:-1]


LAW = explicit_law(scheme(state_bounds=None), BOX)
THREE: Any = 3
LIST: Any = [BOX]
LETTER: Any = "a"
HARD = scheme(state_slack=np.inf)


@pytest.mark.parametrize(
    ("ask", "sentence"),
    [
        (lambda: explicit_law(scheme(), Polytope.box([0.0] * 4, [1.0] * 4)), "4 dimensions"),
        (lambda: explicit_law(scheme(), Polytope.box([0.0], [1.0])), "(2,) and (2, 1)"),
        (lambda: explicit_law(HARD, Polytope.box([3.0, 0.0], [4.0, 0.1])), "without a region"),
        (lambda: explicit_law(HARD, Polytope.box([0.95, 0.4], [0.99, 0.5])), "without a region"),
        (lambda: explicit_law(scheme(), LIST), "states: got list, expected a Polytope"),
        (lambda: explicit_law(THREE, BOX), "mpc: got int, expected a QPMPC"),
        (lambda: LAW.index([0.0]), "s: got shape (1,), expected (*batch, 2)"),
        (lambda: LAW.policy(0.0), "s: got shape (), expected (*batch, 2)"),
        (lambda: LAW.value(np.zeros((2, 3))), "s: got shape (2, 3), expected (*batch, 2)"),
        (lambda: SearchTree.of(LAW).policy([0.0]), "s: got shape (1,), expected (*batch, 2)"),
        (lambda: SearchTree.of(THREE), "law: got int, expected an ExplicitLaw"),
        (lambda: law_figure(THREE), "law: got int, expected an ExplicitLaw"),
        (lambda: law_figure(LAW, action=LETTER), "action: got 'a', expected a whole number >= 0"),
        (lambda: law_figure(LAW, action=1), "an index below 1"),
        (
            lambda: law_figure(
                explicit_law(scheme(), Polytope.box([0.0], [1.0]), basis=[[1.0], [0.0]])
            ),
            "1 entries of s",
        ),
    ],
)
def test_errors(ask, sentence):
    with pytest.raises(QPError) as raised:
        ask()
    assert sentence in str(raised.value)
