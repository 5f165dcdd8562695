"""The parts of a run match the configuration and the paper's experiment."""

from typing import Any

import pytest
import torch

from tests.runs import SMALL, choices, make_config
from torch_qpmpc import QPActorValueOperator, SolveLog
from torch_qpmpc.envs.closed_loop import closed_loop
from torch_qpmpc.experiment import algorithms
from torch_qpmpc.experiment.tasks import make_mpc, make_physics
from torch_qpmpc.learning.operators import POLICY_ACTIVE_SET

OTHERS = ("deviation.c_1=2", "deviation.c_2=0.5", "deviation.c_3=0.25", "si.beta=0.125")


@pytest.mark.parametrize(
    ("constraint", "others"),
    [*((name, ()) for name in choices("constraint")), ("combined", OTHERS)],
)
def test_a_case_has_its_penalties_with_their_weights(constraint, others):
    own = [f"constraint.{other}" for other in others]
    cfg = make_config(f"constraint={constraint}", *SMALL, *own)
    mpc = make_mpc(cfg, make_physics(cfg))
    penalties = algorithms.make_penalties(cfg, mpc)
    deviation, si = penalties.deviation, penalties.si
    assert (deviation is not None) == (constraint in ("deviation", "combined", "identified"))
    assert (si is not None) == (constraint in ("si", "combined", "identified"))
    assert ("C" in mpc.learned) == (constraint != "fixed")
    assert {"H", "c"} <= set(mpc.learned)
    if deviation is not None:
        weights = [0.25, 0.5, 2] if others else [0, 1e-4, 1]
        assert deviation.C_mask.unique().tolist() == weights
        assert torch.equal(deviation.C_0, mpc.C_0)
    if si is not None:
        assert si.beta == (0.125 if others else 1.0 if constraint == "identified" else 1e-6)


@pytest.mark.parametrize("name", ["adam", "sgd"])
def test_optimizer_has_two_rates_that_fall_linearly(name):
    betas = ["optimizer.betas=[0.5,0.75]"] if name == "adam" else []
    cfg = make_config(
        *SMALL,
        f"optimizer={name}",
        *betas,
        "optimizer.lr_cost=0.1",
        "optimizer.lr_constraints=0.01",
        "optimizer.final_fraction=0.2",
        "updates=8",
        "constraint=free",
        "constraint.learn=[C,ub]",
    )
    mpc = make_mpc(cfg, make_physics(cfg))
    learner = algorithms.make_learner(cfg, QPActorValueOperator(mpc))
    optimizer, scheduler = learner.optimizer, learner.scheduler
    assert optimizer.defaults.get("betas") == ((0.5, 0.75) if name == "adam" else None)
    assert type(optimizer).__name__.lower() == name
    rates = {"H": 0.1, "c": 0.1, "C": 0.01, "ub": 0.01}
    assert {g["name"]: g["lr"] for g in optimizer.param_groups} == rates
    grouped = [p for group in optimizer.param_groups for p in group["params"]]
    assert {id(p) for p in grouped} == {id(p) for p in mpc.parameters()}
    for update in range(1, 11):
        optimizer.step()
        scheduler.step()
        factor = 1 - 0.8 * min(update, 8) / 8
        for group in optimizer.param_groups:
            assert group["lr"] == pytest.approx(rates[group["name"]] * factor)


@pytest.mark.parametrize("task", ["point_mass", "gros_zanon", "pendulum"])
def test_the_evaluation_has_a_seed_of_its_own(task):
    """null selects the default seed of `closed_loop`."""

    physics: Any = make_physics(make_config(f"task={task}"))

    def policy(s: torch.Tensor) -> torch.Tensor:
        return -s[:, : len(physics.lb_a)]

    def costs(*overrides: str) -> torch.Tensor:
        cfg = make_config(f"task={task}", "task.eval_steps=3", *overrides)
        return algorithms.evaluate(cfg, policy, physics).costs

    assert not torch.equal(costs("eval_seed=4"), costs())
    assert torch.equal(costs("eval_seed=4"), costs("eval_seed=4", "seed=2"))
    assert torch.equal(costs("eval_seed=123"), costs())
    assert torch.equal(closed_loop(policy, physics, steps=3).costs, costs("eval_seed=null"))


NOISES = {"point_mass": "gaussian", "gros_zanon": "uniform", "pendulum": "none"}


@pytest.mark.parametrize("std", [0.3, 0.0])
@pytest.mark.parametrize("task", NOISES)
def test_a_collector_explores_about_the_policy_and_carries_active_sets(task, std):
    own = (f"task={task}", f"noise={NOISES[task]}", f"exploration_std={std}")
    cfg = make_config(*SMALL, *own, "num_envs=50", "steps_per_update=3")
    physics = make_physics(cfg)
    mpc = make_mpc(cfg, physics)
    policy = algorithms.make_operator(mpc).get_policy_operator(POLICY_ACTIVE_SET)
    collector: Any = algorithms.make_collector(cfg, physics, policy)
    torch.manual_seed(0)
    with SolveLog() as log:
        batches = [batch.clone() for batch, _ in zip(collector, range(6), strict=False)]
    collector.shutdown()
    data: Any = torch.cat(batches, dim=1)
    assert data.shape == (50, 18)
    assert POLICY_ACTIVE_SET not in {*data.keys(), *data["next"].keys()}
    assert log.recalled > 0.5 * log.solves
    best = mpc.policy(data["observation"]).detach()
    noise = (data["action"] - best)[best.abs() < 0.1]
    assert noise.std().item() == pytest.approx(std, rel=0.15, abs=1e-6)
