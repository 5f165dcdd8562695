"""Linear models blended by the observation: their fit, their linearisation, and theta from it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

import torch_qpmpc as qm
from torch_qpmpc import QPMPC, BlendedModel, QPError

COST: Any = {"stage_weight": [1.0, 1.0, 0.1], "action_bounds": ([-1.0], [1.0]), "solver": "daqp"}
N = 4


def pendulum_log(steps: int = 1200, seed: int = 0) -> dict[str, np.ndarray]:
    """Simulate a damped pendulum with random torques, with angle and rate as outputs."""
    u, y = np.random.default_rng(seed).uniform(-2, 2, (steps, 1)), np.zeros((steps + 1, 2))
    for t in range(steps):
        angle, rate = y[t]
        y[t + 1] = angle + 0.2 * rate, 0.9 * rate - 0.6 * np.sin(angle) + 0.6 * u[t, 0]
    return {"y": y, "u": u}


@pytest.fixture(scope="module")
def model() -> BlendedModel:
    return qm.identify_blended(pendulum_log(), horizon=5, centres=(1, 8, 16, 10**6))


def states(count: int = 6) -> Tensor:
    return 2 * torch.rand(count, 2, generator=torch.Generator().manual_seed(0)).double() - 1


def test_the_held_out_prediction_chooses_the_number_of_centres(model):
    assert set(model.R2) == {1, 8, 16}  # a million models have more coefficients than the log
    assert len(model.centres) == max(model.R2, key=lambda count: model.R2[count]) > 1
    assert model.R2[len(model.centres)] > model.R2[1] + 0.01


def test_the_linearisation_is_the_derivative_of_the_model(model):
    s = states()
    A, B, offset = model.linearised(s.float())
    at_rest = torch.zeros(6, 1).double()
    jacobians = torch.func.vmap(torch.func.jacrev(model, (0, 1)))(s, at_rest)
    assert_close((A, B), jacobians)
    assert_close(
        (A @ s.unsqueeze(-1)).squeeze(-1) + offset, model(s, at_rest), rtol=1e-6, atol=1e-6
    )
    slope, eps = A[:, :, 0], torch.tensor([1e-5, 0.0]).double()
    differences = (model(s + eps, at_rest) - model(s - eps, at_rest)) / 2e-5
    assert_close(slope, differences, rtol=1e-5, atol=1e-5)
    assert A[0].shape == model.linearised(s[0]).A.shape
    assert model.linearised(s.view(2, 3, 2)).offset.shape == (2, 3, 2)


def test_states_and_actions_broadcast(model):
    mpc = QPMPC.from_data(pendulum_log(), N, **COST)
    schedule, s, plan = model.schedule(mpc), states(3), torch.rand(3, N, 1).double()
    assert_close(schedule(s[0], plan), schedule(s[:1].expand(3, 2), plan))
    assert_close(schedule(s, plan[0]), schedule(s, plan[:1].expand(3, N, 1)))
    assert_close(model(s, plan[0, 0]), model(s, plan[:1, 0].expand(3, 1)))


def test_an_output_that_never_changes_stays_where_it_is():
    log = pendulum_log()
    log["y"] = np.concatenate((log["y"], np.full((1201, 1), 0.3)), 1)
    with pytest.warns(UserWarning, match="In this log"):
        fitted = qm.identify_blended(log, 5, centres=np.int64(4))  # pyright: ignore[reportArgumentType]
    s = torch.tensor([0.5, -0.2, 0.7]).double()
    assert fitted(s, torch.ones(1).double())[2].item() == pytest.approx(0.7)


def test_set_points_are_held_and_do_not_choose_the_number_of_centres():
    log = pendulum_log()
    plain = qm.identify_blended(log, 5, centres=(1, 8))
    jumps = np.random.default_rng(1).normal(size=(1201, 1)).round(0)
    log["y"] = np.concatenate((log["y"], jumps), 1)
    fitted = qm.identify_blended(log, 5, centres=(1, 8), held=[2])
    A, B, offset = fitted.linearised(torch.randn(6, 3).double())
    assert_close(A[:, 2], torch.eye(3).double()[2].expand(6, 3))
    assert not B[:, 2].any()
    assert offset[:, 2].abs().max() < 1e-9
    assert fitted.R2[1] == pytest.approx(plain.R2[1], abs=0.02)


def test_one_centre_is_the_linear_model():
    log = pendulum_log()
    one = qm.identify_blended(log, N, centres=1).linearised(states())
    linear = qm.identify(log, N, structure="tied").model
    assert_close(one.A, linear.A.expand(6, 2, 2), rtol=1e-3, atol=1e-3)
    assert_close(one.offset, linear.offset.expand(6, 2), rtol=1e-3, atol=1e-3)


@pytest.mark.filterwarnings("ignore:In this log:UserWarning")
def test_a_constant_output_and_repeated_states_have_a_fit():
    log = pendulum_log(60)
    log["y"] = np.concatenate((np.sign(log["y"]), np.ones((61, 1))), 1)
    fitted = qm.identify_blended(log, N, centres=50)
    assert 1 < len(fitted.centres) < 10  # there are no more different states
    assert all(x.isfinite().all() for x in fitted.linearised(torch.ones(3)))


@pytest.mark.parametrize("structure", ["tied", "varying", "free"])
def test_the_schedule_puts_the_model_into_theta(structure, model):
    mpc = QPMPC.from_data(pendulum_log(), N, structure=structure, **COST)
    schedule, s = model.schedule(mpc), states()
    qp = mpc.quadratic_program(schedule(s))
    z = mpc.solve(s, qp=qp).z
    x, u = mpc.predicted(z)
    A, B, offset = model.linearised(s)
    now = torch.cat((s.unsqueeze(1), x[:, -N:-1]), 1)
    ahead = now @ A.mT + u @ B.mT + offset.unsqueeze(1)
    assert_close(x[:, -N:], ahead, rtol=1e-7, atol=1e-7)
    one = mpc.policy(s[0], qp=mpc.quadratic_program(schedule(s[0])))
    assert_close(one, mpc.policy(s, qp=qp)[0])
    assert not torch.equal(mpc.policy(s, qp=qp), mpc.policy(s))


@pytest.mark.parametrize("structure", ["varying", "free"])
def test_along_a_plan_the_model_is_that_of_each_stage(structure, model):
    mpc = QPMPC.from_data(pendulum_log(), N, structure=structure, **COST)
    schedule, s = model.schedule(mpc), states()
    plan = mpc.predicted(mpc.solve(s, qp=mpc.quadratic_program(schedule(s))).z)[1]
    for _ in range(10):  # of sequential quadratic programming
        x, u = mpc.predicted(mpc.solve(s, qp=mpc.quadratic_program(schedule(s, plan))).z)
        change, plan = (u - plan).abs().max(), u
    assert change < 1e-6
    now = s
    for k in range(N):  # the plan's prediction is the nonlinear model's, once it has converged
        now = model(now, plan[:, k])
        assert_close(x[:, x.shape[1] - N + k], now, rtol=1e-5, atol=1e-5)


def test_what_is_learned_is_added_to_the_schedule(model):
    mpc, s = QPMPC.from_data(pendulum_log(), N, structure="tied", **COST), states()
    schedule = model.schedule(mpc)
    start = mpc.quadratic_program(schedule(s)).C
    with torch.no_grad():
        mpc.leaves("C")[0].add_(0.1)
    moved = mpc.quadratic_program(schedule(s)).C
    assert_close(moved - start, (mpc.C - mpc.C_0).expand_as(moved))


def test_finite_differences_of_the_policy_through_the_schedule(model):
    mpc = QPMPC.from_data(pendulum_log(), N, structure="tied", **COST | {"action_bounds": None})
    schedule = model.schedule(mpc)

    def total(s: Tensor) -> Tensor:
        return mpc.policy(s, qp=mpc.quadratic_program(schedule(s))).sum()

    s = states().requires_grad_()
    (slope,) = torch.autograd.grad(total(s), s)
    direction, eps = torch.randn_like(s), 1e-5
    with torch.no_grad():
        difference = (total(s + eps * direction) - total(s - eps * direction)) / (2 * eps)
    assert (slope * direction).sum().item() == pytest.approx(difference.item(), rel=1e-5)


def test_the_state_dict_holds_model_and_schedule(model):
    mpc = QPMPC.from_data(pendulum_log(), N, **COST)
    other = qm.identify_blended(pendulum_log(seed=3), 5, centres=len(model.centres)).schedule(mpc)
    schedule = model.schedule(mpc)
    other.load_state_dict(schedule.state_dict())
    assert_close(other(states()), schedule(states()), rtol=0, atol=0)
    assert "centres=" in str(model)


@pytest.mark.filterwarnings("ignore:In this log:UserWarning")
@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda log: qm.identify_blended(log, 0), "horizon: got 0"),
        (lambda log: qm.identify_blended(log, 3, centres=0), "centres: got 0"),
        (lambda log: qm.identify_blended(log, 3, centres=(2, 0)), "centres: got 0"),
        (lambda log: qm.identify_blended(log, 3, held=[2]), r"held: got \[2\], expected a list of"),
        (
            lambda log: qm.identify_blended(log, 3, centres="8"),  # pyright: ignore[reportArgumentType]
            "centres: got '8', expected a wh",
        ),
        (lambda log: qm.identify_blended(log, 3, centres=()), r"centres: got \(\), expected a who"),
        (
            lambda log: qm.identify_blended(log | {"u": 0 * log["u"]}, 3),
            "action: got u constant at 0, expected one that moves",
        ),
        (
            lambda log: qm.identify_blended(log | {"d": log["u"]}, 3),
            "trajectories: got known signals d, expected outputs and actions only",
        ),
        (
            lambda log: qm.identify_blended(log, 3, centres=2).schedule(QPMPC(3, 1, N)),
            "mpc: got n_x, n_u, past, n_d = .3, 1, 1, 0., expected .* = .2, 1, 1, 0., as the model",
        ),
        (
            lambda log: qm.identify_blended(log, 3, centres=2).schedule(QPMPC(2, 1, N, past=2)),
            "mpc: got n_x, n_u, past, n_d = .2, 1, 2, 0.",
        ),
        (
            lambda log: qm.identify_blended(log, 3, centres=2).schedule(log),
            "mpc: got dict, expected a QPMPC",
        ),
        (
            lambda log: qm.identify_blended(log, 3, centres=2).schedule(
                QPMPC(2, 1, N, structure="tied")
            )(torch.ones(2), torch.ones(N, 1)),
            "plan: got a plan for a tied C, expected none. Its stages are equal: use structure=",
        ),
        (
            lambda log: qm.identify_blended(log, 3, centres=2).schedule(QPMPC(2, 1, N))(
                torch.ones(2), torch.ones(3, 1)
            ),
            "plan: got shape .3, 1., expected",
        ),
        (
            lambda log: qm.identify_blended(log, 3, centres=2)(torch.ones(3, 2), torch.ones(4, 1)),
            r"u: got shape \(4, 1\), expected leading dimensions that broadcast with those of s",
        ),
        (
            lambda log: qm.identify_blended(log, 3, centres=2).linearised(torch.ones(3)),
            "s: got shape .3,., expected",
        ),
    ],
)
def test_mistakes(call, message):
    with pytest.raises(QPError, match=message):
        call(pendulum_log(60))
