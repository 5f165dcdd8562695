from __future__ import annotations

from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch.testing import assert_close

import torch_qpmpc as qm
from tests.logs import A, B, E, arx_log
from torch_qpmpc import QPMPC, QPError
from torch_qpmpc.mpc.banded import banded_matrix
from torch_qpmpc.mpc.log import as_log
from torch_qpmpc.mpc.predictor import outputs_in, predict, windows

N = 6
PAST: Any = {"past": 2, "n_d": 1}
COST: Any = {"stage_weight": [1.0, 1.0, 0.1], "action_bounds": ([-1.0], [1.0]), "solver": "daqp"}


# QPMPC.from_data


@pytest.mark.parametrize("structure", ["free", "varying", "tied"])
def test_without_noise_all_starts_predict_the_plant(structure):
    mpc = QPMPC.from_data(arx_log(), N, structure=structure, **PAST, **COST)
    assert (mpc.n_x, mpc.n_u, mpc.horizon, mpc.past, mpc.n_d) == (2, 1, N, 2, 1)
    assert mpc.structure == structure
    z = windows(as_log(arx_log(seed=1), n_d=1).trajectories, mpc.layout).z[:5]
    plan = mpc.solve(z[:, : mpc.n_p], z[:, mpc.n_p : mpc.n_p + 1]).z
    true = banded_matrix(A, B, N, E)
    offset = -torch.tensor([0.1, -0.3]).double().repeat(N)
    assert_close(plan @ true.mT, offset.expand(5, -1), rtol=1e-8, atol=1e-8)


def test_C_0_is_the_band_of_the_model():
    log = arx_log(noise=0.2)
    free, tied = (
        QPMPC.from_data(log, N, structure=structure, **PAST, **COST)
        for structure in ("free", "tied")
    )
    assert torch.equal(free.C_0, tied.C_0)
    assert torch.equal(tied.C, tied.C_0)
    assert not torch.equal(free.C, free.C_0)
    assert torch.equal(tied.model()[0], qm.identify(log, N, **PAST).model.A)


def test_a_ridge_of_a_users_own():
    weak, strong = (
        qm.identify(arx_log(noise=0.2), N, ridge=ridge, **PAST).model.A for ridge in (1e-9, 10.0)
    )
    assert strong.norm() < 0.3 * weak.norm()


# The report


def test_errors_are_those_of_data_that_the_fit_has_not_seen():
    log = arx_log(noise=0.2, episodes=2, steps=300)
    found = qm.identify(log, N, **PAST)
    assert found.errors.shape[1:] == (N, 2)
    fresh = as_log(arx_log(seed=5, noise=0.2, episodes=4, steps=400), n_d=1).trajectories
    Z, ahead = windows(fresh, found.options.layout)
    Z = Z[ahead >= N]
    error = Z[:, outputs_in(found.options.layout)] - predict(
        found.constraints, Z, found.options.layout
    )
    assert_close(found.rmse, error.square().mean(0).sqrt(), rtol=0.15, atol=0)
    assert_close(found.covariance, 0.04 * torch.eye(2).double(), rtol=0, atol=0.02)
    assert (found.rmse.diff(dim=0) > 0).all()
    assert ((found.R2 > 0.5) & (found.R2 < 1)).all()


def test_the_report_is_printed():
    text = str(qm.identify(arx_log(noise=0.2), N, **PAST))
    signals, first, head, *rows = text.splitlines()
    assert signals == "120 steps: outputs y1, y2; inputs u1; known d1"
    assert first.startswith("free C from 120 transitions in 3 trajectories, n_x=2, n_u=1, horizo")
    assert head.split() == ["steps", "RMSE", "of", "y1,", "y2", "R2,", "cross-validated"]
    assert [int(row.split()[0]) for row in rows] == [1, 2, 5, 6]
    assert all(len(row.split()) == 5 for row in rows)


def test_errors_are_nan_where_no_part_of_the_data_is_long_enough():
    found = qm.identify(arx_log(noise=0.2, episodes=1, steps=30), 20, past=2)
    assert found.rmse.isfinite().all(1).nonzero().flatten().tolist() == list(range(14))
    assert str(found).endswith("nan nan")
    assert qm.identify(arx_log(episodes=1, steps=10), 3, **PAST).rmse.isnan().all()


@pytest.mark.parametrize("structure", ["free", "varying", "tied"])
def test_a_held_output_keeps_its_value_and_others_depend_on_it(structure):
    log = arx_log(noise=0.2)
    held = qm.identify(log, N, structure=structure, held=[1], **PAST)
    sizes = held.options.layout
    z = windows(as_log(log, n_d=1).trajectories, sizes).z[:5]
    planned = predict(held.constraints, z, sizes)
    assert_close(planned[..., 1], z[:, sizes.n_p - 1 : sizes.n_p].expand(-1, N))
    assert held.model.A[0, 1].abs() > 0.1
    mpc = QPMPC.from_data(log, N, structure=structure, held=[1], **PAST, **COST)
    assert_close(mpc.C_0[1], held.constraints.C[1])
    free = qm.identify(log, N, structure=structure, **PAST)
    assert_close(held.model.A[0], free.model.A[0])
    assert held.rmse[-1, 0] < 2 * free.rmse[-1, 0]


@pytest.mark.parametrize("structure", ["free", "varying", "tied"])
def test_a_collinear_output_leaves_the_predictions_as_good(structure):
    log = arx_log(noise=0.2)
    twice: Any = log.clone()
    for steps in (twice, twice["next"]):
        y = steps["observation"]
        steps["observation"] = torch.cat((y, 3 * y[..., :1] - y[..., 1:]), -1)
    one, both = (qm.identify(x, N, structure=structure, **PAST) for x in (log, twice))
    assert_close(both.rmse[:, :2], one.rmse, rtol=0.1, atol=0)


# Bad data


def frozen_action(log: TensorDict) -> TensorDict:
    log["action"] = torch.full_like(log["action"], 0.3)
    return log


def feedback(log: TensorDict) -> TensorDict:
    log["action"] = log["observation"][..., :1] - 0.5 * log["observation"][..., 1:] + 1
    return log


def discrete_actions(log: TensorDict) -> TensorDict:
    log["action"] = torch.nn.functional.one_hot((log["action"] > 0).long().squeeze(-1), 2).double()
    return log


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: qm.identify(arx_log(episodes=2, steps=4), N, **PAST),
            "trajectories: got 8 transitions in 2 trajectories, 6 of them with 1 before them, "
            "expected at least 9 such for past=2, n_x=2, n_u=1 and n_d=1. A fit of as many tran",
        ),
        (
            lambda: qm.identify(arx_log(episodes=1, steps=4), N),
            "trajectories: got 4 transitions in 1 trajectories, expected at least 5 such .* Log mo",
        ),
        (
            lambda: qm.identify(frozen_action(arx_log()), N),
            "action: got u1 constant at 0.3, expected one that moves. Add a random signal",
        ),
        (
            lambda: qm.identify(feedback(arx_log()), N),
            "action: got u1 a linear function of the outputs and other actions, as in feed",
        ),
        (
            lambda: qm.identify(discrete_actions(arx_log()), N),
            "action: got one-hot vectors of discrete ones, expected continuous actions",
        ),
        (lambda: qm.identify(arx_log(), 0), "horizon: got 0, expected a whole number >= 1"),
        (
            lambda: qm.identify(arx_log(), N, n_x=3),
            r"observation: got shape \(3, 40, 2\), expected",
        ),
        (lambda: qm.identify(arx_log(), N, ridge=-1.0), "ridge: got -1.0, expected a finite numbe"),
        (
            lambda: qm.identify(arx_log(), N, held=[2]),
            r"held: got \[2\], expected a list of indices of the 2 outputs, from 0 on. In train.py",
        ),
        (lambda: QPMPC.of(2, 1, 3, start=[1.0]), r"start: got \[1.0\], expected a mapping"),  # pyright: ignore[reportArgumentType] (the mistake)
    ],
)
def test_a_mistake_is_named(call, message):
    with pytest.raises(QPError, match=f"^{message}"):
        call()
