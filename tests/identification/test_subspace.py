"""Order, starts and missing outputs of identified models, on logs as people have them."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
import scipy.linalg
import scipy.signal

import torch_qpmpc as qm
from torch_qpmpc.identification import subspace
from torch_qpmpc.identification.identification import Identified
from torch_qpmpc.identification.innovations import Innovations
from torch_qpmpc.identification.likelihood import Noisy, Signals, em, groups_of, likeliest, smooth


def tank(rows: int, hold: int, seed: int, start: float = 0.0, noise: float = 0.05) -> dict:
    """Return the log of two tanks in a row, of 60 and 5 steps, in steps of the valve."""
    rng, u, k = np.random.default_rng(seed), np.zeros((rows, 1)), 0
    while k < rows:
        length = int(hold * rng.uniform(0.6, 1.4))
        u[k : k + length], k = rng.choice([0, 30, 60, 100.0]), k + length
    first = last = start
    y = np.zeros((rows + 1, 1))
    for k in range(rows + 1):
        y[k] = 5 + last + noise * rng.normal()
        if k < rows:
            first, last = first + (0.3 * u[k, 0] - first) / 60, last + (first - last) / 5
    return {"y": y, "u": u}


def arm(rows: int, seed: int, sweep: bool) -> dict:
    rng, t = np.random.default_rng(seed), np.arange(rows)
    u = np.sin(2 * np.pi * (0.003 * t + 0.1 / rows * t * t))
    if not sweep:
        u = rng.choice([-1, 1.0], rows // 4 + 1).repeat(4)[:rows]
    y = np.zeros(rows + 1)
    for w, z, gain in ((0.35, 0.01, 1.0), (0.9, 0.007, 0.5)):
        a = np.exp(-z * w)
        den = [1, -2 * a * np.cos(w), a * a]
        y[1:] += gain * np.asarray(scipy.signal.lfilter([sum(den)], den, u))
    return {"y": (y + 2e-3 * rng.normal(size=rows + 1))[:, None], "u": u[:, None]}


def off(found: Identified, log: dict, ahead: int = 20) -> float:
    """Return the RMSE ahead, after the filter has settled, on a new log."""
    y, u = log["y"], log["u"]
    errors = found.model.errors(y, u, np.zeros((len(u), 0)), ahead)[40:, -1]
    return float(np.sqrt(np.nanmean(errors**2)))


@pytest.mark.parametrize(
    ("log", "new", "order"),
    [
        (tank(160, 45, 21), tank(300, 45, 4), 2),
        (tank(400, 80, 5, noise=0.3), tank(300, 45, 6, noise=0.3), 2),
        (arm(400, 7, True), arm(300, 8, False), 4),
    ],
    ids=["a step test in one piece", "with much noise", "a sweep"],
)
def test_the_order_of_a_short_log_in_one_piece_is_enough(log, new, order):
    found, told = qm.identify(log), qm.identify(log, order=order)
    assert order <= found.fit.order
    assert off(found, new) < 1.2 * off(told, new)
    assert found.R2[-1].item() > 0.99 * (1 - off(told, new) ** 2 / log["y"].var())


def loaded(pole: float, walk: float) -> dict[str, np.ndarray]:
    """Two lags with gains [[1, .5], [0, 1]], whose loads forget 1 - ``pole`` a step."""
    rng = np.random.default_rng(0)
    x, load, a, y, u = np.zeros(2), np.zeros(2), np.array([0.6, 0.8]), [], []
    for _ in range(1500):
        u.append(rng.uniform(-1, 1, 2))
        y.append(x + rng.normal(0, 0.02, 2))
        load = pole * load + rng.normal(0, walk, 2)
        x = a * x + (1 - a) * ([[1, 0.5], [0, 1]] @ u[-1] + load)
    y, u = np.array(y), np.array(u)
    return {"y1": y[:, 0], "y2": y[:, 1], "u1": u[:, 0], "u2": u[:, 1]}


def gain(model: Innovations) -> np.ndarray:
    return model.C @ np.linalg.solve(np.eye(len(model.A)) - model.A, model.B)


@pytest.mark.usefixtures("few_orders")
@pytest.mark.parametrize(("pole", "walk"), [(0.9, 0.1), (1.0, 0.01)])
def test_the_steady_gain_is_the_plants_where_the_level_drifts(pole, walk):
    """The inputs seemed to move the drift a little: with its time, gains were off by up to 7."""
    log = loaded(pole, walk)
    read = qm.read_log(log, outputs=["y1", "y2"], inputs=["u1", "u2"])
    found = qm.identify(read)
    assert found.fit.plant is not None
    plant, C_w = found.fit.plant
    for model in (found.fit.model, plant):
        np.testing.assert_allclose(gain(model), [[1, 0.5], [0, 1]], atol=0.1)
    assert plant.E.shape[1] == C_w.shape[1] == found.fit.drifts
    assert f"of which no input moves {found.fit.drifts}" in str(found)


@pytest.mark.usefixtures("few_orders")
def test_a_load_that_drifts_is_told_from_the_level_that_it_moves():
    """The two modes at one seemed a pair, of which the input moves a part: loops were unstable."""
    rng, x, load, y, u = np.random.default_rng(3), 0.0, 0.0, [], []
    for k in range(1000):
        y.append(x + 0.01 * rng.normal())
        u.append(u[-1] if k % 5 else np.clip(-y[-1] + 0.6 * rng.uniform(-1, 1), -1, 1))
        load += 0.01 * rng.normal()
        x += 0.05 * (u[-1] + load)
    fit = qm.identify({"y": np.array(y), "u": np.array(u)}).fit
    assert (fit.order, fit.drifts) == (2, 1)
    assert pytest.approx(0.05, rel=0.02) == fit.plant[0].B


@pytest.mark.usefixtures("few_orders")
@pytest.mark.parametrize(("seed", "rows", "turn"), [(3, 300, 0.0), (76, 300, 0.0), (7, 400, 0.15)])
def test_a_level_that_drifts_is_no_mode_that_lasts(seed, rows, turn):
    """Of a walk's few rows a mode beyond one often seems likelier, or better some steps ahead."""
    rng, x, load, y, u = np.random.default_rng(seed), np.zeros(2), 0.0, [], []
    A = np.array([[0.91, turn], [-turn, 0.91]]) if turn else np.diag([0.8, 0.0])
    B = np.array([0.0, 1.3 * turn]) if turn else np.array([0.2, 0.0])
    for k in range(rows):
        u.append(u[-1] if k % 5 else rng.uniform(-1, 1))
        y.append(x[0] + 0.02 * rng.normal())
        load += 0.01 * rng.normal()
        x = A @ x + B * (u[-1] + load)
    fit = qm.identify({"y": np.array(y), "u": np.array(u)}).fit
    assert fit.drifts == 1
    assert np.abs(fit.plant[0].poles).max() < 0.94


@pytest.mark.usefixtures("few_orders")
@pytest.mark.parametrize("noise", [0.0, 0.03])
def test_a_slow_mode_that_inputs_move_is_none_of_the_drifts(noise):
    """Its gain is known to the accuracy of a log of three of its times."""
    rng, x, y, u = np.random.default_rng(1), 0.0, [], []
    for k in range(600):
        u.append(u[-1] if k % 20 else rng.uniform(-1, 1))
        y.append(x + noise * rng.normal())
        x = 0.995 * x + 0.01 * u[-1]
    model = qm.identify({"y": np.array(y), "u": np.array(u)}).fit.model
    assert abs(gain(model)[0, 0] - 2) < 0.3


def late_log(delay: int, noise: float, rows: int = 1200) -> dict[str, np.ndarray]:
    """Return the log of an output that the first of two inputs moves after a dead time."""
    rng = np.random.default_rng(0)
    u, y = rng.uniform(-1, 1, (rows // 10, 2)).repeat(10, 0), np.zeros(rows + 1)
    for k in range(rows):
        late = 0.5 * u[k - delay, 0] if k >= delay else 0.0
        y[k + 1] = 0.8 * y[k] + late + 0.1 * u[k, 1]
    return {"y": y + noise * rng.normal(size=rows + 1), "u": u}


@pytest.mark.usefixtures("rough_fits")
def test_a_dead_time_beyond_the_orders_is_told_with_the_order_that_finds_it():
    """The singular vectors of twenty predictions were at most twenty states: none was of 26."""
    log = qm.read_log(late_log(24, 0.05, 400), outputs=["y"], inputs=["u"])
    with pytest.warns(UserWarning, match="^y follows u1 2[45] rows late: .* pass order=") as told:
        assert qm.identify(log).R2[-1] < 0.5
    order = int(str(told[0].message).rstrip(".").split("=")[1])
    found = qm.identify(log, order=order)
    assert found.fit.order == order > 24
    assert found.R2[-1] > 0.99


def cycle() -> dict[str, np.ndarray]:
    """Return the log of a display of tenths behind two lags, whose input has a period."""
    u, x = np.sign(np.sin((np.arange(340) + 0.5) * np.pi / 10)), np.zeros((340, 2))
    for k in range(339):
        x[k + 1] = 0.9 * x[k, 0] + 0.1 * u[k], 0.3 * x[k, 0] + 0.7 * x[k, 1]
    return {"y": np.round(x[:, 1], 1), "u": u}


@pytest.mark.usefixtures("few_orders")
@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    "log", [late_log(4, 0.1), late_log(0, 0.0), cycle()], ids=["early", "exact", "periodic"]
)
def test_what_an_order_reaches_is_not_late(log):
    qm.identify(log)


def test_an_output_that_is_seldom_seen_is_identified():
    """No row had an output to start a fit from: numpy's own error ended it."""
    log = late_log(0, 0.02)
    log["y"][np.arange(1201) % 25 > 0] = np.nan
    assert np.abs(qm.identify(log, order=1).fit.model.poles) == pytest.approx(0.8, abs=0.05)


def test_an_order_above_what_the_log_shows_is_what_it_shows():
    """Without noise two states are nearly all: the outputs alone were the model of order 4."""
    rng, x, y = np.random.default_rng(0), np.zeros(2), np.zeros(401)
    u = rng.uniform(-1, 1, 400)
    for k in range(400):
        x = np.array([[0.8, 0.3], [0.0, 0.5]]) @ x + [0.0, u[k]]
        y[k + 1] = x[0]
    found = qm.identify({"y": y, "u": u}, order=4)
    assert 2 <= found.fit.order < 4
    assert found.R2[-1].item() > 0.999


def test_the_report_names_orders_that_the_log_does_not_tell_apart():
    rows = [(0, 0, 3.0, 0.1), (1, 2, 0.05, 0.04), (2, 2, 0.0, 0.0), (3, 2, 0.003, 0.0)]
    rows = [subspace.Candidate(*row) for row in rows]
    assert [row.order for row in subspace.equal_candidates(rows)] == [1, 2, 3]
    far = rows[1]._replace(score=0.15, error=0.2)
    assert [row.order for row in subspace.equal_candidates([far, rows[2]])] == [2], "5 % at most"


@pytest.mark.parametrize("pieces", [1, 16])
def test_a_simulation_may_start_anywhere_in_the_range_of_the_log(pieces):
    found = qm.identify([tank(800 // pieces, 60, seed) for seed in range(pieces)], order=2)
    model, (y, u) = found.fit.model, tank(150, 60, 99, start=25.0).values()
    inputs = model.inputs(u, np.zeros((len(u), 0)))
    for w in (1, 5, 20, 40):
        rows, right, power, moved = [], [], np.eye(2), np.zeros(2)
        for k in range(w):
            rows.append(model.C @ power)
            right.append(y[k] - model.C @ moved)
            power, moved = model.A @ power, model.A @ moved + inputs[k]
        x, own = np.linalg.lstsq(np.vstack(rows), np.concatenate(right), rcond=None)[0], []
        for k in range(w + 50):
            own.append(model.C @ x)
            x = model.A @ x + inputs[k]
        found_off, own_off = (
            np.sqrt(np.mean((np.asarray(z)[w : w + 50] - y[w : w + 50]) ** 2))
            for z in (found.simulate(u, y[:w]), own)
        )
        assert found_off < 1.5 * own_off + 0.02


@pytest.mark.usefixtures("rough_fits")
@pytest.mark.parametrize("kind", ["a fifth", "every third row"])
def test_missing_outputs_cost_only_their_information(kind):
    log, new = tank(400, 40, 11), tank(300, 45, 12)
    y, rng = log["y"].copy(), np.random.default_rng(13)
    gone = rng.random(len(y)) < 0.2 if kind == "a fifth" else np.arange(len(y)) % 3 > 0
    y[gone] = np.nan
    found = qm.identify({"y": y, "u": log["u"]})
    assert len(found.log.trajectories) == 1
    assert off(found, new) < 1.15 * off(qm.identify(log, order=2), new)
    assert "outputs missing" in str(found)


def test_a_sensor_that_seldom_answers_is_no_set_point():
    """Its last value, held between its answers, is constant in most rows: a walk was its model."""
    rng, y = np.random.default_rng(1), np.zeros((301, 2))
    u = rng.uniform(-3, 3, (28, 2)).repeat(11, 0)[:300]
    for k in range(300):
        y[k + 1] = 0.9 * y[k] + [[0.25, 0.05], [0.02, 0.2]] @ u[k] + 0.02 * rng.normal(size=2)
    y[np.arange(301) % 10 > 0, 1] = np.nan
    model = qm.identify({"y": y, "u": u}, order=2).fit.model
    gain = model.C @ np.linalg.solve(np.eye(2) - model.A, model.B)
    assert np.allclose(gain, [[2.5, 0.5], [0.2, 2.0]], atol=0.05)


def test_the_windows_of_a_log_take_memory_once():
    """They were kept for each fold and lag: a million rows of five signals took 12 GB."""
    log = tank(3000, 60, 1)
    tracemalloc.start()
    qm.identify(log, order=2)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 4 * (40 * 2 * 3000 * 8), "four times the longest windows"


def likelihood(par: Noisy, data: list[Signals]) -> float:
    return sum(smooth(par, group).likelihood for group in groups_of(data))


def oscillation() -> tuple[Noisy, list[Signals]]:
    """Return a start and the log of an oscillation, whose first state is measured."""
    rng, A, x = np.random.default_rng(2), np.array([[0.95, 0.2], [-0.2, 0.95]]), np.zeros(2)
    y, u = np.zeros((300, 1)), rng.normal(size=(299, 1))
    for k in range(300):
        y[k] = x[0] + 1e-3 * rng.normal()
        x = A @ x + ([0.0, 1.0] * u[k] if k < 299 else 0) + 0.1 * rng.normal(size=2)
    rest = np.eye(1, 2), np.eye(2), np.eye(1), np.zeros(2), np.eye(2)
    return Noisy(0.7 * A, np.ones((2, 1)), *rest), [Signals(y, u)]


def test_longer_steps_raise_the_likelihood_faster():
    start, data = oscillation()
    values = [likelihood(em(start, data, count, 1.2), data) for count in (0, 5, 10, 20, 30)]
    assert np.all(np.diff(values) > 0)
    assert values[-1] > likelihood(em(start, data, 30), data) + 4
    gained = values[-1] - values[0]
    assert em(start, data, 30, 1.2, 1.01 * gained / 300) is start
    assert em(start, data, 30, 1.2, 0.99 * gained / 300) is not start


def test_the_likeliest_model_is_at_a_maximum():
    start, data = oscillation()
    value, found = likeliest(start, data)
    assert likelihood(found, data) >= value > likelihood(em(start, data, 200, 1.2), data)
    for name, part in found._asdict().items():
        for change in (1 - 1e-3, 1 + 1e-3):
            assert likelihood(found._replace(**{name: change * part}), data) < value + 0.01


def test_a_model_that_overflows_has_no_likelihood():
    start, data = oscillation()
    broken = start._replace(A=np.full((2, 2), np.nan))
    value, found = likeliest(broken, data)
    assert value == -np.inf
    assert found is broken


def test_a_likelier_model_that_predicts_worse_far_ahead_is_not_taken():
    """One of two states, of a plant with three: the likeliest is off by 0.4 far ahead."""
    rng, x = np.random.default_rng(0), np.zeros(3)
    A = np.array([[0.98, 0.1, 0], [-0.1, 0.95, 0.1], [0, 0, 0.6]])
    y, u = np.zeros((501, 1)), rng.uniform(-1, 1, (500, 1))
    for k in range(501):
        y[k] = x[0] + 1e-3 * rng.normal()
        x = A @ x + [0, 0.2, 1] * u[min(k, 499)] + [0, 0, 0.03] * rng.normal(size=3)
    log = {"y": y, "u": u}
    assert off(qm.identify(log, order=2), log) < 0.1


@pytest.mark.parametrize("n_y", [1, 2])
def test_a_likelihood_that_is_no_number_leaves_the_last_model(n_y):
    y, one = np.random.default_rng(0).normal(size=(20, n_y)), np.eye(n_y)
    B, rest = np.ones((n_y, 1)), (one, one, one, np.zeros(n_y), one)
    start, data = Noisy(0.5 * one, B, *rest), [Signals(y, np.ones((19, 1)))]
    assert np.isfinite(em(start, data, 3).A).all()
    broken = start._replace(A=np.full((n_y, n_y), np.nan))
    assert em(broken, data, 3) is broken


def test_states_without_finite_squares_leave_the_last_model():
    A, one = np.diag([2.0, 0.5, 0.4, 0.3]), np.eye(4)
    start = Noisy(A, one[:, :1], 1e-190 * one, one, one, 1e60 * np.ones(4), one)
    assert em(start, [Signals(np.zeros((400, 4)), np.ones((399, 1)))], 3) is start


def test_smoothed_states_are_the_means_given_the_outputs_that_are_there():
    """States and outputs are one Gaussian vector: its conditional moments are exact."""
    rng, n, n_y, T = np.random.default_rng(0), 3, 2, 250
    A, B, C = 0.4 * rng.normal(size=(n, n)), rng.normal(size=(n, 1)), rng.normal(size=(n_y, n))
    Q, R, m, P0 = 0.3 * np.eye(n) + 0.1, np.array([[0.5, 0.2], [0.2, 0.4]]), np.ones(n), np.eye(n)
    y, v = rng.normal(size=(T, n_y)), np.ones((T - 1, 1))
    y[[0, 2, 5, 5, 6], [1, 0, 0, 1, 1]] = y[100:170, 0] = np.nan
    found = smooth(Noisy(A, B, C, Q, R, m, P0), groups_of([Signals(y, v)])[0])
    mean, cov = [m], [P0]
    for _ in range(T - 1):
        mean.append(A @ mean[-1] + B[:, 0])
        cov.append(A @ cov[-1] @ A.T + Q)
    whole = np.zeros((T, n, T, n))
    for i in range(T):
        part = cov[i]
        for j in range(i, T):
            whole[j, :, i], whole[i, :, j] = part, part.T
            part = A @ part
    whole = whole.reshape(T * n, T * n)
    seen = np.isfinite(y).ravel()
    H, V = np.kron(np.eye(T), C)[seen], np.kron(np.eye(T), R)[np.ix_(seen, seen)]
    V = H @ whole @ H.T + V
    e, K = y.ravel()[seen] - H @ np.concatenate(mean), whole @ H.T @ np.linalg.inv(V)
    exact = (whole - K @ H @ whole).reshape(T, n, T, n)
    x = (np.concatenate(mean) + K @ e).reshape(1, T, n)
    assert len(found.P) < 200, "settled covariances are computed once"
    np.testing.assert_allclose(found.x, x, atol=1e-7)
    for k in range(T):
        np.testing.assert_allclose(found.P[found.at[k]], exact[k, :, k], atol=1e-7)
    cross = sum(exact[k + 1, :, k] for k in range(T - 1))
    np.testing.assert_allclose(found.cross, cross, atol=1e-7)
    likelihood = -(np.linalg.slogdet(V)[1] + e @ np.linalg.solve(V, e)) / 2
    assert found.likelihood == pytest.approx(likelihood)


def test_estimates_of_the_innovations_form_are_those_of_the_textbook_filter_with_gaps():
    rng = np.random.default_rng(1)
    A, C = np.array([[0.9, 0.2], [-0.1, 0.8]]), np.array([[1.0, 0.0], [0.3, 1.0]])
    Q, R = np.diag([0.05, 0.02]), np.array([[0.1, 0.02], [0.02, 0.3]])
    steady = scipy.linalg.solve_discrete_are(A.T, C.T, Q, R)
    S = C @ steady @ C.T + R
    L, none, start = steady @ C.T @ np.linalg.inv(S), np.zeros((2, 0)), np.array([1.0, -1.0])
    form = Innovations(A, none, none, np.zeros(2), C, L, S, start, 4 * np.eye(2) - steady)
    y = rng.normal(size=(2, 40, 2))
    y[0, 5:12], y[0, 20:, 1], y[1, ::3, 0] = np.nan, np.nan, np.nan
    xi = form.estimates(y, *np.zeros((2, 2, 39, 0)))
    for own, one in zip(xi, y, strict=True):
        x, P = start, 4 * np.eye(2)
        for row, estimate in zip(one, own, strict=True):
            seen = np.isfinite(row)
            H, V = C[seen], R[np.ix_(seen, seen)]
            K = P @ H.T @ np.linalg.inv(H @ P @ H.T + V)
            x, P = x + K @ (row[seen] - H @ x), P - K @ H @ P
            np.testing.assert_allclose(estimate, x, atol=1e-9)
            x, P = A @ x, A @ P @ A.T + Q
