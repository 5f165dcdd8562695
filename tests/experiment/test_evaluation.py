"""The evaluation of a run: summary, rivals, and the same disturbances for all."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from torch import Tensor

from tests.runs import SMALL, make_config
from torch_qpmpc.envs import House
from torch_qpmpc.envs.closed_loop import plant_loop
from torch_qpmpc.experiment.algorithms import evaluate
from torch_qpmpc.experiment.evaluation import Evaluation, rival_costs
from torch_qpmpc.experiment.rivals.rival import Rival
from torch_qpmpc.experiment.tasks import TASKS, make_mpc, make_physics


def test_the_summary_has_each_J_the_gap_and_the_rivals():
    cfg = make_config(*SMALL, "rivals=false")
    physics = make_physics(cfg)
    mpc = make_mpc(cfg, physics)
    found = Evaluation.before(cfg, physics, mpc)
    assert found.loops["learned"] is found.loops["start"]
    found.evaluate(lambda s: -s[:, :2] - s[:, 2:])
    start, learned, true = (found.loops[n].J for n in ("start", "learned", "true model"))
    assert start == evaluate(cfg, mpc.policy, physics).J
    summary = found.summary()
    expected = {"J_start": start, "J_best": learned, "J_final": learned, "J_true_model": true}
    expected["closed_gap"] = (start - learned) / (start - true)
    assert {name: summary[name] for name in expected} == pytest.approx(expected)
    assert summary["J_discounted_best"] == found.loops["learned"].J_discounted
    assert summary["rivals"] == {}
    assert found.lines() == {"start": start, "true model": true}


@pytest.fixture
def rivals(monkeypatch) -> None:
    """Replace the room's rivals by proportional controls, one slow, one of a longer horizon."""

    def make(gain: float):
        def policy(p: Tensor) -> Tensor:
            assert p.shape[-1] in (4 * 4 + 1, 7 * 4 + 1)
            return gain * (18 - p[:, -1:])

        return lambda plant: policy

    named = {
        "weak": Rival(make(0.5)),
        "strong": Rival(make(5.0)),
        "far": Rival(make(5.0), sees={"horizon": 6}, slow=True),
    }
    monkeypatch.setitem(TASKS, "house", dataclasses.replace(TASKS["house"], rivals=named))


HOUSE = ("task=house", "task.horizon=3", "task.eval_steps=6")


@pytest.mark.parametrize(
    ("chosen", "names"),
    [("true", ["weak", "strong"]), ("false", []), ("[far,strong]", ["far", "strong"])],
)
def test_quick_rivals_are_evaluated_or_those_that_are_named(rivals, chosen, names):
    cfg = make_config(*HOUSE, f"rivals={chosen}")
    assert list(rival_costs(cfg, make_physics(cfg))) == names


def test_rivals_have_the_disturbances_of_the_learned_policy(rivals):
    cfg = make_config(*HOUSE, "rivals=[far,strong]", "eval_seed=4")
    plant = make_physics(cfg)
    assert isinstance(plant, House)
    J = rival_costs(cfg, plant)
    loop = plant_loop(lambda p: 5 * (18 - p[:, -1:]), plant, steps=6, seed=4)
    assert {"strong": loop.J, "far": pytest.approx(loop.J)} == J
    assert torch.equal(evaluate(cfg, lambda p: 5 * (18 - p[:, -1:]), plant).costs, loop.costs)
