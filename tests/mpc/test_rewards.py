"""Costs of schemes from the rewards of logs."""

import pytest
import torch
from tensordict import TensorDict
from torch.testing import assert_close

from torch_qpmpc import QPMPC, Model, QPError, Scheme
from torch_qpmpc.identification.innovations import Innovations
from torch_qpmpc.mpc.layout import Layout
from torch_qpmpc.mpc.stage_cost import fit_rewards, scheme_cost

LAYOUT = Layout(2, 1, 3)
W = torch.tensor([[2.0, 0.5, 0.0], [0.5, 1.0, 0.0], [0.0, 0.0, 0.3]]).double()
Q_LINEAR = torch.tensor([1.0, -2.0, 0.5]).double()


def log(noise: float = 0.0) -> TensorDict:
    draw = torch.Generator().manual_seed(0)
    y, following, u, e = (
        torch.randn(1, 300, n, generator=draw, dtype=torch.float64) for n in (2, 2, 1, 1)
    )
    v = torch.cat((y, u), -1)
    cost = ((v @ W * v).sum(-1) / 2 + v @ Q_LINEAR + 3.0).unsqueeze(-1)
    following = {"observation": following, "reward": noise * e - cost}
    return TensorDict({"observation": y, "action": u, "next": following}, (1, 300))


@pytest.mark.filterwarnings("error")
def test_the_cost_of_the_rewards_is_found():
    fitted = fit_rewards(log(), LAYOUT)
    assert_close(fitted.W, W)
    assert_close(fitted.q, Q_LINEAR)
    assert pytest.approx(1) == fitted.R2


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("signal", ["state", "output"])
@pytest.mark.parametrize("size", [1.0, 1000.0])
def test_a_cost_of_the_next_signals_becomes_one_of_the_present_by_the_model(signal, size):
    """However little of the rewards' variance the noise explains."""
    draw = torch.Generator().manual_seed(0)
    A, B = torch.tensor([[0.9, 0.2], [0.0, 0.7]]).double(), torch.tensor([[0.1], [1.0]]).double()
    L = (
        torch.eye(2).double()
        if signal == "state"
        else torch.diag(torch.tensor([0.4, 0.2])).double()
    )
    x, u = (size * torch.randn(300, n, generator=draw, dtype=torch.float64) for n in (2, 1))
    e = 0.3 * torch.randn(300, 2, generator=draw, dtype=torch.float64)
    predicted = x @ A.mT + u @ B.mT + 0.5
    v = torch.cat((predicted + e, u), -1)
    reward = -((v @ W * v).sum(-1) / 2 + v @ Q_LINEAR + 3.0).unsqueeze(-1)
    after = {"observation": predicted + e @ L.mT, "measured": predicted + e, "reward": reward}
    data = TensorDict({"observation": x, "action": u, "next": after}, [300])
    C = torch.eye(2).double()
    parts = (A, B, torch.zeros(2, 0), torch.full((2,), 0.5), C, L, 0.09 * C, torch.zeros(2), C)
    model = Innovations(*(part.double().numpy() for part in parts))
    fitted = fit_rewards(data, LAYOUT, model=model)
    assert pytest.approx(1, abs=1e-12) == fitted.R2
    v = torch.cat((predicted, u), -1)
    expected = (v @ W * v).sum(-1) / 2 + v @ Q_LINEAR + 3.0 + 0.09 * W[:2, :2].trace() / 2
    assert_close(fitted(torch.cat((x, u), -1)), expected)


def test_a_poor_fit_is_said():
    with pytest.warns(UserWarning, match=r"explains -?\d+\.\d% of .* Pass the plant's own cost"):
        fit_rewards(log(noise=10.0), LAYOUT)


def test_rewards_that_are_missing_or_not_finite_are_named():
    data = log()
    data["next", "reward"][0, 3] = torch.nan
    with pytest.raises(QPError, match="stage_weight: got none, and a log with rewards of NaN or"):
        fit_rewards(data, LAYOUT)
    with pytest.raises(QPError, match=r"stage_weight: got none, and a log without rewards"):
        fit_rewards(data.exclude(("next", "reward")), LAYOUT)


@pytest.mark.filterwarnings("ignore:The fitted stage cost explains")
def test_logs_that_differ_in_what_they_measured_are_fitted_together():
    """The outputs of estimates count where every log has those of the model."""
    zero, C = torch.zeros(2, 0), torch.eye(2)
    parts = (0.5 * C, torch.ones(2, 1), zero, C[0], C, C, C, 0 * C[0], C)
    model = Innovations(*(part.double().numpy() for part in parts))
    data, outputs = log(), torch.zeros(1, 300, 1).double()
    plain = fit_rewards([data, data], LAYOUT, model=model)
    for own in (data["next", "observation"], outputs):
        estimates = data.clone().set(("next", "measured"), own)
        for mixed in ([estimates, data], [data, estimates]):
            assert torch.equal(fit_rewards(mixed, LAYOUT, model=model).W, plain.W)


@pytest.mark.filterwarnings("ignore:The fitted stage cost has too few rewards")
@pytest.mark.parametrize("rows", range(4))
def test_a_log_of_few_rows_has_a_cost_or_says_why_not(rows):
    data = log()[:, :rows]
    if rows:
        assert fit_rewards([data, data[:, :0]], LAYOUT).W.isfinite().all()
    else:
        with pytest.raises(QPError, match="stage_weight: got none, and a log without steps"):
            fit_rewards([data, data], LAYOUT)


@pytest.mark.parametrize("hessian", ["diagonal", "block"])
def test_the_cost_of_a_plan_is_the_sum_of_its_stages(hessian):
    """x_N has the stage's cost, without an action."""
    gamma = 0.8
    A, B = torch.tensor([[0.9, 0.2], [0.0, 0.7]]).double(), torch.tensor([[0.1], [1.0]]).double()
    fitted = fit_rewards(log(), LAYOUT)
    if hessian == "diagonal":
        fitted = type(fitted)(torch.diag(W.diagonal()), fitted.q, fitted.c)
    cost = scheme_cost(fitted, LAYOUT, gamma, hessian)
    qp = QPMPC(Scheme(LAYOUT, Model(A, B), cost, gamma=gamma)).quadratic_program()
    x, total, z = torch.tensor([1.0, -2.0]).double(), 0.0, []
    for k, u in enumerate(torch.tensor([[0.3], [-1.0], [2.0]]).double()):
        z += [x, u]
        total += gamma**k * fitted(torch.cat((x, u)))
        x = A @ x + B @ u
    z, total = (
        torch.cat((*z, x)),
        total + gamma**3 * fitted(torch.cat((x, torch.zeros(1))).double()),
    )
    assert_close(z @ qp.H @ z / 2 + qp.q @ z + qp.c, total)
