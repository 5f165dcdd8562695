"""One-step prediction errors: their moments, and their part in Gauss-Newton's steps."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor
from torch.nn.utils import parameters_to_vector
from torch.testing import assert_close

from tests.gauss_newton import Reference
from tests.problems import normal, random_mpc, random_states
from torch_qpmpc import QPMPC, GaussNewton, QPError
from torch_qpmpc.learning.prediction_errors import FLOOR, PredictionErrors
from torch_qpmpc.qp.program import QuadraticProgram

COUNT, DAMPING = 7, 0.2
A = torch.tensor([[0.9, 0.2], [0.0, 0.8]]).double()
B = torch.tensor([[0.1], [0.5]]).double()
OFFSET, NOISE = torch.tensor([0.3, -0.2]).double(), 0.1


def tied(**options) -> QPMPC:
    return random_mpc(2, structure="tied", **{"learn": ("c", "q", "C", "b"), **options})


def transitions(count: int = 400, noise: float = NOISE) -> tuple[Tensor, Tensor, Tensor]:
    """Draw transitions of x+ = A x + B u + offset + e, with e of covariance noise^2 diag(1, 4)."""
    s, a = random_states(count), random_states(count, 1, seed=1)
    e = noise * torch.tensor([1.0, 2.0]).double() * normal(count, 2, seed=2)
    return s, a, s @ A.mT + a @ B.mT + OFFSET + e


def errors_of(qp: QuadraticProgram, s: Tensor, a: Tensor, following: Tensor) -> Tensor:
    """Compute C_1 [s, a, x+] - b_1, one transition at a time."""
    tau = torch.cat((s, a, following), -1)
    return torch.stack([qp.C[:2, :5] @ t - qp.b[:2] for t in tau])


def test_the_moments_are_those_of_the_weighted_transitions():
    mpc, (s, a, following) = tied(), transitions(30)
    errors = PredictionErrors(mpc, weight=2.0, memory=10)
    for part in (slice(0, 1), slice(1, 20), slice(20, 30)):
        errors.add(s[part], a[part], following[part])
    qp = mpc.quadratic_program()
    e = errors_of(qp, s, a, following).detach()
    weights = torch.exp(-torch.arange(29, -1, -1) / 10).double()
    assert_close(errors.count, weights.sum())
    mean = weights @ e / weights.sum()
    expected = ((e - mean).mT * weights) @ (e - mean) / weights.sum()
    assert_close(errors.covariance(qp), expected)
    variance = weights @ e.square() / weights.sum()
    r = errors.residuals(qp)
    assert_close(r.square().sum(), 2.0 * (weights @ (e.square() / variance)).sum())


def test_the_residuals_gradient_is_that_of_the_likelihood():
    """The mean squares that divide the errors count as constant."""
    mpc, data = tied(), transitions(50)
    errors = PredictionErrors(mpc, memory=20)
    errors.add(*data)
    leaves = [leaf for part in ("C", "b") for leaf in mpc.leaves(part)]
    half = 0.5 * errors.residuals(mpc.quadratic_program()).square().sum()
    found = parameters_to_vector(torch.autograd.grad(half, leaves))
    weights = torch.exp(-torch.arange(49, -1, -1) / 20).double()

    def likelihood(variance: Tensor) -> float:
        e = errors_of(mpc.quadratic_program(), *data)
        return float(0.5 * (weights @ (e.square() / variance)).sum())

    with torch.no_grad():
        e = errors_of(mpc.quadratic_program(), *data)
        variance, differences = weights @ e.square() / weights.sum(), []
        for leaf in leaves:
            for k in range(leaf.numel()):
                entry, at = leaf.view(-1), leaf.view(-1)[k].item()
                sides = []
                for step in (1e-5, -1e-5):
                    entry[k] = at + step
                    sides.append(likelihood(variance))
                entry[k] = at
                differences.append((sides[0] - sides[1]) / 2e-5)
    assert_close(found, torch.tensor(differences).double(), rtol=1e-6, atol=1e-5)


@pytest.mark.parametrize("trust_region", [False, True])
def test_the_residuals_are_rows_of_the_least_squares_problem(trust_region):
    mpc, (s, a, following) = tied(), transitions()
    errors = PredictionErrors(mpc, weight=0.1)
    errors.add(s, a, following)
    optimizer = GaussNewton(
        mpc, damping=DAMPING, trust_region=trust_region, normalise=False, residuals=errors.residuals
    )
    reference = Reference(mpc, optimizer, normalise=False)
    pairs = random_states(COUNT, size=0.9), random_states(COUNT, 1, size=0.45, seed=1)
    delta = 0.1 * normal(COUNT, seed=2)
    target = mpc.action_value(*pairs).detach() + delta
    g = torch.cat(reference.gradients(*pairs), -1)
    r = delta.square().mean().sqrt() * errors.residuals(mpc.quadratic_program())
    J = [torch.autograd.grad(x, reference.leaves, retain_graph=True, allow_unused=True) for x in r]
    J = torch.stack(
        [
            torch.cat(
                [
                    torch.zeros_like(leaf).flatten() if x is None else x.flatten()
                    for leaf, x in zip(reference.leaves, row, strict=True)
                ]
            )
            for row in J
        ]
    )
    sizes = [leaf.numel() for leaf in reference.leaves]
    D = torch.tensor(reference.scales).repeat_interleave(torch.tensor(sizes)).double()
    mu = DAMPING * (g.square() @ D).mean()
    normal_matrix = g.mT @ g + J.mT @ J + mu * torch.diag(1 / D)
    expected = torch.linalg.solve(normal_matrix, g.mT @ delta - J.mT @ r.detach())
    before = reference.theta()
    report = optimizer.step(*pairs, target)
    assert report.accepted
    assert (J.mT @ r).abs().max() > 1e-2
    assert_close(reference.theta() - before, expected, rtol=1e-5, atol=1e-9)
    if trust_region:
        change, r = expected, r.detach()
        predicted = 0.5 * (delta.square().sum() + r.square().sum())
        predicted -= 0.5 * ((delta - g @ change).square().sum() + (r + J @ change).square().sum())
        after = mpc.action_value(*pairs).detach() - target
        actual = 0.5 * delta.square().sum() - 0.5 * after.square().sum()
        actual += predicted - 0.5 * (delta.square().sum() - (delta - g @ change).square().sum())
        assert report.ratio == pytest.approx(float(actual / predicted), rel=1e-6)


def test_a_strong_weight_identifies_the_model():
    mpc, data = tied(), transitions(2000)
    errors = PredictionErrors(mpc, weight=1e3, memory=10_000)
    errors.add(*data)
    optimizer = GaussNewton(mpc, trust_region=False, residuals=errors.residuals)
    pairs = random_states(COUNT, size=0.9), random_states(COUNT, 1, size=0.45, seed=1)
    target = mpc.action_value(*pairs).detach() + 0.1 * normal(COUNT, seed=2)
    for _ in range(5):
        optimizer.step(*pairs, target)
    found = mpc.model()
    assert_close(found[0].detach(), A, atol=0.03, rtol=0)
    assert_close(found[1].detach(), B, atol=0.03, rtol=0)
    W = errors.covariance(mpc.quadratic_program())
    assert_close(W, NOISE**2 * torch.diag(torch.tensor([1.0, 4.0])).double(), atol=3e-3, rtol=0)


def test_a_memory_keeps_td_errors_only():
    """Past pairs count as before; the residuals are those of all transitions already."""
    mpc, data = tied(), transitions()
    errors = PredictionErrors(mpc)
    errors.add(*data)
    optimizer = GaussNewton(mpc, memory=4, residuals=errors.residuals)
    for seed in range(3):
        s, a = random_states(3, seed=seed), random_states(3, 1, size=0.45, seed=seed + 9)
        optimizer.step(s, a, mpc.action_value(s, a).detach() + 0.1)
    assert {len(state["rows"]) for state in optimizer.state.values()} == {4}


def test_the_mean_squared_error_falls_slowly_and_is_part_of_the_state():
    mpc = tied()
    errors = PredictionErrors(mpc)
    errors.add(*transitions())
    optimizer = GaussNewton(mpc, residuals=errors.residuals)
    s, a = random_states(COUNT), random_states(COUNT, 1, size=0.45, seed=1)
    optimizer.step(s, a, mpc.action_value(s, a).detach() + 1.0)
    optimizer.step(s, a, mpc.action_value(s, a).detach())
    (variance,) = {group["variance"] for group in optimizer.param_groups[:1]}
    assert variance == pytest.approx(0.9)
    other = GaussNewton(mpc, residuals=errors.residuals)
    other.load_state_dict(optimizer.state_dict())
    assert other.param_groups[0]["variance"] == variance


def test_residuals_of_parts_that_do_not_learn_change_nothing():
    mpcs = [tied(learn=("c", "q")) for _ in range(2)]
    errors = PredictionErrors(mpcs[0])
    errors.add(*transitions())
    s, a = random_states(COUNT), random_states(COUNT, 1, size=0.45, seed=1)
    for mpc, residuals in zip(mpcs, (errors.residuals, None), strict=True):
        optimizer = GaussNewton(mpc, residuals=residuals)
        optimizer.step(s, a, mpc.action_value(s, a).detach() + 0.1)
    assert_close(mpcs[0].state_dict(), mpcs[1].state_dict(), rtol=0, atol=0)


def test_transitions_that_are_not_finite_are_omitted():
    mpc, (s, a, following) = tied(), transitions(10)
    clean, errors = PredictionErrors(mpc), PredictionErrors(mpc)
    clean.add(s[1:], a[1:], following[1:])
    following = following.clone()
    following[0, 0] = math.nan
    errors.add(s, a, following)
    assert_close(errors.state_dict(), clean.state_dict())


def test_without_transitions_and_without_noise_all_numbers_are_finite():
    mpc = tied()
    errors = PredictionErrors(mpc)
    qp = mpc.quadratic_program()
    assert torch.equal(errors.residuals(qp), torch.zeros(12).double())
    assert torch.equal(errors.covariance(qp), torch.zeros(2, 2).double())
    s, a, _ = transitions()
    model_A, model_B, *_ = mpc.model()
    following = s @ model_A.mT + a @ model_B.mT - mpc.b[:2]
    errors.add(s, a, following.detach())
    r = errors.residuals(qp)
    assert r.isfinite().all()
    assert r.square().sum() < errors.count / FLOOR


def test_a_window_and_a_preview_are_part_of_the_first_rows():
    mpc = random_mpc(2, structure="tied", past=2, n_d=1, learn=("C", "b"))
    errors = PredictionErrors(mpc)
    p, a = random_states(50, mpc.n_p), random_states(50, 1, size=0.45, seed=1)
    z = mpc.solve(p, a).z.detach()
    following = z[:, mpc.n_p + 1 : mpc.n_p + 3]  # the QP's own prediction
    errors.add(p, a, following)
    assert_close(errors.covariance(mpc.quadratic_program()), torch.zeros(2, 2).double())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"mpc": None}, "mpc"),
        ({"mpc": random_mpc(2)}, "mpc: got structure='free', expected 'tied'"),
        ({"weight": 0.0}, "weight: got 0.0, expected a finite number > 0"),
        ({"memory": 0}, "memory"),
    ],
)
def test_bad_arguments_are_named(options, message):
    with pytest.raises(QPError, match=message):
        PredictionErrors(**{"mpc": tied(), **options})


@pytest.mark.parametrize("bad", ["p", "a", "following"])
def test_bad_shapes_are_named(bad):
    arguments = dict(zip(("p", "a", "following"), transitions(5), strict=True))
    arguments[bad] = arguments[bad][:, :0]
    with pytest.raises(QPError, match=bad):
        PredictionErrors(tied()).add(**arguments)


def test_residuals_need_a_tied_C():
    errors = PredictionErrors(tied())
    with pytest.raises(QPError, match="residuals: got them with a free C, expected a tied C"):
        GaussNewton(random_mpc(2), residuals=errors.residuals)
