"""The parts of a run are what the configuration and the paper's experiment say."""

from __future__ import annotations

import math
from typing import Any

import pandas as pd
import pytest
import torch

from tests.runs import SMALL, choices, linear_system, make_config, true_mpc
from torch_qpmpc import QPActorValueOperator
from torch_qpmpc.analysis.report import structure_metrics
from torch_qpmpc.envs.closed_loop import ClosedLoop, closed_loop, gymnasium_loop
from torch_qpmpc.experiment.algorithms import (
    evaluate,
    gap_summary,
    make_learner,
    make_optimizer,
    make_penalties,
    report,
    structure_summary,
    table,
    theta_metrics,
)
from torch_qpmpc.experiment.run_folder import RunFolder
from torch_qpmpc.experiment.tasks import make_mpc, make_physics, true_model
from torch_qpmpc.mpc.banded import banded_matrix


@pytest.mark.parametrize("constraint", choices("constraint"))
def test_penalties_by_case(constraint):
    cfg = make_config(f"constraint={constraint}", *SMALL)
    mpc = make_mpc(cfg, make_physics(cfg))
    deviation, si = make_penalties(cfg, mpc)
    assert (deviation is not None) == (constraint in ("deviation", "combined", "identified"))
    assert (si is not None) == (constraint in ("si", "combined", "identified"))
    assert ("C" in mpc.learned) == (constraint != "fixed")
    assert {"H", "c"} <= set(mpc.learned)
    if deviation is not None:
        assert deviation.C_mask.unique().tolist() == [0, 1e-4, 1]
        assert torch.equal(deviation.C_0, mpc.C_0)
    if si is not None:
        assert (si.beta, si.normalised) == (1.0 if constraint == "identified" else 1e-6, False)


def test_penalties_have_the_configured_weights():
    overrides = ("deviation.c_1=2", "deviation.c_2=0.5", "deviation.c_3=0.25", "deviation.growth=1")
    more = ("si.beta=0.125", "si.normalised=true")
    names = [f"constraint.{name}" for name in (*overrides, *more)]
    cfg = make_config("constraint=combined", *SMALL, *names)
    deviation, si = make_penalties(cfg, make_mpc(cfg, make_physics(cfg)))
    assert deviation is not None
    assert deviation.C_mask.unique().tolist() == [0.25, 0.5, 2, 4]
    assert si is not None
    assert (si.beta, si.normalised) == (0.125, True)


@pytest.mark.parametrize("name", ["adam", "sgd"])
def test_optimizer_has_two_rates_that_fall_linearly(name):
    cfg = make_config(
        *SMALL,
        f"optimizer={name}",
        "optimizer.lr_cost=0.1",
        "optimizer.lr_constraints=0.01",
        "optimizer.final_fraction=0.2",
        "updates=8",
        "constraint=free",
        "constraint.learn=[C,ub]",
    )
    mpc = make_mpc(cfg, make_physics(cfg))
    learner = make_learner(cfg, QPActorValueOperator(mpc), make_physics(cfg))
    optimizer, schedule = learner.optimizer, learner.schedule
    assert type(optimizer).__name__.lower() == name
    rates = {"H": 0.1, "c": 0.1, "C": 0.01, "ub": 0.01}
    assert {g["name"]: g["lr"] for g in optimizer.param_groups} == rates
    grouped = [p for group in optimizer.param_groups for p in group["params"]]
    assert {id(p) for p in grouped} == {id(p) for p in mpc.parameters()}
    for update in range(1, 11):
        optimizer.step()
        schedule.step()
        factor = 1 - 0.8 * min(update, 8) / 8
        for group in optimizer.param_groups:
            assert group["lr"] == pytest.approx(rates[group["name"]] * factor)


def test_optimizer_options():
    cfg = make_config(*SMALL, "optimizer=adam", "optimizer.betas=[0.5,0.75]")
    optimizer = make_optimizer(cfg, make_mpc(cfg, make_physics(cfg)))
    assert optimizer.param_groups[0]["betas"] == (0.5, 0.75)


def test_evaluation_is_without_exploration_and_repeatable():
    cfg = make_config(*SMALL, "task.gamma=0.5", "task.eval_steps=12")
    physics = linear_system(cfg)
    mpc = make_mpc(cfg, physics)
    first, second = evaluate(cfg, mpc.policy, physics), evaluate(cfg, mpc.policy, physics)
    assert first.states.shape == (13, 32, 4)
    assert torch.equal(first.states, second.states)
    torch.testing.assert_close(first.actions[0], mpc.policy(first.states[0]).detach())
    assert first.gamma == 0.5


@pytest.mark.parametrize("task", ["point_mass", "gros_zanon", "pendulum"])
def test_the_evaluation_has_a_seed_of_its_own(task):
    """null is the seed that `closed_loop` has by default."""

    physics: Any = make_physics(make_config(f"task={task}"))

    def policy(s: torch.Tensor) -> torch.Tensor:
        return -s[:, : len(physics.lb_a)]

    def costs(*overrides: str) -> torch.Tensor:
        cfg = make_config(f"task={task}", "task.eval_steps=3", *overrides)
        return evaluate(cfg, policy, physics).costs

    assert not torch.equal(costs("eval_seed=4"), costs())
    assert torch.equal(costs("eval_seed=4"), costs("eval_seed=4", "seed=2"))
    assert torch.equal(costs("eval_seed=123"), costs())
    loop = gymnasium_loop if task == "pendulum" else closed_loop
    assert torch.equal(loop(policy, physics, steps=3).costs, costs("eval_seed=null"))


def loops_with(start: float, learned: float, true: float) -> dict[str, ClosedLoop]:
    """Two steps of two starts whose costs add up to J; the second step counts 0.9."""

    def loop(J: float) -> ClosedLoop:
        costs = torch.full((2, 2), J / 2, dtype=torch.float64)
        return ClosedLoop(torch.zeros(3, 2, 4), torch.zeros(2, 2, 2), costs, 0.9)

    return {"start": loop(start), "learned": loop(learned), "true model": loop(true)}


def test_gap_summary():
    summary = gap_summary(loops_with(100, 60, 50))
    expected = {"J_start": 100, "J_final": 60, "J_true_model": 50, "closed_gap": 0.8}
    expected |= {"J_discounted_start": 95, "J_discounted_final": 57}
    expected |= {"J_discounted_true_model": 47.5, "closed_gap_discounted": 0.8}
    assert summary == pytest.approx(expected)


def test_table():
    lines = table(gap_summary(loops_with(100, 60, 50))).splitlines()
    assert lines[0].split() == ["start", "learned", "true", "model", "closed", "gap"]
    assert lines[1].split() == ["J", "100.0", "60.0", "50.0", "0.800"]
    assert lines[2].split() == ["J", "discounted", "95.0", "57.0", "47.5", "0.800"]


@pytest.mark.parametrize(
    ("ends", "J", "discounted"),
    [
        ((50, 60, 50), "no gap; J rose by 10.0", "no gap; J discounted rose by 9.5"),
        ((48, 40, 50), "no gap; J fell by 8.0", "no gap; J discounted fell by 7.6"),
        ((50, 50, 50), "no gap; J did not change", "no gap; J discounted did not change"),
        (
            (50, 60, math.nan),
            "no true model; J rose by 10.0",
            "no true model; J discounted rose by 9.5",
        ),
        (
            (50, math.inf, 50),
            "no gap; J went from 50.0 to inf",
            "no gap; J discounted went from 47.5 to inf",
        ),
    ],
)
def test_table_says_how_J_changed_where_there_is_no_gap(ends, J, discounted):
    lines = table(gap_summary(loops_with(*ends))).splitlines()
    assert lines[1].endswith(f"  {J}")
    assert lines[2].endswith(f"  {discounted}")


def test_the_numbers_of_theta_are_logged_where_they_are_few():
    cfg = make_config("task=gros_zanon", "solver=daqp")
    metrics = theta_metrics(make_mpc(cfg, make_physics(cfg)))
    expected = {"theta/c": 0.0, "theta/A_1": 0.25, "theta/B_0": 0.0312, "theta/ub_0": 2.0}
    assert {name: metrics[name] for name in expected} == pytest.approx(expected)
    parts = {"A": 4, "B": 2, "b": 2, "q": 5, "lb": 3, "ub": 3}
    names = {f"theta/{part}_{i}" for part, count in parts.items() for i in range(count)}
    assert set(metrics) == names | {"theta/c"}
    free = make_config("constraint=free")
    names = {f"theta/H_{i}" for i in range(6)} | {"theta/c"}
    assert set(theta_metrics(make_mpc(free, make_physics(free)))) == names


def test_structure_summary_tells_the_models_error_before_and_after():
    cfg = make_config(*SMALL, "constraint=free")
    physics = linear_system(cfg)
    mpc = make_mpc(cfg, physics)
    truth = true_model(physics)
    assert truth is not None
    A, B, offset = truth
    before = (mpc.C_0[:4, :6] - torch.cat((A, B), dim=1)).norm().item()
    expected = {"canonical_distance": 0, "model_error": before, "model_error_start": before}
    assert structure_summary(mpc, (A, B, offset)) == pytest.approx(expected, abs=1e-9)
    with torch.no_grad():
        mpc.C.copy_(2 * banded_matrix(A, B, cfg.task.horizon))
    after = expected | {"model_error": 0}
    assert structure_summary(mpc, (A, B, offset)) == pytest.approx(after, abs=1e-9)


def test_a_run_whose_C_cannot_be_read_goes_on():
    cfg = make_config(*SMALL, "constraint=free")
    physics = linear_system(cfg)
    mpc = make_mpc(cfg, physics)
    with torch.no_grad():
        mpc.C.zero_()
    summary = structure_summary(mpc, true_model(physics))
    assert math.isnan(summary["canonical_distance"])
    assert math.isnan(summary["model_error"])
    assert summary["model_error_start"] > 0


def test_report_logs_the_evaluation(tmp_path):
    cfg = make_config(*SMALL, "constraint=free")
    physics = linear_system(cfg)
    mpc = make_mpc(cfg, physics)
    with torch.no_grad():
        mpc.C[0, -1] += 0.5
    loop = evaluate(cfg, mpc.policy, physics)
    truth = evaluate(cfg, true_mpc(cfg, physics).policy, physics)
    loops = {"start": loop, "true model": truth, "learned": loop}
    with RunFolder(tmp_path, cfg) as run:
        summary = report(run, mpc, loops, 20)
    assert summary == gap_summary(loops)
    (row,) = pd.read_csv(tmp_path / "metrics.csv").to_dict("records")
    expected = {"update": 20, "eval/J": loop.J, "eval/J_true_model": truth.J}
    expected |= {"eval/J_discounted": loop.J_discounted, "eval/closed_gap": summary["closed_gap"]}
    expected |= {"structure/on": 0, "structure/above": 0.5, "structure/below": 0}
    expected |= {f"structure/{name}": value for name, value in structure_metrics(mpc).items()}
    assert row["structure/causality_defect"] > 0.01
    assert row == pytest.approx(expected, nan_ok=True)
