"""The Q-learning loss where a QP has no certified solution."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from tests.transitions import METADATA, TRACE, make_batch, make_loss, make_operator
from torch_qpmpc import QPActorValueOperator, QPQLearningLoss


def hard_operator() -> QPActorValueOperator:
    """States are hard, so that a start outside their bounds is infeasible."""
    return make_operator(state_slack=torch.inf, learn=("H", "c", "C"))


def feasible_batch(count: int) -> TensorDict:
    td = make_batch(count)
    parts: list[Any] = [td, td["next"]]
    for where in parts:
        where["observation"] *= 0.3
    td["action"] *= 0.3
    td["next", "terminated"] = torch.zeros(count, 1, dtype=torch.bool)
    return td


def gradients(loss: QPQLearningLoss, td: TensorDictBase) -> tuple[TensorDictBase, list[Tensor]]:
    out = loss(td)
    result = torch.autograd.grad(out["loss_value"], list(loss.parameters()))
    return out, list(result)


@pytest.mark.parametrize("bad", [5.0, torch.nan, torch.inf])
@pytest.mark.parametrize("where", ["observation", "action", ("next", "observation")])
def test_unsolved_samples_are_masked(where, bad):
    operator, td = hard_operator(), feasible_batch(6)
    mean = make_loss(operator=operator)
    solved = td[torch.tensor([0, 1, 3, 4, 5])]
    expected, step = gradients(make_loss(operator=operator, reduction="sum"), solved)
    td[where][2] = bad
    out, total = gradients(make_loss(operator=operator, reduction="sum"), td)
    assert out["unsolved"].item() == 1
    torch.testing.assert_close(out["loss_value"], expected["loss_value"])
    for gradient, other in zip(total, step, strict=True):
        assert other.norm() > 0
        torch.testing.assert_close(gradient, other)
    for key in METADATA:
        torch.testing.assert_close(out[key], expected[key], msg=key)
    assert td["td_error"][2] == 0
    assert td["td_error"].isfinite().all()
    # In the mean it counts as a sample without an error: alpha keeps its meaning.
    torch.testing.assert_close(mean(td)["loss_value"], expected["loss_value"] / 6)


def test_a_batch_without_any_solved_sample():
    operator, td = hard_operator(), feasible_batch(3)
    td["observation"] += 5.0
    out, total = gradients(make_loss(operator=operator), td)
    assert out["unsolved"].item() == 3
    assert all(out[key].item() == 0 for key in ("loss_value", *METADATA))
    assert all(torch.equal(g, torch.zeros_like(g)) for g in total)


@pytest.mark.parametrize("estimator", TRACE)
def test_an_unsolved_value_after_termination_is_not_needed(estimator):
    """The target is -L alone, so the sample counts whatever the state after the end is."""
    operator = hard_operator()
    td = feasible_batch(4)
    td["next", "done"] = torch.tensor([[False], [True], [False], [True]])
    td["next", "terminated"] = td["next", "done"].clone()
    expected = make_loss(estimator, operator, reduction="none")(td.clone())
    td["next", "observation"][1] = 5.0
    td["next", "observation"][3] = torch.nan
    out = make_loss(estimator, operator, reduction="none")(td)
    assert out["unsolved"].item() == 0
    assert torch.equal(out["loss_value"], expected["loss_value"])
    Q = operator.module.action_value(td["observation"], td["action"])
    delta = -td["next", "reward"].squeeze(-1) - Q
    torch.testing.assert_close(out["loss_value"][[1, 3]], 0.5 * delta[[1, 3]] ** 2)
    td["next", "terminated"][1] = False  # truncated instead: now its value matters
    assert make_loss(estimator, operator)(td)["unsolved"].item() >= 1


@pytest.mark.parametrize("estimator", ["td1", "tdlambda"])
def test_an_unsolved_value_spoils_only_the_returns_that_contain_it(estimator):
    operator = hard_operator()
    td = make_batch(3, 6)
    parts: list[Any] = [td, td["next"]]
    for part in parts:
        part["observation"] *= 0.3
    td["action"] *= 0.3
    td["next", "terminated"] = torch.zeros(3, 6, 1, dtype=torch.bool)
    td["next", "done"] = torch.zeros(3, 6, 1, dtype=torch.bool)
    td["next", "done"][0, 1] = True
    expected = make_loss(estimator, operator, reduction="none")(td.clone())["loss_value"]
    td["next", "observation"][0, 3] = 5.0
    out = make_loss(estimator, operator, reduction="none")(td)
    spoilt = torch.zeros(3, 6, dtype=torch.bool)
    spoilt[0, [2, 3]] = True  # it, and the step before it in its episode
    kept = out["loss_value"][~spoilt]
    torch.testing.assert_close(kept, expected[~spoilt])
    assert out["loss_value"].isfinite().all()


def test_without_masking_an_unsolved_qp_raises():
    operator = make_operator(state_slack=torch.inf, on_failure="raise")
    td = feasible_batch(3)
    td["observation"][0] = 5.0
    with pytest.raises(RuntimeError, match="1 of 3 QPs have no certified solution"):
        make_loss(operator=operator)(td)
