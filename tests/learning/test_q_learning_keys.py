"""The Q-learning loss under renamed keys, and without a TensorDict."""

from typing import Any

import pytest
import torch
from tensordict import TensorDict

from tests.transitions import GAMMA, TRACE, make_batch, make_operator
from torch_qpmpc import QPActorValueOperator, QPQLearningLoss


def unravel_keys(key: Any) -> tuple[str, ...]:
    return (key,) if isinstance(key, str) else key


def test_keys_that_are_renamed_late_reach_the_estimator():
    loss = QPQLearningLoss(make_operator({"state_value_key": "value_2"}))  # it writes this key
    loss.set_keys(value="value_2")
    loss.make_value_estimator("td0")
    names = ("advantage", "value_target", "reward", "done", "terminated")
    loss.set_keys(**{name: f"{name}_2" for name in names})
    keys = loss.value_estimator.tensor_keys
    assert [getattr(keys, name) for name in names] == [f"{name}_2" for name in names]
    assert ("next", "reward_2") in loss.in_keys
    assert ("next", "reward") not in loss.in_keys


RENAMED = {
    "observation": ("agent", "state"),
    "action": ("agent", "force"),
    "state_value": "minus_V",
    "state_action_value": ("critic", "minus_Q"),
    "reward": ("agent", "minus_L"),
    "done": "over",
    "terminated": ("flags", "failed"),
    "priority": ("replay", "priority"),
}


def make_renamed(estimator: str) -> tuple[QPQLearningLoss, QPQLearningLoss, TensorDict, TensorDict]:
    """Make the same loss and batch with default keys and with renamed, nested ones."""
    names = ("observation", "action", "state_value", "state_action_value")
    operator = make_operator()
    renamed = QPActorValueOperator(
        operator.module, **{f"{name}_key": RENAMED[name] for name in names}
    )
    loss, other = QPQLearningLoss(operator), QPQLearningLoss(renamed)
    other.set_keys(
        value=RENAMED["state_value"],
        **{k: RENAMED[k] for k in ("state_action_value", "action", "reward", "done")},
        **{k: RENAMED[k] for k in ("terminated", "priority")},
    )
    for module in (loss, other):
        module.make_value_estimator(estimator, gamma=GAMMA)
    td = make_batch(3, 4)
    new = TensorDict({}, batch_size=td.batch_size)
    for name in ("observation", "action"):
        new[RENAMED[name]] = td[name]
    for name in ("observation", "reward", "done", "terminated"):
        key = RENAMED[name]
        new[("next", *unravel_keys(key))] = td["next", name]
    return loss, other, td, new


@pytest.mark.parametrize("estimator", TRACE)
def test_renamed_and_nested_keys(estimator):
    loss, other, td, new = make_renamed(estimator)
    out = other(new)
    assert torch.equal(out["loss_value"], loss(td)["loss_value"])
    assert torch.equal(new["replay", "priority"], td["td_error"])
    assert "td_error" not in set(new.keys())


def test_dispatch_without_a_tensordict():
    loss, other, td, new = make_renamed("td0")
    out = loss(td.clone())
    arguments = {
        "observation": td["observation"],
        "action": td["action"],
        "next_observation": td["next", "observation"],
        "next_reward": td["next", "reward"],
        "next_done": td["next", "done"],
        "next_terminated": td["next", "terminated"],
    }
    assert {"_".join(unravel_keys(key)) for key in loss.in_keys} == set(arguments)
    results = loss(**arguments)
    assert len(results) == len(loss.out_keys) == 8
    for key, value in zip(loss.out_keys, results, strict=True):
        assert torch.equal(value, out[key]), key

    renamed = {"_".join(unravel_keys(key)): new[key] for key in other.in_keys}
    assert "next_agent_minus_L" in renamed
    assert torch.equal(other(**renamed)[0], out["loss_value"])
    loss.select_out_keys("loss_value")
    assert torch.equal(loss(**arguments), out["loss_value"])
