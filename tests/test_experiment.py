"""The parts of a run are what the configuration and the paper's experiment say."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from omegaconf import DictConfig

from tests.runs import SMALL, choices, make_config
from torch_qpmpc import QPActorValueOperator
from torch_qpmpc.banded import banded_matrix
from torch_qpmpc.envs import PointMass
from torch_qpmpc.evaluation import ClosedLoop
from torch_qpmpc.experiment import (
    evaluate,
    gap_summary,
    make_collector,
    make_mpc,
    make_optimizer,
    make_penalties,
    make_physics,
    make_true_mpc,
    report,
    table,
)
from torch_qpmpc.tracking import RunFolder


@pytest.mark.parametrize(("noise", "std"), [("gaussian", 0.01), ("brownian", 0.002)])
def test_physics_has_the_noise(noise, std):
    physics = make_physics(make_config(f"noise={noise}"))
    assert (physics.noise_kind, physics.std) == (noise, std)
    assert make_physics(make_config(f"noise={noise}", "noise.std=0")).std == 0


#: Undiscounted J before learning, by the seed of the corruption, and with the true model.
J_START = {1: 285, 2: 172, 3: 547, 4: 58, 5: 507}
J_TRUE_MODEL = 47


@pytest.mark.parametrize("seed", [1, 4])
def test_ends_of_the_experiment_are_the_known_ones(seed):
    """The numbers that everyone who draws, starts and rolls out alike gets."""
    cfg = make_config(f"seed={seed}", "solver=daqp")
    physics = make_physics(cfg)
    assert round(evaluate(cfg, make_mpc(cfg, physics), physics).J) == J_START[seed]
    assert round(evaluate(cfg, make_true_mpc(cfg, physics), physics).J) == J_TRUE_MODEL


def test_start_is_the_corrupted_model_and_a_random_cost():
    cfg, true = make_config("seed=3", "constraint=free"), PointMass()
    mpc = make_mpc(cfg, make_physics(cfg))
    rng = np.random.default_rng(3)
    A = true.A + torch.as_tensor(rng.uniform(-0.05, 0.05, (4, 4)))
    B = true.B + torch.as_tensor(rng.uniform(-0.05, 0.05, (4, 2)))
    theta = rng.uniform(0.5, 5, 4)
    assert torch.equal(mpc.C_0, banded_matrix(A, B, 10))
    assert torch.equal(mpc.C, mpc.C_0)
    torch.testing.assert_close(mpc.H, torch.as_tensor([*theta, 0, 0]))
    qp = mpc.quadratic_program()
    expected = torch.cat([0.9**k * mpc.H for k in range(10)] + [0.9**10 * torch.ones(4)])
    torch.testing.assert_close(qp.H.diagonal(), expected)
    assert torch.equal(qp.G, torch.eye(64, dtype=torch.float64))
    stage = torch.tensor([2, 2, 10, 10, 1, 1], dtype=torch.float64)
    assert torch.equal(qp.ub[:12], stage.repeat(2))
    assert torch.equal(qp.lb[:12], -stage.repeat(2))
    assert qp.w[:6].tolist() == [100.0] * 4 + [math.inf] * 2
    assert mpc.on_failure == "mask", "training goes on where a QP is not solved"


def test_true_model_has_the_true_cost_and_learns_nothing():
    cfg = make_config()
    physics = make_physics(cfg)
    mpc = make_true_mpc(cfg, physics)
    assert mpc.H.tolist() == [6, 6, 0.5, 0.5, 0, 0]
    assert torch.equal(mpc.C, banded_matrix(physics.A, physics.B, 10))
    assert list(mpc.parameters()) == []


def test_configuration_reaches_the_qp():
    cfg = make_config(
        "solver=daqp",
        "task.horizon=4",
        "task.gamma=0.5",
        "task.hessian=block",
        "task.learn_cost=[H,H_f,q]",
        "task.state_slack=7",
        "task.action_slack=3",
        "task.discount_slack=true",
        "constraint=free",
        "constraint.learn=[C,ub]",
    )
    mpc = make_mpc(cfg, make_physics(cfg))
    assert (mpc.horizon, mpc.gamma, mpc.hessian, mpc.solver) == (4, 0.5, "block", "daqp")
    assert set(mpc.learned) == {"H", "H_f", "q", "C", "ub"}
    w = mpc.quadratic_program().w
    assert w[:12].tolist() == [7.0] * 4 + [3.0] * 2 + [3.5] * 4 + [1.5] * 2


@pytest.mark.parametrize("constraint", choices("constraint"))
def test_penalties_by_case(constraint):
    cfg = make_config(f"constraint={constraint}", *SMALL)
    mpc = make_mpc(cfg, make_physics(cfg))
    deviation, si = make_penalties(cfg, mpc)
    assert (deviation is not None) == (constraint in ("deviation", "combined"))
    assert (si is not None) == (constraint in ("si", "combined"))
    assert ("C" in mpc.learned) == (constraint != "fixed")
    assert {"H", "c"} <= set(mpc.learned)
    if deviation is not None:
        assert deviation.C_mask.unique().tolist() == [0, 1e-4, 1]
        assert torch.equal(deviation.C_0, mpc.C_0)
    if si is not None:
        assert (si.beta, si.normalised) == (1e-6, False)


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


def test_collector_follows_the_policy_with_exploration():
    cfg = make_config(*SMALL, "num_envs=50", "steps_per_update=3", "seed=2")
    physics = make_physics(cfg)
    mpc = make_mpc(cfg, physics)

    def collect(cfg: DictConfig) -> Any:
        collector = make_collector(cfg, physics, QPActorValueOperator(mpc))
        torch.manual_seed(0)
        batches: list[Any] = [b.clone() for _, b in zip(range(6), collector, strict=False)]
        collector.shutdown()
        return torch.cat(batches, dim=1)

    data = collect(cfg)
    assert data.shape == (50, 18)
    assert data["step_count"].max() == 11, "episodes of 12 steps"
    best = mpc.policy(data["observation"]).detach()
    noise = (data["action"] - best)[best.abs() < 0.1]
    assert 0.25 < noise.std() < 0.35
    assert torch.equal(data["observation"], collect(cfg)["observation"])
    cfg.exploration_std = 0.0
    quiet = collect(cfg)
    assert torch.allclose(quiet["action"], mpc.policy(quiet["observation"]), atol=1e-6)
    cfg.seed = 3
    other = collect(cfg)
    assert not torch.equal(other["observation"][:, 0], quiet["observation"][:, 0])


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
    optimizer, schedule = make_optimizer(cfg, mpc)
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
    optimizer, _ = make_optimizer(cfg, make_mpc(cfg, make_physics(cfg)))
    assert optimizer.param_groups[0]["betas"] == (0.5, 0.75)


def test_evaluation_is_without_exploration_and_repeatable():
    cfg = make_config(*SMALL, "task.gamma=0.5")
    physics = make_physics(cfg)
    mpc = make_mpc(cfg, physics)
    first, second = evaluate(cfg, mpc, physics), evaluate(cfg, mpc, physics)
    assert first.states.shape == (13, 32, 4)
    assert torch.equal(first.states, second.states)
    torch.testing.assert_close(first.actions[0], mpc.policy(first.states[0]).detach())
    assert first.gamma == 0.5


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
    assert "no gap" in table(gap_summary(loops_with(50, 60, 50)))


def test_report_logs_the_evaluation(tmp_path):
    cfg = make_config(*SMALL, "constraint=free")
    physics = make_physics(cfg)
    mpc = make_mpc(cfg, physics)
    with torch.no_grad():
        mpc.C[0, -1] += 0.5
    loop = evaluate(cfg, mpc, physics)
    truth = evaluate(cfg, make_true_mpc(cfg, physics), physics)
    loops = {"start": loop, "true model": truth, "learned": loop}
    with RunFolder(tmp_path, cfg) as run:
        summary = report(run, mpc, loops, 20)
    assert summary == gap_summary(loops)
    (row,) = pd.read_csv(tmp_path / "metrics.csv").to_dict("records")
    expected = {"update": 20, "eval/J": loop.J, "eval/J_true_model": truth.J}
    expected |= {"eval/J_discounted": loop.J_discounted, "eval/closed_gap": summary["closed_gap"]}
    expected |= {"structure/on": 0, "structure/above": 0.5, "structure/below": 0}
    assert row == pytest.approx(expected, nan_ok=True)
