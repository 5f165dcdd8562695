from __future__ import annotations

import pytest
import torch
from torch.testing import assert_close

import torch_qpmpc as qm
from torch_qpmpc import QPMPC, QPError
from torch_qpmpc.mpc.layout import Layout
from torch_qpmpc.mpc.regulator import lqr_gain
from torch_qpmpc.mpc.riccati import affine_cost_to_go, noisy_stage_weight, riccati_weight

A = torch.tensor([[1.1, 0.2], [0.0, 0.9]]).double()
B = torch.tensor([[0.0, 0.1], [0.3, 0.2]]).double()
W = torch.tensor([[2, 0.3, 0.1, 0], [0.3, 1, 0, 0.2], [0.1, 0, 0.5, 0], [0, 0.2, 0, 0.2]]).double()
STD, GAMMA = torch.tensor([0.8, 0.3]).double(), 0.9


@pytest.mark.parametrize("gamma", [GAMMA, 1.0])
def test_the_affine_cost_to_go_makes_the_horizon_irrelevant(gamma):
    """With P, p and c at x_N the policy and V are those of any other horizon."""
    offset, q = torch.tensor([0.3, -0.2]).double(), torch.tensor([0.5, -1.0, 0.1, 0.3]).double()
    P = riccati_weight(A, B, W, gamma)
    p, c = affine_cost_to_go(A, B, offset, W, q, P, gamma)
    s, policies, values = torch.randn(5, 2, dtype=torch.float64), [], []
    for N in (1, 9):
        model, ahead = qm.Model(A, B, offset=offset), gamma**N * c if gamma < 1 else 0.0
        cost = qm.Cost(W, P, "block", q=torch.cat((q.repeat(N), p)), c=ahead)
        mpc = QPMPC(qm.Scheme(Layout(2, 2, N), model, cost, gamma=gamma), learn=())
        policies.append(mpc.policy(s))
        values.append(mpc.value(s))
    assert_close(*policies, atol=1e-7, rtol=0)
    assert c.isfinite() == (gamma < 1)
    if gamma < 1:
        assert_close(*values, atol=1e-7, rtol=0)


def test_an_action_without_any_cost_has_no_effect_on_it():
    one, still = torch.ones(1, 1).double(), torch.zeros(1, 1).double()
    weight, zero = torch.diag(torch.tensor([1.0, 0.0]).double()), torch.zeros(2).double()
    p, c = affine_cost_to_go(0.5 * one, still, one[0], weight, zero, one * 8 / 7, 0.5)
    assert_close(p, torch.tensor([8 / 21]).double())
    assert_close(c, torch.tensor(4 / 7 + 8 / 21).double())


def test_the_noisy_weight_solves_the_generalised_equation():
    """P is that of the policy's expected cost to go, with E[x+ x+'] written out."""
    weight = noisy_stage_weight(A, B, W, GAMMA, STD)
    P, K = riccati_weight(A, B, weight, GAMMA), lqr_gain(A, B, weight, GAMMA)
    closed, gain = A - B @ K, torch.cat((torch.eye(2).double(), -K))
    noise = sum(
        STD[i] ** 2 * torch.outer(K[i], K[i]) * (B[:, i] @ P @ B[:, i]) for i in range(len(STD))
    )
    assert_close(P, gain.mT @ W @ gain + GAMMA * (closed.mT @ P @ closed + noise))


@pytest.mark.parametrize("delay", [0, 1, 2])
def test_no_other_gain_costs_less(delay):
    """u = -K z, where z is the state without the errors that are not yet seen."""

    def cost(K: torch.Tensor) -> torch.Tensor:
        """Return the discounted cost from E[x x'] = 1, by the second moments of z and x - z."""
        zero, gain = torch.zeros_like(A), torch.cat((torch.eye(2).double(), -K))
        M, errors, total = torch.eye(2).double(), [zero] * delay, zero.sum()
        for k in range(300):
            stage = (W * (gain @ M @ gain.mT)).sum() + (W[:2, :2] * sum(errors, zero)).sum()
            total = total + GAMMA**k * stage
            spread = torch.diag(STD.square() * (K @ M @ K.mT).diagonal())
            errors = [B @ spread @ B.mT, *(A @ X @ A.mT for X in errors)]
            M = (A - B @ K) @ M @ (A - B @ K).mT + errors.pop()
        return total

    K = lqr_gain(A, B, noisy_stage_weight(A, B, W, GAMMA, STD, delay), GAMMA)
    slope = torch.func.grad(cost)(K)
    assert_close(slope, torch.zeros_like(K), atol=1e-8, rtol=0)
    assert cost(K) < cost(lqr_gain(A, B, W, GAMMA)) - 1e-3


def test_a_delay_that_is_no_number_of_steps_is_refused():
    with pytest.raises(QPError, match="delay: got -1, expected a whole number >= 0"):
        noisy_stage_weight(A, B, W, GAMMA, STD, -1)


def test_noise_that_no_policy_withstands_is_refused():
    one = torch.ones(1, 1).double()
    with pytest.raises(QPError, match=r"std: got \[3.0\], expected noise under which some"):
        noisy_stage_weight(2 * one, one, torch.eye(2).double(), 1.0, 3 * one[0])
