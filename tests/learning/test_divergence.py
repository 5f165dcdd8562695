"""Far too large a learning rate spoils theta, but does not end the run."""

import json
import math
from typing import Any

import pandas as pd
import pytest
import torch

import train
from tests.problems import drawn_mpc
from tests.runs import SMALL, make_config
from tests.transitions import transitions
from torch_qpmpc import QPMPC, GaussNewton
from torch_qpmpc.files import load_file
from torch_qpmpc.learning.penalties import Penalties
from torch_qpmpc.learning.updates import first_order
from torch_qpmpc.mpc.state import KIND

#: Factors of a thousand and more by which the rates are too large.
RATES = {
    "adam": ("optimizer.lr_cost=10", "optimizer.lr_constraints=10"),
    "gauss_newton": ("optimizer.scale_constraints=1e6",),
}


@pytest.mark.parametrize(("optimizer", "slack"), [*zip(RATES, ["100", "inf"], strict=True)])
def test_a_run_with_far_too_large_a_rate_ends_with_a_summary(tmp_path, optimizer, slack):
    sizes = ("updates=5", "eval_interval=5", "task.eval_steps=5", f"task.state_slack={slack}")
    rates = (f"optimizer={optimizer}", *RATES[optimizer], "optimizer.final_fraction=1")
    cfg = make_config(*SMALL, *sizes, "constraint=free", *rates)
    train.train(cfg, str(tmp_path))
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["J_final"] > summary["J_true_model"], "what it has learned is no good"
    for key in ("J_start", "J_final", "train_cost", "unsolved"):
        assert math.isfinite(summary[key]), key
    state = load_file(tmp_path / "checkpoint.pt", KIND)["mpc"]
    assert not any(value.isnan().any() for value in state.values())
    assert state["C"].isfinite().all()
    table: Any = pd.read_csv(tmp_path / "metrics.csv")
    assert len(table) == 6, "each update has reported"
    assert summary["unsolved"] == table["qp/unsolved"].sum()
    if slack == "inf":
        assert table["train/unsolved"].sum() > 0


def test_gauss_newton_takes_no_step_that_is_not_finite():
    mpc = drawn_mpc(2, 1, 3, solver="daqp")
    optimizer = GaussNewton(mpc)
    before = {name: value.clone() for name, value in mpc.state_dict().items()}
    s, a = torch.ones(2, 2).double(), torch.zeros(2, 1).double()
    target = torch.full((2,), 1e308, dtype=torch.float64)
    S = 1e308 * torch.eye(mpc.n_z + 1, dtype=torch.float64)
    report = optimizer.step(s, a, target, penalty=S)
    assert not report.accepted
    assert all(torch.equal(value, before[name]) for name, value in mpc.state_dict().items())
    assert optimizer.param_groups[0]["damping"] > report.damping
    assert optimizer.step(s, a, mpc.action_value(s, a).detach() + 1).accepted


class Steep(torch.nn.Module):
    """A finite loss with an infinite gradient."""

    def __init__(self, mpc: QPMPC) -> None:
        super().__init__()
        self.mpc = mpc

    def forward(self, batch: object) -> dict[str, torch.Tensor]:
        loss = (self.mpc.C - self.mpc.C.detach()).abs().sum().sqrt()
        return {"loss_value": loss, "unsolved": 0 * loss, "invalid_reward": 0 * loss}


def test_a_gradient_that_is_not_finite_moves_nothing():
    mpc = drawn_mpc(2, 1, 3, learn=["C"], solver="daqp")
    optimizer = torch.optim.SGD(mpc.parameter_groups({"cost": 1.0, "constraints": 1.0}))
    before = mpc.C.detach().clone()
    update = first_order(mpc, Steep(mpc), optimizer, Penalties())  # pyright: ignore[reportArgumentType] -- what is used of a loss is there
    terms, _ = update(transitions(), None)
    assert terms["loss/value"] == 0
    assert torch.equal(mpc.C, before)
