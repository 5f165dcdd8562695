"""The Q-learning loss where a QP has no certified solution."""

from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from tests.transitions import METADATA, TRACE, make_batch, make_loss, make_operator
from torch_qpmpc import QPActorValueOperator, QPQLearningLoss


def hard_operator() -> QPActorValueOperator:
    """Make an operator with hard states: a start outside their bounds is infeasible."""
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
    # In the mean it counts with zero error, so that alpha keeps its meaning.
    torch.testing.assert_close(mean(td)["loss_value"], expected["loss_value"] / 6)


@pytest.mark.parametrize("estimator", TRACE)
def test_an_unsolved_value_after_termination_is_not_needed(estimator):
    """The target is -L alone, so the sample counts for any state after the end."""
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
    td["next", "terminated"][1] = False  # truncated instead, so that its value is needed
    assert make_loss(estimator, operator)(td)["unsolved"].item() >= 1


def test_without_masking_an_unsolved_qp_raises():
    operator = make_operator(state_slack=torch.inf, on_failure="raise")
    td = feasible_batch(3)
    td["observation"][0] = 5.0
    with pytest.raises(RuntimeError, match="1 of 3 QPs have no certified solution"):
        make_loss(operator=operator)(td)


def test_ctrl_c_reaches_the_caller_and_leaves_theta_in_its_place(monkeypatch):
    operator, td = hard_operator(), feasible_batch(3)
    loss = make_loss(operator=operator)
    before, theta = loss(td.clone())["loss_value"], [*operator.parameters()]

    def stopped(*_: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(QPActorValueOperator, "forward", stopped)
        with pytest.raises(KeyboardInterrupt):
            loss(td.clone())
    assert all(x is y for x, y in zip(operator.parameters(), theta, strict=True))
    assert torch.equal(loss(td.clone())["loss_value"], before)


@pytest.mark.parametrize("bad", [torch.nan, torch.inf, -torch.inf])
@pytest.mark.parametrize("reduction", ["sum", "mean"])
def test_invalid_rewards_are_left_out_and_counted(bad, reduction):
    operator, td = hard_operator(), feasible_batch(6)
    solved = td[torch.tensor([0, 1, 3, 5])]
    expected, step = gradients(make_loss(operator=operator, reduction="sum"), solved)
    td["next", "reward"][2] = bad
    td["next", "observation"][4] = 5.0  # and one without a solution
    loss = make_loss(operator=operator, reduction=reduction)
    message = r"\('next', 'reward'\): 1 of 6 rewards are NaN or infinite\. Those transitions are"
    with pytest.warns(RuntimeWarning, match=message) as caught:
        out, total = gradients(loss, td)
    assert len(caught) == 1
    assert (out["invalid_reward"].item(), out["unsolved"].item()) == (1, 1)
    count = 6 if reduction == "mean" else 1
    torch.testing.assert_close(out["loss_value"], expected["loss_value"] / count)
    for gradient, other in zip(total, step, strict=True):
        torch.testing.assert_close(gradient, other / count)
    for key in METADATA:
        torch.testing.assert_close(out[key], expected[key], msg=key)
    assert td["td_error"][2] == 0


@pytest.mark.parametrize("estimator", ["td1", "tdlambda"])
def test_an_invalid_reward_spoils_only_the_returns_that_contain_it(estimator):
    operator, td = hard_operator(), make_batch(2, 6)
    parts: list[Any] = [td, td["next"]]
    for part in parts:
        part["observation"] *= 0.3
    td["action"] *= 0.3
    td["next", "terminated"] = td["next", "done"] = torch.zeros(2, 6, 1, dtype=torch.bool)
    td["next", "done"][0, 1] = True
    expected = make_loss(estimator, operator, reduction="none")(td.clone())["loss_value"]
    td["next", "reward"][0, 3], td["next", "observation"][0, 5] = torch.inf, 5.0
    loss = make_loss(estimator, operator, reduction="none")
    with pytest.warns(RuntimeWarning, match="1 of 12 rewards"):
        out = loss(td)
    with pytest.warns(RuntimeWarning, match="1 of 12 rewards"):
        target = loss.target(td)
    invalid, unsolved = torch.zeros(2, 2, 6, dtype=torch.bool)
    invalid[0, [2, 3]] = True  # it, and the step before it in its episode
    unsolved[0, [4, 5]] = True
    assert torch.equal(target.isnan(), invalid)
    assert torch.equal(target == -torch.inf, unsolved)
    assert (out["invalid_reward"].item(), out["unsolved"].item()) == (2, 2)
    kept = ~(invalid | unsolved)
    torch.testing.assert_close(out["loss_value"][kept], expected[kept])
    assert (out["loss_value"][~kept] == 0).all()
