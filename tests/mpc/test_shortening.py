"""A QP without its last stage: that of a scheme with one stage less, its value and gradients."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from tests.mpc import test_prefix as prefix
from tests.problems import MIXED, normal, random_mpc, random_states
from torch_qpmpc import QPMPC, QPError

N = prefix.N
#: b of a model with an offset, which is the same for all stages.
OFFSET = {"offset": [0.1, -0.2]}


def scheme(horizon: int, structure: str = "tied", hessian: str = "block", **options: Any) -> QPMPC:
    """Make a scheme with a window, a preview, and rows of every kind."""
    settings = prefix.SETTINGS | OFFSET | {"structure": structure, "hessian": hessian} | options
    if hessian == "diagonal":
        settings |= {"stage_weight": [1.0, 2.0, 0.5], "terminal_weight": [3.0, 4.0]}
    return QPMPC.from_model(prefix.A, prefix.B, horizon, **settings)


def without_last(p: Tensor) -> Tensor:
    """Drop d_N from p."""
    return torch.cat((p[:, : N * prefix.N_D], p[:, (N + 1) * prefix.N_D :]), -1)


@pytest.mark.parametrize("discount_slack", [False, True])
@pytest.mark.parametrize("hessian", ["diagonal", "block"])
@pytest.mark.parametrize("structure", ["free", "tied", "varying"])
def test_it_is_the_scheme_of_one_stage_less(structure, hessian, discount_slack):
    options = {"discount_slack": discount_slack, "state_slack": [2.0, torch.inf]}
    long, short = (scheme(k, structure, hessian, **options) for k in (N, N - 1))
    found, expected = long.shortened(), short.quadratic_program()
    for one, other in zip(found.tensors(), expected.tensors(), strict=True):
        assert_close(one, other)


def test_tied_costs_move_with_their_signal():
    """q and w of x_N, q of d_N, and the bounds become those of N - 1; c loses one stage's share."""
    gamma, parts = prefix.GAMMA, ("q", "b", "lb", "ub", "w")
    long, short = scheme(N), scheme(N - 1)
    with torch.no_grad():
        for part in parts:
            (theirs,), (ours,) = long.leaves(part), short.leaves(part)
            theirs += 0.1 * normal(*theirs.shape, seed=7).tanh()
            ours.copy_(theirs)
        long.c.fill_(1 + gamma + gamma**2)
        short.c.fill_(1 + gamma)
    found, expected = long.shortened(), short.quadratic_program()
    for one, other in zip(found.tensors(), expected.tensors(), strict=True):
        assert_close(one, other)


def test_the_constant_without_a_discount_loses_one_share_of_n():
    mpc = random_mpc(1, learn=("c",), gamma=1.0)
    with torch.no_grad():
        mpc.c.fill_(mpc.horizon)
    assert_close(mpc.shortened().c.item(), mpc.horizon - 1.0)


def test_a_free_c_and_g_keep_the_predictions_that_remain():
    mpc = prefix.make(2)
    n, qp, full = prefix.n, mpc.shortened(), mpc.quadratic_program()
    d, past = prefix.N_D, (prefix.L - 1) * n
    before, columns = N * d, [*range(N * d), *range((N + 1) * d, mpc.n_z - n)]
    assert_close(qp.C, full.C[: -prefix.N_X][:, columns])
    stages = (N - 1) * n  # rows and entries of x_0, .., u_{N-2}
    assert_close(qp.G[:stages], full.G[:stages][:, columns])
    of_last = full.G[stages + n :][: prefix.N_X]  # the rows of x_N
    at = before + past + stages
    assert_close(qp.G[stages : stages + prefix.N_X, at:], of_last[:, -prefix.N_X :])
    assert_close(
        qp.G[stages : stages + prefix.N_X, before - d : before], of_last[:, N * d :][:, :d]
    )


@pytest.mark.parametrize("solver", ["daqp", "proxqp"])
def test_its_value_and_active_set(solver):
    long, short = scheme(N, solver=solver), scheme(N - 1, solver=solver)
    p, _ = prefix.known()
    expected = short.value(without_last(p))
    value, active = long.shortened_value(p)
    assert_close(value, expected, rtol=1e-6, atol=1e-6)
    assert active.shape == (len(p), len(long.lb))
    assert active.any()
    again, same = long.shortened_value(p, active)
    assert_close(again, value, rtol=1e-6, atol=1e-6)
    assert torch.equal(active, same)
    single, _ = long.shortened_value(p.float(), qp=long.quadratic_program())
    assert single.dtype == torch.float32


def test_an_exact_model_has_no_error_at_any_terminal_cost():
    """Q_N = L + V_{N-1} for the model's own transitions, whatever the terminal cost."""
    gamma, settings = 0.8, {"discount_slack": True, "gamma": 0.8, "solver": "daqp", **MIXED}
    mpc = random_mpc(3, learn=("H",), free=0.0, **settings)
    s, a = random_states(5), 0.1 * normal(5, 1)
    solution = mpc.solve(s, a)
    x, _ = mpc.predicted(solution.z)
    stage = mpc.solve(s, a).z[:, :3]
    weight = mpc.H if mpc.H.ndim == 1 else mpc.H[0]
    rows, lower, upper = (torch.tensor(part).double() for part in MIXED["constraints"])
    y = stage @ rows.mT
    slack = (y - upper).relu() + (lower - y).relu()
    slack = (mpc.w[11:13] * slack).sum(-1) + (mpc.w[:2] * solution.sigma[:, :2]).sum(-1)
    L = 0.5 * (weight * stage.square()).sum(-1) + slack
    V = mpc.shortened_value(x[:, 1])[0]
    assert_close(solution.value, L + gamma * V, rtol=1e-6, atol=1e-6)


def test_its_gradients_pass_finite_differences():
    mpc, (p, _) = prefix.make(3), prefix.known(2)
    theta = list(mpc.parameters())
    mpc.shortened_value(p)[0].sum().backward()
    for k, parameter in enumerate(theta):
        direction = normal(*parameter.shape, seed=20 + k)
        values = []
        for step in (1e-5, -2e-5, 1e-5):
            with torch.no_grad():
                parameter += step * direction
                values.append(mpc.shortened_value(p)[0].sum())
        slope = (values[0] - values[1]) / 2e-5
        assert parameter.grad is not None
        assert_close((parameter.grad * direction).sum(), slope, rtol=1e-4, atol=1e-4)


def test_it_needs_stages():
    with pytest.raises(QPError, match="horizon: got 1, expected at least 2, to drop a stage"):
        random_mpc(0, horizon=1).shortened()
    with pytest.raises(QPError, match="hessian: got 'full', expected 'diagonal' or 'block'"):
        scheme(N, hessian="full", learn=("C",)).shortened()
    mpc = scheme(N)
    p, _ = prefix.known()
    with pytest.raises(QPError, match=r"warm_start: got shape \(6, 2\), expected shape \(6, "):
        mpc.shortened_value(p, torch.zeros(6, 2, dtype=torch.int8))
