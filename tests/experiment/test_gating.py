from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch.testing import assert_close

import train
from tests.logs import arx_log
from tests.runs import SMALL, make_config
from tests.store import Store
from torch_qpmpc import QPMPC, Model
from torch_qpmpc.envs.arx_plant import ARXMember
from torch_qpmpc.experiment.algorithms import evaluate, make_learner, make_operator
from torch_qpmpc.experiment.collection import make_run_replay
from torch_qpmpc.experiment.ensemble import run_ensemble
from torch_qpmpc.experiment.gating import BEST, PATIENCE, RunGate
from torch_qpmpc.experiment.run_folder import read_metrics
from torch_qpmpc.experiment.start import collect_log
from torch_qpmpc.experiment.tasks import make_mpc, make_physics
from torch_qpmpc.experiment.tasks.identified import Start
from torch_qpmpc.study.runs import FinishedRun

GATED = (*SMALL, "gate=true", "optimizer=gauss_newton", "batch_size=32", "steps_per_update=4")
GATED += ("gate_interval=3",)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    folder = tmp_path_factory.mktemp("gated")
    summary = train.train(
        make_config(*GATED, "updates=8", "search.H_u=0.5", "search.loops=6"), str(folder)
    )
    return folder, summary


def test_candidates_and_the_search_are_judged(run):
    folder, summary = run
    assert summary["accepted"] + summary["rejected"] == 3 + 1
    assert summary["accepted"] > 0
    table = read_metrics(folder)
    judged = table.dropna(subset=["gate/pairs"])
    assert judged.index.to_list() == [3, 6, 8]
    for row in judged.to_dict("records"):
        assert (float(row["gate/high"]) < 0) == bool(row["gate/accepted"])
    assert len(table["search/H_u"].dropna()) == 1
    loops = 2 * judged["gate/pairs"].sum() + 2 * table["search/pairs"].sum() + 6 * 32
    assert summary["simulated"] == 10 * loops


def test_the_policy_that_is_kept_is_the_one_that_is_reported(run):
    folder, summary = run
    finished = FinishedRun(folder)
    loop = evaluate(finished.cfg, finished.policy.policy, finished.physics)
    assert summary["J_best"] == pytest.approx(loop.J, rel=1e-9)
    assert summary["J_best"] < summary["J_start"]
    assert read_metrics(folder)["eval/J"].iloc[-1] == summary["J_best"]
    assert (folder / BEST).exists()


def make_gate(*overrides: str, start: Start | None = None) -> tuple[RunGate, Any]:
    cfg = make_config(*SMALL, *overrides)
    physics = make_physics(cfg)
    mpc = make_mpc(cfg, physics)
    learner, replay = make_learner(cfg, make_operator(cfg, mpc), physics), make_run_replay(cfg, mpc)
    return RunGate(cfg, learner, physics, start, replay), learner.actor


def test_without_a_gate_the_learner_acts(tmp_path):
    gate, actor = make_gate("gate=false")
    assert gate.kept is gate.acting is actor
    assert gate.judge(4) == gate.summary() == {}
    assert gate.state_dict() is None
    gate.save(tmp_path)
    assert not (tmp_path / BEST).exists()


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
    for gate in ("true", "false", "act"):
        cfg = make_config(*GATED, "updates=8", "gate_interval=1", f"gate={gate}")
        ends[gate] = train.train(cfg, str(tmp_path / gate))
    assert ends["true"]["rejected"] > 0
    assert ends["true"]["J_final"] == ends["false"]["J_final"]
    assert ends["act"]["J_final"] != ends["false"]["J_final"]


def test_no_candidate_passes_under_a_bound_far_above_its_gain(tmp_path):
    summary = train.train(make_config(*GATED, "updates=3", "gate_bound=1e9"), str(tmp_path))
    assert (summary["accepted"], summary["rejected"]) == (0, 1)
    assert summary["J_best"] == summary["J_start"] != summary["J_final"]


def test_without_an_interval_of_its_own_each_evaluation_is_judged():
    gate, _ = make_gate("gate=true", "gate_interval=null", "updates=8")
    assert [bool(gate.judge(update)) for update in range(1, 9)] == [False, True] * 4


def test_without_a_gate_nothing_is_searched():
    gate, _ = make_gate("gate=false", "search.w=0.1", "search.loops=2")
    assert gate.judge(4) == {}
    assert gate.compared == 0


def test_a_search_leaves_out_what_the_QP_lacks():
    options = ("task.hessian=full", "search.H_u=0.1", "search.w=0.1", "search.loops=2")
    found = make_gate("gate=true", *options)[0].judge(4)
    assert "search/w" in found
    assert "search/H_u" not in found


def test_a_search_starts_from_the_policy_that_is_kept():
    gate, actor = make_gate("gate=true", "search.w=0.1", "search.loops=2")
    with torch.no_grad():
        actor.module.C.mul_(3.0)
    found = gate.judge(4)
    assert {"search/w", "search/accepted"} <= set(found)
    assert_close(actor.module.C.detach(), gate.kept.module.C.detach())


MODEL = (*SMALL, "gate=model", "replay_capacity=800", "warmup_steps=120", "optimizer=gauss_newton")


def test_with_models_the_plant_runs_no_closed_loop_of_a_comparison(tmp_path, monkeypatch):
    def forbidden(*_: Any) -> None:
        raise AssertionError

    monkeypatch.setattr("torch_qpmpc.experiment.gating.evaluate", forbidden)
    for name in ("point_mass",):
        cfg = make_config(*MODEL, f"task={name}", "search.w=0.5")
        summary = train.train(cfg, str(tmp_path / name))
        assert summary["modelled"] > 0
        assert "simulated" not in summary
        table = read_metrics(tmp_path / name)
        assert summary["modelled"] == 10 * 2 * table["gate/pairs"].sum()
        assert "search/w" not in table


def test_a_candidate_that_exploits_one_member_is_not_kept(monkeypatch):
    gate, actor = make_gate(*MODEL, "constraint=mpc", "updates=4", "task.eval_steps=20")
    cfg = make_config("start=data", "start.transitions=1000", "num_envs=20")
    physics = make_physics(cfg)
    right = run_ensemble(cfg, physics, None, collect_log(cfg, physics))
    wrong = replace(right[0], B=-right[0].B)  # actions act the other way

    def follow(policy: Any, member: ARXMember) -> None:
        scheme = replace(policy.module.scheme, model=Model(member.A, member.B))
        module = QPMPC(scheme, learn=policy.module.learned, structure="tied")
        policy.module.load_state_dict(module.state_dict())

    follow(gate.kept, right[1])
    follow(actor, wrong)
    for models, accepted in (([wrong, *right[1:]], 0), ([wrong] * 4, 1)):
        monkeypatch.setattr("torch_qpmpc.experiment.gating.run_ensemble", lambda *_, m=models: m)
        monkeypatch.setattr(gate, "_logged", list)
        verdict = gate.judge(2)
        assert verdict["gate/accepted"] == accepted
        assert (verdict["gate/mean"] < 0) == bool(accepted)


def test_a_candidate_is_rejected_where_no_ensemble_is_identified(monkeypatch):
    gate, _ = make_gate(*MODEL)
    still = arx_log(noise=0.1).apply(lambda x: 0 * x)
    monkeypatch.setattr(gate, "_logged", lambda: [still])
    monkeypatch.setattr(gate, "_physics", Store())
    with pytest.warns(UserWarning, match="gate=model rejects the candidate: stage_weight: got"):
        assert gate.judge(4) == {"gate/accepted": 0.0}
    assert gate.summary()["rejected"] == 1
