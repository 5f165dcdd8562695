"""What nobody chose: the terminal weight, and the stage cost."""

from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch.testing import assert_close

from tests.logs import arx_log
from torch_qpmpc import QPMPC
from torch_qpmpc.mpc.riccati import riccati_weight

A = torch.tensor([[1.0, 0.1], [0.0, 0.9]]).double()
B = torch.tensor([[0.0], [0.1]]).double()
W = torch.tensor([[1.0, 0.1, 0.0], [0.1, 0.5, 0.0], [0.0, 0.0, 0.1]]).double()


# The terminal weight


def terminal_block(mpc: QPMPC, n_x: int) -> torch.Tensor:
    H = mpc.quadratic_program().H.detach()
    return H[-n_x:, -n_x:] / mpc.gamma**mpc.horizon


def test_it_is_the_riccati_weight_if_that_exists():
    mpc = QPMPC.from_model(A, B, 4, hessian="block", stage_weight=W)
    assert_close(terminal_block(mpc, 2), riccati_weight(A, B, W, 0.9))


@pytest.mark.parametrize(
    ("model", "options"),
    [
        ((A, B), {"hessian": "diagonal", "stage_weight": W.diagonal()}),
        ((2 * torch.eye(2), [[1.0], [0.0]]), {}),  # not stabilisable
        ((A.expand(4, 2, 2), B), {}),
        ((A, B), {"stage_weight": torch.stack((9 * W, 9 * W, 9 * W, W))}),
        ((A, B), {"q": torch.ones(14)}),  # its target is not zero
    ],
)
def test_else_it_is_the_stages(model: Any, options: dict[str, Any]):
    settings: dict[str, Any] = {"hessian": "block", "stage_weight": W, **options}
    mpc = QPMPC.from_model(model[0], model[1], 4, **settings)
    expected = W[:2, :2] if settings["hessian"] == "block" else torch.diag(W.diagonal()[:2])
    assert_close(terminal_block(mpc, 2), expected)


@pytest.mark.parametrize("horizon", [1, 5, 20])
def test_a_reference_in_the_preview_is_reached(horizon):
    weight = torch.tensor([[2.0, -2.0, 0.0], [-2.0, 2.0, 0.0], [0.0, 0.0, 1e-4]])
    options = {"hessian": "block", "stage_weight": weight, "gamma": 1.0, "solver": "daqp"}
    bounds = ([20.0], [80.0])
    mpc = QPMPC.from_model([[0.95]], [[0.05]], horizon, E=[[0.0]], action_bounds=bounds, **options)
    y = torch.tensor([50.0])
    for _ in range(60):
        u = mpc.policy(torch.cat((55.0 * torch.ones(horizon + 1), y))).detach()
        y = 0.95 * y + 0.05 * u
    assert y.item() == pytest.approx(55.0, abs=1e-2 if horizon > 1 else 0.1)  # u costs a little


# The stage cost


def rewarded() -> tuple[TensorDict, torch.Tensor]:
    """Return a log with its costs, of which the weights of (y, u) are 1/2 diag(2, 1, 0.2)."""
    log = arx_log(noise=0.1)
    weight = torch.tensor([2.0, 1.0, 0.2]).double()
    v = torch.cat((log["observation"], log["action"]), -1)
    log["next", "reward"] = -(v.square() @ weight / 2 + v[..., :1].squeeze(-1)).unsqueeze(-1)
    return log, weight


@pytest.mark.parametrize("hessian", ["diagonal", "block"])
def test_from_data_fits_the_cost_to_the_rewards(hessian):
    log, weight = rewarded()
    mpc = QPMPC.from_data(log, 3, hessian=hessian, gamma=0.8, learn=("H", "H_f", "q"))
    H, H_f = (x if hessian == "diagonal" else x.diagonal() for x in (mpc.H, mpc.H_f))
    assert_close(H.detach(), weight, rtol=1e-6, atol=1e-6)
    assert_close(H_f.detach(), weight[:2], rtol=1e-6, atol=1e-6)
    assert_close(mpc.q[-2:].detach(), torch.tensor([1.0, 0.0]).double(), rtol=1e-6, atol=1e-6)
    absent = QPMPC.from_data(log, 3, hessian=hessian, gamma=0.8, learn=("H", "H_f", "q"), q=None)
    assert_close(absent.q, mpc.q)
    own = QPMPC.from_data(log, 3, stage_weight=[1.0, 1.0, 0.1])
    assert own.H.tolist() == [1.0, 1.0, 0.1]
    assert (own.q == 0).all()
