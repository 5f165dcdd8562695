"""Models blended by the observation: fit, linearisation, and the QPMPC that they schedule."""

from __future__ import annotations

import copy
import pickle
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

import torch_qpmpc as qm
from tests.problems import drawn_mpc
from torch_qpmpc import QPMPC, QPError
from torch_qpmpc.analysis.report import read
from torch_qpmpc.export.export import export_c
from torch_qpmpc.learning.operators import warm_policy
from torch_qpmpc.learning.penalties import SystemIdentificationPenalty
from torch_qpmpc.learning.updates import first_order, second_order
from torch_qpmpc.mpc.blended import BlendedModel
from torch_qpmpc.proofs import Polytope, largest_difference

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
    assert A[0].shape == model.linearised(s[0])[0].shape
    assert model.linearised(s.view(2, 3, 2))[2].shape == (2, 3, 2)


def test_one_centre_is_the_linear_model():
    log = pendulum_log()
    A, _, offset = qm.identify_blended(log, N, centres=1).linearised(states())
    linear = qm.identify(log, N, order=0).model
    assert_close(A, torch.tensor(linear.A).expand(6, 2, 2), rtol=1e-3, atol=1e-3)
    assert_close(offset, torch.tensor(linear.offset).expand(6, 2), rtol=1e-3, atol=1e-3)


@pytest.mark.filterwarnings("ignore:In this log:UserWarning")
def test_a_constant_output_and_repeated_states_have_a_fit():
    log = pendulum_log(60)
    log["y"] = np.concatenate((np.sign(log["y"]), np.ones((61, 1))), 1)
    fitted = qm.identify_blended(log, N, centres=np.int64(50))  # pyright: ignore[reportArgumentType]
    assert 1 < len(fitted.centres) < 10  # there are no more different states
    assert all(x.isfinite().all() for x in fitted.linearised(torch.ones(3)))
    s = torch.tensor([0.5, -0.2, 1.0]).double()
    assert fitted(s, torch.ones(1).double())[2].item() == pytest.approx(1), "it stays where it is"


def scheduled(model: BlendedModel, **options: Any) -> QPMPC:
    return QPMPC.from_data(pendulum_log(), N, **COST | {"schedule": model} | options)


@pytest.mark.parametrize(
    "options", [{"structure": "tied"}, {"structure": "free"}, {"blocks": [1, 3]}]
)
def test_the_plan_is_that_of_the_model_at_s(options, model):
    mpc, s = scheduled(model, **options), states()
    x, u = mpc.predicted(mpc.solve(s).z)
    A, B, offset = model.linearised(s)
    now = torch.cat((s.unsqueeze(1), x[:, -N:-1]), 1)
    ahead = now @ A.mT + u @ B.mT + offset.unsqueeze(1)
    assert_close(x[:, -N:], ahead, rtol=1e-7, atol=1e-7)
    policy = mpc.policy(s)
    assert_close(mpc.policy(s[0]), policy[0])
    assert_close(mpc.policy(s, qp=mpc.quadratic_program()), policy)
    assert_close(warm_policy(mpc)(s), policy)
    assert_close(mpc.action_value(s, policy), mpc.value(s))
    plain = QPMPC.from_data(pendulum_log(), N, **COST | options)
    assert not torch.allclose(plain.policy(s), policy, atol=1e-3)


@pytest.mark.parametrize("structure", ["tied", "free"])
def test_what_is_learned_is_added_to_the_schedule(structure, model):
    mpc, s = scheduled(model, structure=structure), states()
    start = mpc.solve(s).qp
    with torch.no_grad():
        mpc.leaves("C")[0].add_(0.1)
    moved = mpc.solve(s).qp
    assert_close(moved.C - start.C, (mpc.C - mpc.scheme.theta["C"]).expand_as(moved.C))
    if structure == "tied":
        mpc.release()
        assert_close(mpc.solve(s).qp.C, moved.C)
    mpc.reset_parameters()
    assert_close(mpc.solve(s).qp.C, start.C)


@pytest.mark.parametrize("structure", ["tied", "free"])
def test_finite_differences_of_Q_in_theta_and_gauss_newton_s_step(structure, model):
    mpc = scheduled(model, structure=structure, learn=["C", "b", "q", "H"])
    s, a = states(), 0.3 * torch.ones(6, 1).double()
    Q = mpc.action_value(s, a)
    slopes = torch.autograd.grad(Q.sum(), [*mpc.parameters()])
    directions = [torch.randn_like(x) for x in slopes]
    slope = sum((x * d).sum() for x, d in zip(slopes, directions, strict=True))

    def moved(eps: float) -> Tensor:
        twin = copy.deepcopy(mpc)
        with torch.no_grad():
            for x, d in zip(twin.parameters(), directions, strict=True):
                x.add_(eps * d)
            return twin.action_value(s, a).sum()

    difference = (moved(1e-5) - moved(-1e-5)) / 2e-5
    assert float(slope) == pytest.approx(difference.item(), rel=1e-5)
    # The ratio of actual to predicted decrease is 1 to first order only with the right gradients.
    step = qm.GaussNewton(mpc, lr=1e-4).step(s, a, Q.detach() - 1)
    assert step.ratio == pytest.approx(1, abs=1e-3)


def test_finite_differences_of_the_policy_in_s(model):
    mpc = scheduled(model, structure="tied", action_bounds=None)
    s = states().requires_grad_()
    (slope,) = torch.autograd.grad(mpc.policy(s).sum(), s)
    direction, eps = torch.randn_like(s), 1e-5
    with torch.no_grad():
        difference = (mpc.policy(s + eps * direction) - mpc.policy(s - eps * direction)).sum()
    assert (slope * direction).sum().item() == pytest.approx(difference.item() / 2e-5, rel=1e-5)


def test_files_copies_and_state_dicts_have_the_schedule(model, tmp_path):
    mpc, s = scheduled(model), states()
    with torch.no_grad():
        mpc.leaves("C")[0].mul_(1.01)
    policy = mpc.policy(s)
    mpc.save(tmp_path / "mine.qpmpc")
    twins = [QPMPC.load(tmp_path / "mine.qpmpc"), copy.deepcopy(mpc)]
    twins.append(pickle.loads(pickle.dumps(mpc)))
    log = pendulum_log(seed=3)
    other = qm.identify_blended(log, 5, len(model.centres))
    twins.append(QPMPC.from_data(log, N, **COST | {"schedule": other}))
    twins[-1].load_state_dict(mpc.state_dict())
    for twin in twins:
        assert torch.equal(twin.policy(s), policy)
    assert mpc.schedule is not None
    assert mpc.schedule.R2 == model.R2
    assert "centres=" in str(mpc)
    plain = QPMPC.from_data(pendulum_log(), N, **COST)
    with pytest.raises(QPError, match=r"a state_dict with centres = [0-9]+, expected this module"):
        plain.load_state_dict(mpc.state_dict())
    model.offset.add_(1.0)  # the QPMPC has a copy
    assert torch.equal(mpc.policy(s), policy)
    model.offset.sub_(1.0)


@pytest.mark.parametrize(
    "use",
    [
        lambda mpc: mpc.model(),
        lambda mpc: export_c(mpc, "nowhere"),
        lambda mpc: largest_difference(mpc, mpc, Polytope.box([-1.0, -1.0], [1.0, 1.0])),
        read,
        lambda mpc: first_order(mpc, None, None, None, SystemIdentificationPenalty(1.0)),  # pyright: ignore[reportArgumentType]
        lambda mpc: second_order(mpc, None, None, None, SystemIdentificationPenalty(1.0)),  # pyright: ignore[reportArgumentType]
    ],
)
def test_what_needs_one_model_for_all_states_says_so(use, model):
    with pytest.raises(QPError, match="mpc: got one with a schedule, expected one with the same C"):
        use(scheduled(model, structure="tied"))


@pytest.mark.filterwarnings("ignore:In this log:UserWarning")
def fitted(log: Any, **arguments: Any) -> BlendedModel:
    return BlendedModel(**qm.identify_blended(log, 3, centres=2).arguments | arguments)


def test_an_empty_batch_has_no_values(model):
    mpc, none = scheduled(model), torch.zeros(3, 0, 2)
    assert mpc.value(none).shape == (3, 0)
    assert mpc.policy(none).shape == (3, 0, 1)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda log: qm.identify_blended(log, 0), "horizon: got 0"),
        (lambda log: qm.identify_blended(log, 3, centres=(2, 0)), "centres: got 0"),
        (
            lambda log: qm.identify_blended(log, 3, centres="8"),  # pyright: ignore[reportArgumentType]
            "centres: got '8', expected a whole",
        ),
        (
            lambda log: qm.identify_blended(log, 3, centres=()),
            "centres: got None, expected a whole",
        ),
        (
            lambda log: qm.identify_blended(log | {"u": 0 * log["u"]}, 3),
            "action: got u constant at 0, expected one that moves",
        ),
        (
            lambda log: qm.identify_blended(log | {"d": log["u"]}, 3),
            "trajectories: got known signals d, expected outputs and actions only",
        ),
        (
            lambda log: drawn_mpc(3, 1, N, schedule=qm.identify_blended(log, 3, centres=2)),
            "schedule: got n_x, n_u, n_d = .2, 1, 0., exp.* = .3, 1, 0., as the QPMPC",
        ),
        (
            lambda _: drawn_mpc(2, 1, N, schedule=1),
            "schedule: got 1, expected a BlendedModel, or its",
        ),
        (
            lambda _: drawn_mpc(2, 1, N, schedule={"A": 1}),
            "schedule: got keys A, expected a Blended",
        ),
        (
            lambda log: fitted(log, A=torch.ones(2, 2, 1)),
            r"A: got shape \(2, 2, 1\), expected shape",
        ),
        (lambda log: fitted(log, width=torch.nan), "width: got NaN or inf, expected finite"),
    ],
)
def test_mistakes(call, message):
    with pytest.raises(QPError, match=message):
        call(pendulum_log(60))
