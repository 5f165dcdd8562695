"""Costs of schemes from the rewards of logs."""

from __future__ import annotations

import re

import pytest
import torch
from tensordict import TensorDict
from torch.testing import assert_close

from torch_qpmpc import QPMPC, Model, Scheme
from torch_qpmpc.mpc.layout import Layout
from torch_qpmpc.mpc.rewards import fit_most, fit_rewards, scheme_cost

LAYOUT = Layout(2, 1, 3)
W = torch.tensor([[2.0, 0.5, 0.0], [0.5, 1.0, 0.0], [0.0, 0.0, 0.3]]).double()
Q_LINEAR = torch.tensor([1.0, -2.0, 0.5]).double()


def cost_of(x: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
    v = torch.cat((x, u), -1)
    return (v @ W * v).sum(-1) / 2 + v @ Q_LINEAR + 3.0


def log(after: bool, noise: float = 0.0) -> TensorDict:
    """Return steps between independent observations, with costs of one of the two."""
    draw = torch.Generator().manual_seed(0)
    y, following, u, e = (
        torch.randn(1, 300, n, generator=draw, dtype=torch.float64) for n in (2, 2, 1, 1)
    )
    reward = -cost_of(following if after else y, u).unsqueeze(-1) + noise * e
    following = {"observation": following, "reward": reward}
    return TensorDict({"observation": y, "action": u, "next": following}, (1, 300))


@pytest.mark.parametrize("after", [False, True])
def test_the_better_of_both_costs_is_used_and_both_are_shown(after):
    fitted = fit_rewards(log(after), LAYOUT, after=True)
    assert fitted.shifted is after
    assert fitted.best is (fitted.after if after else fitted.now)
    assert_close(fitted.best.W, W)
    used = "(y_(k+1), u_k)" if after else "(y_k, u_k)"
    text = (
        r"R2 (-?\d\.\d{3}) on \(y_k, u_k\), (-?\d\.\d{3}) on \(y_\(k\+1\), u_k\); the cost is of "
    )
    match = re.search(text + re.escape(used), str(fitted))
    assert match is not None
    assert match[2 if after else 1] == "1.000"
    unusable = fitted._replace(usable=False)
    assert unusable.best is fitted.now
    assert ("choose constraint=free" in str(unusable)) is after


@pytest.mark.filterwarnings("error")
def test_equal_fits_are_of_the_present_output():
    data = log(False)
    data["next", "observation"] = data["observation"]
    assert not fit_rewards(data, LAYOUT, after=True).shifted


def test_a_poor_fit_is_said_once():
    poor = r"explains -?\d+\.\d% of .* Pass the plant's own cost"
    with pytest.warns(UserWarning, match=poor) as said:
        fitted = fit_rewards(log(True, noise=10.0), LAYOUT, after=True)
    assert len(said) == 1
    assert re.search(poor, str(fitted))
    with pytest.warns(UserWarning, match=poor):
        fit_rewards(log(True), LAYOUT)


@pytest.mark.filterwarnings("ignore:The fitted stage cost")
@pytest.mark.parametrize("after", [False, True])
def test_the_cost_of_most_steps_is_that_of_all_but_the_jumps(after):
    data = log(after)
    data["next", "reward"][:, ::20] -= 100.0
    fitted = fit_rewards(data, LAYOUT, after=True)
    most = fit_most(data, LAYOUT, fitted)
    assert most is not None
    assert most.shifted is after
    assert most.kept == 0.95  # rounding leaves out none of the others
    assert_close(most.best.W, W)
    assert not torch.allclose(fitted.best.W, W, atol=0.1)
    assert most.variables == f"{fitted.variables} in most steps"
    assert f"{most.kept:.1%} of them" in str(most)


def test_no_cost_is_of_most_steps_if_one_is_of_all_or_of_too_few():
    fitted = fit_rewards(log(True), LAYOUT, after=True)
    assert fit_most(log(True), LAYOUT, fitted) is None
    noisy, often = log(True, noise=10.0), log(True)
    often["next", "reward"][:, ::6] -= 100.0
    for data in (noisy, often):
        with pytest.warns(UserWarning, match="explains"):
            fitted = fit_rewards(data, LAYOUT, after=True)
        assert fit_most(data, LAYOUT, fitted) is None


@pytest.mark.parametrize("hessian", ["diagonal", "block", "full"])
def test_a_shifted_cost_is_the_sum_of_the_costs_of_the_next_states(hessian):
    """Q(s, a) of a plan is that of its stage costs of (x_{k+1}, u_k), and x_0 costs nothing."""
    gamma = 0.8
    A, B = torch.tensor([[0.9, 0.2], [0.0, 0.7]]).double(), torch.tensor([[0.1], [1.0]]).double()
    diagonal = hessian == "diagonal"
    fitted = fit_rewards(log(True), LAYOUT, after=True).best
    if diagonal:
        fitted = type(fitted)(torch.diag(W.diagonal()), fitted.q, fitted.c)
    cost = scheme_cost(fitted, LAYOUT, gamma, hessian, shifted=True)
    qp = QPMPC(Scheme(LAYOUT, Model(A, B), cost, gamma=gamma)).quadratic_program()
    x, total, z = torch.tensor([1.0, -2.0]).double(), 0.0, []
    for k, u in enumerate(torch.tensor([[0.3], [-1.0], [2.0]]).double()):
        z += [x, u]
        x = A @ x + B @ u
        total += gamma**k * fitted(torch.cat((x, u)))
    z = torch.cat((*z, x))
    assert_close(z @ qp.H @ z / 2 + qp.q @ z + qp.c, total)
