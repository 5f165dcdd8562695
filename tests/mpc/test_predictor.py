"""Exactness without noise, agreement with plain regressions, and errors on fresh data with it."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F
from torch.testing import assert_close

from tests.logs import OFFSET, A, B, E, arx_log
from torch_qpmpc.mpc.layout import Layout
from torch_qpmpc.mpc.log import Trajectory, as_log
from torch_qpmpc.mpc.predictor import (
    Constraints,
    Options,
    arx,
    fit,
    outputs_in,
    predict,
    prediction_errors,
    transitions,
    windows,
)
from torch_qpmpc.mpc.ridge import ridge

N = 8
STARTS = [("tied", True), ("varying", True), ("free", True), ("free", False)]


def trajectories(*args, **options) -> list[Trajectory]:
    return [*as_log(arx_log(*args, **options), n_d=1).trajectories]


def layout(past: int, horizon: int = N) -> Layout:
    return Layout(2, 1, horizon, past, 1)


# Windows


def test_a_window_is_z():
    sizes, (log, *_) = layout(3), trajectories()
    Z, _ = windows([log], sizes)
    assert Z.shape == (40 - 2, sizes.n_z)
    k = 5  # the start at step 7
    pairs = torch.cat((log.y[:-1], log.u), dim=-1)
    plan = torch.cat((pairs[k : k + 2 + N].flatten(), log.y[7 + N : 8 + N].flatten()))
    assert torch.equal(Z[k, sizes.n_preview :], plan)
    assert torch.equal(Z[k, : sizes.n_preview], log.d[7 : 8 + N].flatten())
    assert torch.equal(Z[k][outputs_in(sizes)], log.y[8 : 8 + N])


def test_what_is_after_the_end_is_zero():
    sizes, (log, *_) = layout(3), trajectories()
    z = windows([log], sizes).z[-1]
    assert torch.equal(z[outputs_in(sizes)[0]], log.y[-1])
    assert (z[outputs_in(sizes)[1:]] == 0).all()
    assert (z[1 : sizes.n_preview] == 0).all()


# Without noise


def test_the_model_is_exact():
    found = arx(trajectories(), layout(2))
    for part, true in zip(found, (A, B, E, OFFSET), strict=True):
        assert_close(part, true, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize(("structure", "causal"), STARTS)
@pytest.mark.parametrize("past", [2, 4])
def test_all_predictions_are_exact(structure, causal, past):
    """With more lags than the plant has, the regressors are singular."""
    options = Options(layout(past), structure, causal)
    _, found = fit(trajectories(), options)
    errors = prediction_errors(trajectories(seed=1), found, layout(past), causal)
    assert errors.isfinite().any(0).all()
    assert errors[errors.isfinite()].abs().max() < 1e-8


def test_without_noise_nothing_is_corrected():
    C_0 = fit(trajectories(), Options(layout(2), "tied"))[1].C
    for structure, causal in STARTS:
        assert_close(fit(trajectories(), Options(layout(2), structure, causal))[1].C, C_0)


# With noise


@pytest.mark.parametrize(("structure", "causal"), STARTS)
def test_each_structure_has_its_zeros(structure, causal):
    sizes = layout(2)
    C, b = fit(trajectories(noise=0.2), Options(sizes, structure, causal))[1]
    blocks = C.unflatten(0, (N, 2))
    for k in range(N):
        row = blocks[k]
        assert torch.equal(row[:, outputs_in(sizes)[k]], -torch.eye(2).double())
        assert (row[:, outputs_in(sizes)[k + 1 :].flatten()] == 0).all()
        later = [i for j in range(k + 1, N) for i in (j, sizes.n_p + 3 * j)]
        assert (row[:, later] == 0).all() or (not causal and k < N - 1)
        if structure != "free":
            band = {k, *range(sizes.n_preview + 3 * k, sizes.n_preview + 3 * k + 6)}
            band |= set(outputs_in(sizes)[k].tolist())
            assert set(row.any(0).nonzero().flatten().tolist()) <= band
    if structure == "tied":
        assert_close(b.unflatten(0, (N, 2)), b[:2].expand(N, 2))


def test_a_free_predictor_without_a_ridge_is_the_plain_regression():
    """Of y_{k+1} on what is known and u_0, .., u_k, from all starts with a step k."""
    sizes, data = layout(2, 4), trajectories(noise=0.3, steps=60)
    _, found = fit(data, Options(sizes, ridge=0.0))
    k = 2
    Z, ahead = windows(data, sizes)
    Z = Z[ahead > k]
    actions = [sizes.n_p + 3 * j for j in range(k + 1)]
    read = [*range(k + 1), *range(sizes.n_preview, sizes.n_p), *actions]
    X = torch.cat((Z[:, read], torch.ones(len(Z), 1)), dim=-1)
    Y = Z[:, outputs_in(sizes)[k]]
    expected = X @ torch.linalg.lstsq(X, Y).solution
    assert_close(predict(found, Z, sizes)[:, k], expected)


def test_a_smooth_response_is_found_from_few_noisy_data():
    """A ridge on the changes of coefficients finds it better than one on the coefficients."""
    sizes, lags = Layout(1, 1, 1, 8), torch.linspace(0.1, 0.8, 8).double()

    def errors(seed: int) -> tuple[float, float]:
        u, noise = torch.randn(2, 60, 1, generator=torch.Generator().manual_seed(seed)).double()
        y = torch.cat((torch.zeros(8, 1).double(), u.unfold(0, 8, 1) @ lags))
        log = Trajectory(y + F.pad(noise, (0, 0, 1, 0)), u, u[:, :0])
        X, Y = transitions([log], sizes)
        plain = ridge(X - X.mean(0), Y - Y.mean(0))[1::2, 0]
        smooth = arx([log], sizes).B.flatten().flip(0)
        return (smooth - lags).norm().item(), (plain - lags).norm().item()

    smooth, plain = torch.tensor([errors(seed) for seed in range(20)]).mean(0)
    assert smooth < 0.8 * plain


def test_rows_without_enough_starts_keep_the_model():
    data = [log.between(0, 6) for log in trajectories(noise=0.3, episodes=4)]
    sizes = layout(2)
    _, found = fit(data, Options(sizes))
    tied = fit(data, Options(sizes, "tied"))[1]
    assert not torch.equal(found.C[2:4], tied.C[2:4])
    assert torch.equal(found.C[10:], tied.C[10:])


def test_errors_are_nan_after_the_end():
    sizes, (log, *_) = layout(2), trajectories()
    found = Constraints(torch.zeros(2 * N, sizes.n_z).double(), torch.zeros(2 * N).double())
    for k, columns in enumerate(outputs_in(sizes)):
        found.C[2 * k : 2 * k + 2, columns] = -torch.eye(2).double()
    errors = prediction_errors([log], found, sizes)
    assert torch.equal(errors[0], log.y[2 : 2 + N])
    ahead = errors.isfinite().all(-1).sum(1)
    assert ahead.tolist() == [*[N] * (39 - N), *range(N, 0, -1)]
    whole = prediction_errors([log], found, sizes, causal=False).isfinite().all(-1)
    assert whole.sum(1).tolist() == [N] * (40 - N) + [0] * (N - 1)


@pytest.mark.parametrize("seed", range(3))
def test_the_free_predictor_is_about_as_good_as_the_true_structure(seed):
    """On data of an ARX plant, a plain regression of N steps is far worse."""
    sizes, data = layout(2, 15), trajectories(seed, episodes=1, steps=120, noise=0.2)
    fresh = trajectories(100 + seed, episodes=4, steps=200, noise=0.2)

    def error(structure: str, ridge: float | None = None) -> float:
        found = fit(data, Options(sizes, structure, ridge=ridge))[1]
        return prediction_errors(fresh, found, sizes).square().nanmean().sqrt().item()

    tied = error("tied")
    assert error("varying") < 1.2 * tied
    assert error("free") < 1.2 * tied
    assert error("free") < error("free", ridge=0.0)
