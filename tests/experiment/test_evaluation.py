"""The evaluation of a run: summary, rivals, and the same disturbances for all."""

import dataclasses

import pytest
import torch

from tests.runs import SMALL, make_config
from torch_qpmpc.envs import GymnasiumPlant, Plant
from torch_qpmpc.envs.closed_loop import closed_loop
from torch_qpmpc.experiment.algorithms import evaluate
from torch_qpmpc.experiment.evaluation import Evaluation
from torch_qpmpc.experiment.rivals import ZERO_ACTION, Policy, zero_action
from torch_qpmpc.experiment.tasks import TASKS, make_mpc, make_physics, register


def test_the_summary_has_each_J_the_gap_and_the_rivals():
    cfg = make_config(*SMALL)
    physics = make_physics(cfg)
    mpc = make_mpc(cfg, physics)
    found = Evaluation.before(cfg, physics, mpc)
    assert found.loops["learned"] is found.loops["start"]
    found.evaluate(lambda s: -s[:, :2] - s[:, 2:])
    start, learned, true = (found.loops[n].J for n in ("start", "learned", "true model"))
    assert start == pytest.approx(evaluate(cfg, mpc.policy, physics).J, rel=1e-9)
    summary = found.summary()
    expected = {"J_start": start, "J_best": learned, "J_final": learned, "J_true_model": true}
    expected["closed_gap"] = (start - learned) / (start - true)
    assert {name: summary[name] for name in expected} == pytest.approx(expected)
    assert summary["J_discounted_best"] == found.loops["learned"].discounted(0.9)
    assert summary["rivals"] == {}


def rivals_of(cfg, plant):
    return Evaluation.before(cfg, plant, make_mpc(cfg, plant)).rivals


def proportional(gain: float) -> Policy:
    return lambda p: gain * (1.5 - p[:, -1:])


@pytest.fixture
def rivals(store_task) -> None:
    named = {"weak": lambda _: proportional(0.5), "strong": lambda _: proportional(5.0)}
    register(dataclasses.replace(TASKS["store"], rivals=named))


STORE = ("task=store", "task.eval_steps=6")


@pytest.mark.parametrize(
    ("chosen", "names"), [("true", ["weak", "strong"]), ("false", []), ("[strong]", ["strong"])]
)
def test_all_rivals_are_evaluated_or_those_that_are_named(rivals, chosen, names):
    cfg = make_config(*STORE, f"rivals={chosen}")
    assert list(rivals_of(cfg, make_physics(cfg))) == names


def test_zero_action_is_the_action_within_the_bounds_nearest_to_zero():
    settings = ("task=pendulum", "noise=none", "rivals=true")
    cfg = make_config(*SMALL, *settings)
    plant = make_physics(cfg)
    assert isinstance(plant, GymnasiumPlant)
    loop = closed_loop(lambda s: torch.zeros(len(s), 1), plant, steps=10)
    assert rivals_of(cfg, plant) == {ZERO_ACTION: loop.J}
    plant.lb_a = plant.lb_a + 3.0
    assert zero_action(plant)(torch.zeros(2, 3)).tolist() == [[1.0], [1.0]]


def test_rivals_have_the_disturbances_of_the_learned_policy(rivals):
    cfg = make_config(*STORE, "rivals=[strong]", "eval_seed=4")
    plant = make_physics(cfg)
    assert isinstance(plant, Plant)
    loop = closed_loop(proportional(5.0), plant, steps=6, seed=4)
    assert rivals_of(cfg, plant) == {"strong": loop.J}
    assert torch.equal(evaluate(cfg, proportional(5.0), plant).costs, loop.costs)
