"""Warm starts of replayed transitions from the active sets stored with them."""

import copy

import numpy as np
import pandas as pd
import pytest
import torch
from torch.testing import assert_close

import train
from tests.problems import random_mpc
from tests.runs import SMALL, make_config
from tests.transitions import make_loss, transitions
from torch_qpmpc import QPActorValueOperator, SolveLog
from torch_qpmpc.learning.replay import ACTIVE_SET, ACTIVE_SETS, Replay
from torch_qpmpc.qp.program import UNKNOWN

COUNT = 12


def test_an_operator_reads_and_writes_the_active_set():
    mpc = random_mpc(3, solver="proxqp")
    operator = QPActorValueOperator(mpc, active_set_key="codes")
    assert operator.out_keys == ["state_action_value", "codes"]
    assert operator.get_value_operator().out_keys == ["state_value", "codes"]
    assert operator.get_policy_operator().out_keys == ["action"]
    td = transitions().select("observation", "action")
    with SolveLog() as first:
        operator(td)
    assert torch.equal(td["codes"], mpc.solve(td["observation"], td["action"]).active)
    before = td["state_action_value"].clone()
    with SolveLog() as second:
        operator(td)
    assert (first.recalled, second.recalled) == (0, COUNT)
    assert_close(td["state_action_value"], before, rtol=1e-6, atol=1e-6)


@pytest.mark.filterwarnings("ignore:No target network updater")
def test_the_loss_keeps_the_active_sets_of_both_problems(solver):
    operator = QPActorValueOperator(random_mpc(3, solver=solver), active_set_key=ACTIVE_SET)
    loss = make_loss(operator=operator, delay_value=solver == "daqp")
    td = transitions()
    mpc = copy.deepcopy(loss.operator.module)
    with SolveLog() as first:
        cold = loss(td)["loss_value"]
    cold.backward()
    gradients = [p.grad.clone() for p in loss.parameters() if p.grad is not None]
    loss.zero_grad()
    s, a, following = td["observation"], td["action"], td["next", "observation"]
    assert torch.equal(td[ACTIVE_SET], mpc.solve(s, a).active)
    assert torch.equal(td["next", ACTIVE_SET], mpc.solve(following).active)
    with SolveLog() as second:
        warm = loss(td)["loss_value"]
    warm.backward()
    assert (first.recalled, first.solves) == (0, 2 * COUNT)
    assert second.recalled == 2 * COUNT
    assert_close(warm, cold, rtol=1e-6, atol=1e-6)
    again = [p.grad for p in loss.parameters() if p.grad is not None]
    assert gradients
    for one, other in zip(again, gradients, strict=True):
        assert_close(one, other, rtol=1e-4, atol=1e-5)


def test_a_replay_returns_remembered_active_sets():
    replay = Replay(8 * 4, 4, 6, 2, 5, active_rows=3)
    batch = transitions(20).reshape(4, 5)
    batch["collector", "traj_ids"] = torch.arange(4).unsqueeze(-1).expand(4, 5).clone()
    replay.extend(batch)
    assert ACTIVE_SET not in batch
    assert (replay.transitions[:][ACTIVE_SET] == UNKNOWN).all()
    told = {}
    for i in range(40):
        sample = replay.sample()
        for place, row in zip(sample["index"].tolist(), sample.unbind(0), strict=True):
            expected = told.get(tuple(place), (UNKNOWN, UNKNOWN))
            got = tuple(int(row[key][0]) for key in ACTIVE_SETS)
            assert got == expected
        for key, code in zip(ACTIVE_SETS, (i % 3, -(i % 2)), strict=True):
            sample[key] = torch.full((6, 3), code, dtype=torch.int8)
        replay.remember(sample)
        told |= {tuple(place): (i % 3, -(i % 2)) for place in sample["index"].tolist()}
    assert len(told) == 20
    replay.extend(batch)
    assert (replay.transitions[:][ACTIVE_SET] == UNKNOWN).any()


def test_training_is_the_same_without_the_cache(tmp_path, monkeypatch):
    """Equal up to the certificate's tolerance."""
    cfg = make_config(*SMALL, "updates=6", "batch_size=32", "eval_interval=6")
    runs = [train.train(cfg, str(tmp_path / "true"))]
    monkeypatch.setattr(train, "make_operator", QPActorValueOperator)
    monkeypatch.setattr(Replay, "remember", lambda *_: None)
    runs.append(train.train(cfg, str(tmp_path / "false")))
    for name in ("J_start", "J_final", "J_discounted_final"):
        assert runs[0][name] == pytest.approx(runs[1][name], rel=1e-5)
    for on in ("true", "false"):
        recalled = pd.read_csv(tmp_path / on / "metrics.csv")["qp/recalled"].to_numpy()
        collected = 4  # one step of each environment, warm-started from the previous one
        assert (np.nanmax(recalled) > collected) == (on == "true"), (
            "as the optimiser is first-order"
        )
