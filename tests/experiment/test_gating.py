from pathlib import Path
from typing import Any

import pytest
import torch
from torch.testing import assert_close

import train
from tests.runs import SMALL, make_config
from torch_qpmpc.experiment.algorithms import make_learner, make_operator
from torch_qpmpc.experiment.gating import PATIENCE, RunGate
from torch_qpmpc.experiment.run_folder import read_metrics
from torch_qpmpc.experiment.tasks import make_mpc, make_physics

GATED = (*SMALL, "gate=true", "optimizer=gauss_newton", "batch_size=32", "steps_per_update=4")
GATED += ("gate_interval=3",)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    folder = tmp_path_factory.mktemp("gated")
    return folder, train.train(make_config(*GATED, "updates=8"), str(folder))


def test_candidates_are_judged(run):
    folder, summary = run
    assert summary["accepted"] + summary["rejected"] == 3
    assert summary["accepted"] > 0
    table: Any = read_metrics(folder)
    assert table["qp/solves"].max() <= 3 * 32 + 4 * 4  # V(s+), Q before and after, and collected
    judged = table.dropna(subset=["gate/pairs"])
    assert judged.index.to_list() == [3, 6, 8]
    for row in judged.to_dict("records"):
        assert (float(row["gate/high"]) < 0) == bool(row["gate/accepted"])
    assert summary["simulated"] == 10 * 2 * judged["gate/pairs"].sum()
    assert summary["J_best"] < summary["J_start"]


def make_gate(*overrides: str) -> tuple[RunGate, Any]:
    cfg = make_config(*SMALL, *overrides)
    physics = make_physics(cfg)
    mpc = make_mpc(cfg, physics)
    learner = make_learner(cfg, make_operator(mpc))
    return RunGate(cfg, learner, physics), learner.actor


def test_without_a_gate_the_learner_acts():
    gate, actor = make_gate("gate=false")
    assert gate.kept is gate.acting is actor
    assert gate.judge(4) == gate.summary() == {}
    assert gate.state_dict() is None


def test_a_candidate_that_got_worse_is_not_kept():
    gate, actor = make_gate("gate=true")
    before = gate.kept.module.C.detach().clone()
    with torch.no_grad():
        for parameter in actor.parameters():
            parameter.mul_(3.0)
    assert gate.judge(4)["gate/accepted"] == 0.0
    assert_close(gate.kept.module.C.detach(), before)


@pytest.mark.parametrize(("gate", "restarts"), [("true", False), ("act", True), ("plant", True)])
def test_the_learner_acts_and_goes_on_unless_only_what_is_kept_acts(gate, restarts):
    judged, actor = make_gate(f"gate={gate}")
    start = judged.kept.module.C.detach().clone()
    assert judged.acting is (judged.kept if restarts else actor)
    with torch.no_grad():
        actor.module.C.mul_(3.0)
    for _ in range(PATIENCE):
        assert_close(actor.module.C.detach(), 3 * start)
        assert judged.judge(4)["gate/accepted"] == 0.0
    assert_close(actor.module.C.detach(), (1 if restarts else 3) * start)


@pytest.mark.parametrize(("gate", "name"), [("act", "simulated"), ("plant", "alternated")])
def test_on_the_plant_no_two_episodes_are_the_same_and_all_count(gate, name):
    judged, _ = make_gate(f"gate={gate}")
    verdict = judged.judge(4)  # the candidate is what is kept
    assert (verdict["gate/mean"] != 0) == (gate == "plant")
    assert judged.summary()[name] == 10 * 2 * verdict["gate/pairs"]


def test_a_gate_that_only_keeps_does_not_change_what_is_learned(tmp_path):
    ends = {}
    for gate in ("true", "false"):
        cfg = make_config(*GATED, "updates=4", "gate_interval=1", f"gate={gate}")
        ends[gate] = train.train(cfg, str(tmp_path / gate))
    assert ends["true"]["rejected"] > 0
    assert ends["true"]["J_final"] == ends["false"]["J_final"]


def test_without_an_interval_of_its_own_each_evaluation_is_judged():
    gate, _ = make_gate("gate=true", "gate_interval=null", "updates=8")
    assert [bool(gate.judge(update)) for update in range(1, 9)] == [False, True] * 4
