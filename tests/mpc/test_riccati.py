import pytest
import torch
from torch.testing import assert_close

import torch_qpmpc as qm
from torch_qpmpc import QPMPC
from torch_qpmpc.mpc.layout import Layout
from torch_qpmpc.mpc.riccati import affine_cost_to_go, lqr_gain, riccati_weight

A = torch.tensor([[1.1, 0.2], [0.0, 0.9]]).double()
B = torch.tensor([[0.0, 0.1], [0.3, 0.2]]).double()
W = torch.tensor([[2, 0.3, 0.1, 0], [0.3, 1, 0, 0.2], [0.1, 0, 0.5, 0], [0, 0.2, 0, 0.2]]).double()
GAMMA = 0.9


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


def test_a_weight_may_be_asymmetric():
    offset, q, P = A[0], W[0], riccati_weight(A, B, W, GAMMA)
    upper = 2 * W.triu() - W.diagonal().diag()  # the same cost
    assert_close(riccati_weight(A, B, upper, GAMMA), P, atol=1e-11, rtol=0)
    assert_close(lqr_gain(A, B, upper, GAMMA), lqr_gain(A, B, W, GAMMA), atol=1e-11, rtol=0)
    costs = (affine_cost_to_go(A, B, offset, x, q, P, GAMMA) for x in (upper, W))
    assert_close(*costs, atol=1e-11, rtol=0)
