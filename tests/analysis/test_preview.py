"""A model with previews is read as it is, from the QP and in any gauge."""

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from tests.figures import image_of, rendered
from tests.problems import drawn_mpc, model_form, normal, predict
from tests.refused import refused
from torch_qpmpc import QPMPC, DeviationPenalty
from torch_qpmpc.analysis import structure
from torch_qpmpc.analysis.plots import canonical_figure
from torch_qpmpc.analysis.policy import local_gain
from torch_qpmpc.analysis.report import read
from torch_qpmpc.mpc.layout import Layout, band_distance, banded_matrix
from torch_qpmpc.mpc.riccati import stage_weight

pytestmark = pytest.mark.layout

N_X, N_U, N_D, N = 2, 1, 2, 5
LAYOUT = Layout(N_X, N_U, N, N_D)
A = 0.2 * normal(N_X, N_X, seed=1) + 0.4 * torch.eye(N_X)
B, E, OFFSET = normal(N_X, N_U, seed=2), normal(N_X, N_D, seed=3), normal(N_X, seed=4)


def scheme(**options: Any) -> QPMPC:
    settings = {"E": E, "offset": OFFSET, "solver": "daqp", "learn": ("H", "c", "C", "b")}
    settings["stage_weight"] = [1.0, 0.5, 0.2]
    return QPMPC.from_model(A, B, N, **(settings | options))


def step(p: Tensor, U: Tensor, A: Tensor = A, B: Tensor = B, E: Tensor = E) -> Tensor:
    """Step the model over the horizon, ``(N, N_X)``; A, B and E may have a leading N."""
    A, B, E = (x.expand(N, *x.shape[-2:]) for x in (A, B, E))
    d, x = p[:-N_X].view(N + 1, N_D), [p[-N_X:]]
    for k in range(N):
        x.append(A[k] @ x[-1] + B[k] @ U[k] + E[k] @ d[k] + OFFSET)
    return torch.stack(x[-N:])


def model() -> structure.PredictionForm:
    return model_form(A, B, N, OFFSET, E)


# The prediction form


@pytest.mark.parametrize("stages", [(), (N,)], ids=["tied", "varying"])
def test_predictions_are_those_of_stepping_the_model(stages):
    parts = [x + 0.1 * normal(*stages, *x.shape, seed=5) for x in (A, B, E)]
    form = model_form(parts[0], parts[1], N, OFFSET, parts[2])
    p, U = normal(4, LAYOUT.n_p), normal(4, N, N_U, seed=1)
    predicted = predict(form, p, U)
    for i in range(4):
        assert_close(predicted[i], step(p[i], U[i], *parts), rtol=1e-12, atol=1e-12)
    maps = form.maps @ torch.cat((p[0], U[0].flatten(), torch.ones(1).double()))
    assert_close(maps, torch.cat((p[0, -N_X:].unsqueeze(0), predicted[0])))


def test_solutions_of_the_qp_are_predicted():
    mpc, p = scheme(), normal(6, LAYOUT.n_p)
    states, actions = mpc.predicted(mpc.solve(p).z.detach())
    assert_close(
        predict(structure.predictions(mpc), p, actions), states[:, 1:], rtol=1e-6, atol=1e-6
    )


def test_a_scheme_in_any_gauge_is_a_scheme():
    C_0, T = banded_matrix(A, B, N, E), normal(N * N_X, N * N_X, seed=6)
    form = structure.prediction_form(T @ C_0, N_X, N_U, -T @ OFFSET.repeat(N), N_D)
    for part in ("Phi", "Gamma", "phi"):
        assert_close(getattr(form, part), getattr(model(), part), rtol=0, atol=1e-10)
    found, stages = structure.nearest_model(form), structure.stage_models(form)
    for name, expected in (("A", A), ("B", B), ("E", E), ("offset", OFFSET)):
        assert_close(getattr(found, name), expected, rtol=0, atol=1e-9)
        each = getattr(stages, name)
        assert_close(each, expected.expand_as(each), rtol=0, atol=1e-9)
    assert max(found.residual, stages.residual.max()) < 1e-9
    assert max(structure.causality_defect(form), structure.toeplitz_defect(form)) < 1e-10
    C, b = structure.canonical_matrix(form)
    assert_close(C, C_0, rtol=0, atol=1e-9)
    assert_close(b, -OFFSET.repeat(N), rtol=0, atol=1e-9)


# Errors, gains and the report


def test_errors_of_the_model():
    found = structure.nearest_model(structure.predictions(scheme()))
    wrong = (A + 0.1 * normal(*A.shape), B + 0.1 * normal(*B.shape, seed=8), E + 0.1)
    differences = [(x - y).flatten() for x, y in zip(wrong, (A, B, E), strict=True)]
    expected = torch.cat(differences).norm()
    assert_close(structure.one_step_error(found, *wrong[:2], OFFSET, E=wrong[2]), expected)
    s, a, d = normal(50, N_X), normal(50, N_U, seed=1), normal(50, N_D, seed=2)
    error = s @ (wrong[0] - A).mT + a @ (wrong[1] - B).mT + d @ (wrong[2] - E).mT
    v = torch.cat((s, a, d, torch.ones(50, 1)), -1)
    moment = v.mT @ v / 50
    expected = error.square().sum(-1).mean().sqrt()
    assert_close(structure.one_step_error(found, *wrong[:2], OFFSET, moment, wrong[2]), expected)
    assert_close(structure.one_step_error(found, A, B, E=E), OFFSET.norm())


def test_the_gain_is_the_slope_of_the_policy_in_all_that_is_known():
    mpc, p = scheme(action_bounds=([-0.4], [0.4])), normal(6, LAYOUT.n_p)
    K, h = local_gain(mpc, p), 1e-5
    assert K.shape == (6, N_U, LAYOUT.n_p)
    for i, unit in enumerate(torch.eye(LAYOUT.n_p).double()):
        with torch.no_grad():
            slope = (mpc.policy(p + h * unit) - mpc.policy(p - h * unit)) / (2 * h)
        assert_close(-K[..., i], slope, rtol=1e-5, atol=1e-5)
    assert (K != 0).any(-1).any()


def test_the_report_of_a_scheme_compares_it_with_the_regulator():
    mpc = QPMPC.from_model(
        A, B, 16, E=E, gamma=0.95, hessian="block", stage_weight=[1.0, 0.5, 0.2], solver="daqp"
    )
    found = read(mpc, (A, B, torch.zeros(N_X), E))
    expected = dict.fromkeys(("causality", "distance_to_mpc", "model_error"), 0.0)
    assert {name: found.scalars()[name] for name in expected} == pytest.approx(expected, abs=1e-6)
    assert found.non_markov < 1e-6
    assert found.gain_to_lqr < 1e-3  # the horizon is finite
    assert stage_weight(mpc).diagonal().tolist() == pytest.approx([1.0, 0.5, 0.2])
    x, radius = normal(mpc.n_p)[17 * N_D :], found.radius
    closed = A - B @ found.K[:, 17 * N_D :]
    assert (torch.linalg.matrix_power(closed, 50) @ x).norm() < 100 * radius**50
    assert radius == pytest.approx(found.radius_predicted)
    lines = str(found).splitlines()
    assert [line.split()[0] for line in lines if line[0] in "ABEK"] == ["A", "B", "E", "K"]
    wrong = read(mpc, (A, B, torch.zeros(N_X), E + 0.1))
    assert wrong.model_error == pytest.approx(0.1 * (N_X * N_D) ** 0.5)


# The band


def test_the_band_of_a_preview():
    a, o, b = 3.0, 5.0, 7.0
    expected = torch.tensor(
        [  # d_0, d_1, d_2, d_3, x_0, u_0, x_1, u_1, x_2, u_2, x_3
            [o, a, a, a, o, o, o, a, a, a, a],
            [b, o, a, a, b, b, o, o, o, a, a],
            [b, b, o, a, b, b, b, b, o, o, o],
        ]
    )
    weights = {"c_1": a, "c_2": o, "c_3": b}
    mpc, moved = drawn_mpc(1, 1, 3, n_d=1), torch.arange(33).view(3, 11) - 16
    assert torch.equal(DeviationPenalty(mpc, **weights).C_mask, expected.double())
    with torch.no_grad():
        mpc.C += moved
    found = structure.distance_by_band(mpc)
    for name, weight in (("on", o), ("above", a), ("below", b)):
        where = expected == weight
        assert found[name] == moved[where].abs().sum()
    distance = band_distance(LAYOUT)
    C = banded_matrix(A, B, N, E)
    assert (C[distance != 0] == 0).all()
    assert int((C[distance == 0] == 0).sum()) == N * N_X * (N_X - 1)


# Figures


def test_figures_are_drawn_and_labelled():
    mpc = scheme()
    figure = canonical_figure(mpc)
    for axes in figure.axes:
        if axes.images:
            labels = {x.get_text() for x in axes.get_xticklabels()}
            assert {"$d_{0}$", "$x_{0}$"} <= labels
            assert np.isfinite(image_of(axes)).all()
    rendered(figure)


@refused(
    (
        lambda: structure.prediction_form(torch.zeros(10, 32), N_X, N_U, None, N_D),
        r"C: got shape \(10, 32\), expected .* with n_x = 2, n_u = 1, n_p = 14",
    ),
    (lambda: read(scheme(), (A[:, :1], B)), r"true_model's A: got shape \(2, 1\), expected shape"),
    (lambda: read(scheme(), (A, B, OFFSET, E[:, :1])), r"true_model's E: got shape \(2, 1\)"),
    (lambda: read(scheme(), at=torch.zeros(2)), r"at: got shape \(2,\), expected shape \(14,\)"),
    (
        lambda: structure.one_step_error(structure.nearest_model(model()), A, B, E=E[:, :1]),
        r"E: got shape \(2, 1\), expected shape \(2, 2\)",
    ),
)
def test_bad_input(call):
    call()
