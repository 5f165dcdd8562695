"""Identified state-space models in innovations form, and their filter."""

import numpy as np
import pytest
import scipy.linalg
import torch

from torch_qpmpc.errors import QPError
from torch_qpmpc.identification import innovations
from torch_qpmpc.identification.identification import identify
from torch_qpmpc.identification.innovations import Innovations
from torch_qpmpc.identification.log import Trajectory
from torch_qpmpc.identification.subspace import fit_state_space, held_out_errors, whiteness

A = np.array([[0.9, 0.2, 0.0], [-0.2, 0.9, 0.1], [0.0, 0.0, 0.7]])
B = np.array([[0.0, 0.1], [0.5, 0.0], [0.0, 1.0]])
C = np.array([[1.0, 0.0, 0.0], [0.0, 0.5, 0.5]])
pytestmark = pytest.mark.usefixtures("few_orders")

# Each noise has its own source.
Q, R = 0.01 * np.eye(3), np.diag([0.04, 0.02])


def trajectory(y, u, d=None) -> Trajectory:
    d = np.zeros((len(u), 0)) if d is None else d
    return Trajectory(*map(torch.as_tensor, (y, u, d)))


def noisy(count: int, steps: int, seed: int = 0, Q=Q, R=R, A=A, B=B, C=C) -> list[Trajectory]:
    rng, n, n_y = np.random.default_rng(seed), len(A), len(C)
    u, x = rng.uniform(-1, 1, (count, steps, B.shape[1])), rng.normal(size=(count, n))
    w = rng.multivariate_normal(np.zeros(n), Q, (count, steps + 1))
    v, y = rng.multivariate_normal(np.zeros(n_y), R, (count, steps + 1)), []
    for k in range(steps + 1):
        y.append(x @ C.T + v[:, k])
        if k < steps:
            x = x @ A.T + u[:, k] @ B.T + w[:, k]
    return [trajectory(y, u) for y, u in zip(np.stack(y, 1), u, strict=True)]


def exact(A, B, count=20, steps=30, seed=1) -> list[Trajectory]:
    none = np.zeros_like(A)
    return noisy(count, steps, seed, none, none, A, B, np.eye(len(A)))


def arrays(data: list[Trajectory]):
    return [[part.numpy() for part in log] for log in data]


def true_form() -> Innovations:
    """The innovations form of the matrices above, in the plant's own states."""
    P = scipy.linalg.solve_discrete_are(A.T, C.T, Q, R)
    S = C @ P @ C.T + R
    L = P @ C.T @ np.linalg.inv(S)
    return Innovations(A, B, np.zeros((3, 0)), np.zeros(3), C, L, S, np.zeros(3), np.eye(3) - P)


def test_first_gains_are_those_of_the_textbook_filter():
    form, P = true_form(), np.eye(3)
    gains = form.settling(200)[0]
    assert 3 < len(gains) < 200
    for k in range(len(gains) + 3):
        V = C @ P @ C.T + R
        L = P @ C.T @ np.linalg.inv(V)
        own = gains[k] if k < len(gains) else form.L
        np.testing.assert_allclose(own, L, atol=1e-8)
        P = A @ (P - L @ V @ L.T) @ A.T + Q


def test_the_filter_of_slow_disturbances_is_the_textbooks():
    """With units far apart, an output that stays and one that the innovations hardly move."""
    T, size = np.concatenate((C, [[0.0, 1.0, -1.0]])), np.array([1e4, 1e-3, 1.0])
    form = true_form().transformed(size[:, None] * T, np.linalg.inv(T) / size, np.zeros(3))
    for model in (form, form._replace(L=form.L * [1.0, 1e-3])):
        slow, S = model.disturbed(), model.S
        w = slow.A[:3, 3:]
        np.testing.assert_array_equal(w[:2], np.eye(2))
        np.testing.assert_array_equal(slow.A[3:], np.eye(5)[3:] * innovations.DECAY)
        drift = np.zeros((5, 5))
        drift[3:, 3:] = innovations.DRIFT**2 * np.diag(np.diag(S))
        P = np.zeros((5, 5))  # of the errors of the predictions, whose noise has moved the state
        N = np.concatenate((model.L, np.zeros((2, 2)))) @ S
        for _ in range(3000):
            V = slow.C @ P @ slow.C.T + S
            gain = np.linalg.solve(V, slow.C @ P + N.T).T
            after = P + N @ np.linalg.solve(S, N.T) - gain @ V @ gain.T
            P = slow.A @ after @ slow.A.T + drift
        units = np.append(size, size[:2])
        np.testing.assert_allclose(
            slow.L * size[:2] / units[:, None], gain * size[:2] / units[:, None], atol=1e-6
        )
        np.testing.assert_allclose(slow.S, V, rtol=1e-6)
        assert np.abs(np.linalg.eigvals(slow.A - slow.A @ slow.L @ slow.C)).max() < 0.9999
    stays = form._replace(A=np.block([[form.A[:1]], [np.eye(3)[1:2]], [form.A[2:]]]))
    assert len(stays.disturbed().A) == 4
    assert len(form._replace(S=np.diag([1.0, 0.0])).disturbed().A) == 4


@pytest.mark.parametrize("seed", range(3))
def test_predictions_follow_a_plant_that_drifts_away_from_its_log(seed):
    """A steady load, which the log has not shown, biases the predictions about half as much."""
    found = identify([dict(zip("yu", arrays(noisy(1, 600, seed))[0], strict=False))], order=3)
    one = noisy(1, 400, seed + 10)[0]
    load = np.zeros((401, 3))
    for k in range(400):
        load[k + 1] = A @ load[k] + [0.3, 0.0, 0.3]
    y, none = one.y.numpy() + load @ C.T, np.zeros((400, 0))
    off, own = (
        x.errors(y, one.u.numpy(), none, 20)[150:, -1] for x in (found.fit.model, found.model)
    )
    assert abs(np.nanmean(own[:, 0])) < 0.6 * np.nanmean(off[:, 0])
    assert len(found.model.A) == len(found.fit.model.A) + 2
    assert found.errors.shape == (600, 20, 2)


def test_a_fit_has_the_poles_gain_and_noise_of_the_plant():
    data = noisy(20, 200)
    model, true = fit_state_space(data, 3, 10).model, true_form()
    np.testing.assert_allclose(np.sort_complex(model.poles), np.sort_complex(true.poles), atol=0.03)
    np.testing.assert_allclose(model.S, true.S, atol=0.08 * np.trace(true.S))
    np.testing.assert_array_equal(model.C, np.eye(2, 3))
    own, best = (
        np.concatenate([form.errors(y, u, d, 10) for y, u, d in arrays(noisy(10, 100, seed=5))])
        for form in (model, true)
    )
    ratio = np.nanmean(own**2, 0) / np.nanmean(best**2, 0)
    assert ratio.max() < 1.03


PLANTS = {
    "all measured": (np.array([[0.9, 0.2], [-0.2, 0.9]]), np.array([[0.0], [0.5]])),
    "with a set-point": (
        np.array([[0.9, 0.2, 0.0], [-0.2, 0.9, 0.1], [0.0, 0.0, 1.0]]),
        np.array([[0.0], [0.5], [0.0]]),
    ),
    "an integrator": (np.array([[1.0, 0.1], [0.0, 1.0]]), np.array([[0.0], [0.1]])),
}


@pytest.mark.parametrize("name", PLANTS)
@pytest.mark.parametrize(("count", "steps"), [(20, 30), (1, 300), (40, 5)])
def test_an_exact_plant_is_its_outputs(name, count, steps):
    if name == "with a set-point" and count == 1:
        pytest.skip("One trajectory has one set-point.")
    A, B = PLANTS[name]
    data = exact(A, B, count, steps)
    model, n = fit_state_space(data).model, len(A)
    np.testing.assert_allclose(model.A, A, atol=1e-9)
    np.testing.assert_allclose(model.B, B, atol=1e-9)
    np.testing.assert_allclose(model.offset, 0, atol=1e-9)
    np.testing.assert_array_equal(model.C, np.eye(n))
    for y, u, d in arrays(data):
        np.testing.assert_allclose(model.estimates(y, u, d), y, atol=1e-9)


@pytest.mark.parametrize("order", [0, 3])
def test_units_change_no_estimate(order):
    data, size_y, size_u = noisy(10, 50), np.array([1e6, 1e-6]), np.array([1e-6, 1e4])
    shift = np.array([3e6, -2e-6])
    scaled = [trajectory(y * size_y + shift, u * size_u, d) for y, u, d in map(tuple, arrays(data))]
    one, other = (fit_state_space(data, order, 5).model, fit_state_space(scaled, order, 5).model)
    for (y, u, d), (ys, us, ds) in zip(arrays(data), arrays(scaled), strict=True):
        xi = one.estimates(y, u, d)[:, :2]
        np.testing.assert_allclose(
            (other.estimates(ys, us, ds)[:, :2] - shift) / size_y, xi, atol=1e-6
        )


def test_outputs_that_stay_in_a_trajectory_are_known_to_the_others():
    rng, data, hidden = np.random.default_rng(4), [], np.array([[0.2], [0.3]])
    for y, u, d in arrays(noisy(20, 50)):
        goal, effect = rng.normal(size=(1, 1)), np.zeros((51, 2))
        for k in range(50):
            effect[k + 1] = 0.5 * effect[k] + (hidden @ goal).ravel()
        goals = np.tile(goal, (51, 1))
        data.append(trajectory(np.hstack((y[:, :1] + effect[:, :1], goals, y[:, 1:])), u, d))
    model = fit_state_space(data, order=4, lags=5).model
    n = len(model.A)
    np.testing.assert_allclose(model.A[1], np.eye(n)[1])
    np.testing.assert_allclose(model.L[1], [0, 1, 0])
    np.testing.assert_allclose(model.B[1], 0)
    for y, u, d in arrays(data[:3]):
        xi = model.estimates(y, u, d)
        np.testing.assert_allclose(xi[:, 1], y[:, 1], atol=1e-9)
        assert np.square(xi[:, 0] - y[:, 0]).mean() < 0.05


def test_order_and_lags_are_those_of_the_least_held_out_errors():
    data = noisy(20, 60)
    fit = fit_state_space(data)
    best = min(row.score for row in fit.candidates)
    assert fit.order == 3
    assert fit.lags > 0
    assert {row.order for row in fit.candidates} >= {0, 3}
    assert min(row.score for row in fit.candidates if row.order == 3) < best + 0.03
    assert min(row.score for row in fit.candidates if row.order < 3) > best + 0.03
    errors, outputs = held_out_errors(data, fit.parts, 5), torch.cat([x.y for x in data]).numpy()
    assert errors.shape == (20 * 60, 5, 2)
    assert np.isfinite(errors[:, 0]).all(1).sum() == 20 * 45, "filters settle in a quarter"
    assert (np.nanmean(errors**2, 0) < 0.5 * outputs.var(0)).all()
    assert (whiteness(fit.model, data) >= 0.8).all()
    coloured = fit.model._replace(L=0 * fit.model.L)
    assert whiteness(coloured, data).max() < 0.6


def test_trajectories_that_are_all_too_short_are_named():
    short = trajectory(np.zeros((9, 2)), np.zeros((8, 2)))
    with pytest.raises(QPError, match=r"^trajectories: got none of 10 steps without gaps, expec"):
        fit_state_space([short] * 3, 2, 10)
