"""The Q-learning loss: its values, its gradients, and the paper's update."""

import copy
import math
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import MultiStep
from torchrl.envs.utils import ExplorationType, exploration_type, set_exploration_type
from torchrl.objectives import SoftUpdate

from tests.transitions import (
    GAMMA,
    LEARN,
    METADATA,
    TRACE,
    hand_prediction,
    hand_target,
    learned_leaves,
    make_batch,
    make_loss,
    make_operator,
    perturb,
)
from torch_qpmpc import QPMPC, QPActorValueOperator, QPQLearningLoss
from torch_qpmpc.learning.td_error import inverse_variance


@pytest.mark.parametrize("delay_value", [False, True])
@pytest.mark.parametrize("estimator", TRACE)
def test_loss_and_its_gradients(estimator, delay_value):
    operator = make_operator()
    start = copy.deepcopy(operator.module)
    loss = make_loss(estimator, operator, delay_value=delay_value, reduction="none")
    if delay_value:
        SoftUpdate(loss, tau=0.1)
    perturb(loss)
    td = make_batch(6, 5)
    before = td.clone()

    out = loss(td)
    target = hand_target(start if delay_value else operator.module, td, TRACE[estimator])
    delta = target - hand_prediction(operator.module, td)
    torch.testing.assert_close(out["loss_value"], 0.5 * delta**2, atol=1e-9, rtol=0)
    torch.testing.assert_close(td["td_error"], delta.detach() ** 2, atol=1e-9, rtol=0)
    assert (td.exclude("td_error") == before).all(), "the input but for the priority"
    assert set(td.keys(True, True)) == {*before.keys(True, True), "td_error"}

    out["loss_value"].mean().backward()
    leaves = learned_leaves(loss)
    assert len(leaves) == len(LEARN)
    for key, leaf in leaves.items():
        assert leaf.grad is not None, key
        assert leaf.grad.isfinite().all(), key
        assert leaf.grad.norm() > 0, key
    for key, frozen in loss.target_value_network_params.items(True, True):
        online = loss.value_network_params.get(key)
        assert not frozen.requires_grad
        assert frozen.grad is None
        if isinstance(online, torch.nn.Parameter):
            assert torch.equal(frozen, online) != delay_value
            assert (frozen.data_ptr() == online.data_ptr()) != delay_value


def test_priority_weights():
    td = make_batch(6)
    none = make_loss(reduction="none")(td)["loss_value"]
    td["priority_weight"] = weight = torch.arange(1.0, 7.0)
    for use in ("auto", True):
        loss = make_loss(use_prioritized_weights=use)
        expected = (weight * none).sum() / weight.sum()
        torch.testing.assert_close(loss(td)["loss_value"], expected)
        assert ("priority_weight" in loss.in_keys) == (use is True)
    torch.testing.assert_close(make_loss(reduction="sum")(td)["loss_value"], (weight * none).sum())
    unweighted = make_loss(use_prioritized_weights=False)(td)["loss_value"]
    torch.testing.assert_close(unweighted, none.mean())


def test_cast_to_float32():
    loss, td = make_loss(), make_batch(6)
    expected = loss(td.clone())["loss_value"].item()
    loss = loss.to(torch.float32)
    assert {p.dtype for p in loss.parameters()} == {torch.float32}
    out = loss(make_batch(6, dtype=torch.float32))["loss_value"]
    assert out.dtype == torch.float32
    assert out.item() == pytest.approx(expected, rel=1e-4)
    out.backward()
    assert all(p.grad is not None and p.grad.dtype == p.dtype for p in loss.parameters())


def test_metadata_are_detached_scalars():
    operator, td = make_operator(), make_batch(6)
    out = make_loss(operator=operator)(td)
    assert set(out.keys()) == {"loss_value", "unsolved", "invalid_reward", *METADATA}
    assert out["loss_value"].requires_grad
    target = hand_target(operator.module, td, 0.0)
    prediction = hand_prediction(operator.module, td).detach()
    expected = {
        "td_error": (target - prediction).abs().mean(),
        "pred_value": prediction.mean(),
        "target_value": target.mean(),
        "pred_value_max": prediction.max(),
        "target_value_max": target.max(),
        "unsolved": torch.tensor(0),
        "invalid_reward": torch.tensor(0),
    }
    for key, value in expected.items():
        assert not out[key].requires_grad
        assert out[key].shape == ()
        torch.testing.assert_close(out[key], value, atol=1e-9, rtol=0)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:torch._dynamo.config.inline_inbuilt:FutureWarning")
def test_compiled_without_graph_breaks():
    loss = make_loss(reduction="none")
    compiled = torch.compile(loss, fullgraph=True, backend="eager")
    for invalid in (0, 1):
        first, second = make_batch(6, seed=invalid), make_batch(6, seed=invalid)
        for batch in (first, second):
            batch["next", "reward"][:invalid] = torch.nan
        expected = loss(first)
        assert expected["invalid_reward"] == invalid
        expected["loss_value"].mean().backward()
        gradients = [p.grad for p in loss.parameters()]
        loss.zero_grad(set_to_none=True)
        out = compiled(second)
        out["loss_value"].mean().backward()
        for key in loss.out_keys:
            torch.testing.assert_close(out[key], expected[key])
        torch.testing.assert_close(second["td_error"], first["td_error"])
        for parameter, gradient in zip(loss.parameters(), gradients, strict=True):
            torch.testing.assert_close(parameter.grad, gradient)
        loss.zero_grad()


def expected_step(mpc: QPMPC, td: TensorDictBase, clip: float = math.inf) -> list[Tensor]:
    L = -td["next", "reward"].squeeze(-1)
    go_on = 1 - td["next", "terminated"].squeeze(-1).double()
    V, Q = mpc.value(td["next", "observation"]), mpc.action_value(td["observation"], td["action"])
    delta = (L + GAMMA * go_on * V - Q).detach().clamp(-clip, clip)
    parameters = list(mpc.parameters())
    total = [torch.zeros_like(p) for p in parameters]
    for i in range(len(Q)):
        gradients = torch.autograd.grad(Q[i], parameters, retain_graph=True)
        for sum_, gradient in zip(total, gradients, strict=True):
            sum_ += delta[i] * gradient / len(Q)
    return total


@pytest.mark.parametrize("clip", [None, 0.5])
def test_targets_may_have_more_digits_than_states(clip):
    """As they do if float64 is torch's default type, and so the type of gamma."""
    operator, td = make_operator(), make_batch(6)
    loss = make_loss(operator=operator, td_error_clip=clip)
    loss(td.clone())["loss_value"].backward()
    exact = [p.grad for p in loss.parameters()]
    loss.zero_grad(set_to_none=True)
    for key in ("observation", "action", ("next", "observation")):
        td[key] = td[key].float()
    assert loss.target(td).dtype == torch.float64
    loss(td)["loss_value"].backward()
    for parameter, gradient in zip(loss.parameters(), exact, strict=True):
        torch.testing.assert_close(parameter.grad, gradient, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("clip", [None, 0.5])
def test_one_sgd_step_is_the_papers_update(clip):
    """theta + alpha E[delta grad Q] (eq:thup) has no gradient through V(s+)."""
    operator, td, alpha = make_operator(), make_batch(6), 1e-3
    mpc = operator.module
    L = -td["next", "reward"].squeeze(-1)
    Q = mpc.action_value(td["observation"], td["action"])
    V = mpc.value(td["next", "observation"])
    assert all(g.norm() > 0 for g in torch.autograd.grad(V.sum(), list(mpc.parameters())))
    delta = L + GAMMA * V - Q
    assert delta.abs().min() < 0.5 < delta.abs().max(), "the clip is felt by some samples"

    step = expected_step(mpc, td, clip or math.inf)
    before = [p.detach().clone() for p in mpc.parameters()]
    loss = make_loss(operator=operator, td_error_clip=clip)
    optimizer = torch.optim.SGD(loss.parameters(), lr=alpha)
    loss(td)["loss_value"].backward()
    optimizer.step()
    for old, new, direction in zip(before, mpc.parameters(), step, strict=True):
        torch.testing.assert_close(new - old, alpha * direction, atol=1e-13, rtol=1e-7)


# Weights, and the range of V


def test_a_weighted_loss_and_its_gradients():
    operator, td = make_operator(), make_batch(40)
    loss = make_loss(operator=operator, weighted=True)
    prediction = hand_prediction(operator.module, td)
    error = hand_target(operator.module, td.unsqueeze(-1), 0.0).squeeze(-1) - prediction
    p, use = td["observation"], torch.ones(40).bool()
    weight = inverse_variance(p, td["action"], prediction.detach(), error.detach(), use)
    assert weight.max() > 2 * weight.min()
    expected = (weight * 0.5 * error.square()).mean()
    value = loss(td)["loss_value"]
    torch.testing.assert_close(value, expected)
    leaves = [*learned_leaves(loss).values()]
    for leaf, by_hand in zip(leaves, torch.autograd.grad(expected, leaves), strict=True):
        torch.testing.assert_close(torch.autograd.grad(value, leaf, retain_graph=True)[0], by_hand)


def test_values_are_clipped_to_the_range_of_the_observed_rewards():
    operator, td = make_operator(), make_batch(6)
    loss, rewards = make_loss(operator=operator), td["next", "reward"].squeeze(-1)
    unclipped = loss.target(td)
    with torch.no_grad():
        operator.module.c.fill_(1e3)
    future = torch.where(td["next", "terminated"].squeeze(-1), 0.0, -GAMMA / (1 - GAMMA))
    assert (loss.target(td) < -500).any()
    seen = td.clone()
    seen["next", "reward"] = torch.tensor([[-1.0], [0.5], [torch.nan]]).double().repeat(2, 1)
    loss.observe(seen)
    torch.testing.assert_close(loss.target(td), rewards + future)
    with torch.no_grad():
        operator.module.c.fill_(-1e3)
    torch.testing.assert_close(loss.target(td), rewards - 0.5 * future)
    seen["next", "reward"] = torch.full((6, 1), -1e9).double()
    loss.observe(seen)
    with torch.no_grad():
        operator.module.c.zero_()
    assert loss.reward_range.tolist() == [-1e9, 0.5]
    torch.testing.assert_close(loss.target(td), unclipped)


@pytest.mark.parametrize("delay_value", [False, True])
@pytest.mark.parametrize("estimator", TRACE)
def test_a_centred_batch_has_a_mean_error_of_zero(estimator, delay_value):
    operator, td = make_operator(), make_batch(6, 5)
    loss = make_loss(estimator, operator, delay_value=delay_value)
    if delay_value:
        SoftUpdate(loss, tau=0.1)
        perturb(loss)
    policy = operator.module.policy(td["observation"])
    before = td.clone()
    td["next", "reward"][0, -1] = torch.nan

    def errors():
        target = loss.target(td)
        left = target.isfinite()
        return (-target - operator.module.action_value(td["observation"], td["action"]))[left]

    with pytest.warns(RuntimeWarning, match="1 of 30 rewards"):
        start = errors().mean().item()
    c = operator.module.c.item()
    loss.observe(td)  # does not clip
    shift = loss.centre_(td)
    loss.reward_range.copy_(torch.tensor([torch.inf, -torch.inf]))
    with pytest.warns(RuntimeWarning, match="1 of 30 rewards"):
        assert abs(errors().mean().item()) < 1e-9
    assert abs(start) > 0.1
    assert operator.module.c.item() == pytest.approx(c + shift)
    assert torch.equal(operator.module.policy(td["observation"]), policy)
    td["next", "reward"] = before["next", "reward"]
    assert (td == before).all(), "the batch is left alone"


@pytest.mark.parametrize("delay_value", [False, True])
@pytest.mark.parametrize("way", [copy.deepcopy, lambda loss: loss.float()], ids=["copy", "cast"])
def test_a_copied_or_cast_loss_is_centred(way, delay_value):
    loss = way(make_loss(operator=make_operator(learn=("C",)), delay_value=delay_value))
    td = make_batch(6, 5)
    assert abs(loss.centre_(td)) > 0.1
    assert abs(loss.centre_(td)) < 1e-5


def test_c_stays_without_a_usable_transition_or_a_discount():
    loss, td = make_loss("tdlambda", make_operator()), make_batch(7, 9)
    td["next", "terminated"] = torch.zeros(7, 9, 1).bool()
    loss.make_value_estimator("tdlambda", gamma=1.0, lmbda=0.7)
    assert loss.centre_(td) == 0.0
    loss.make_value_estimator()
    td["next", "reward"] = torch.full((7, 9, 1), torch.nan)
    assert loss.centre_(td) == 0.0


# The Q-learning loss under renamed keys, and without a TensorDict


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


# TorchRL's contract of a loss module: estimators, target networks, copies, and resets


@pytest.mark.parametrize("n", [1, 2, 3])
def test_multi_step_returns(n):
    """r_t + gamma r_{t+1} + .., and gamma^k V(s_{t+k}) k steps on, cut at an episode's end.

    Episodes are only truncated, because `MultiStep` keeps the flags of the first step.
    """
    td = make_batch(3, 6)
    td["next", "terminated"] = torch.zeros(3, 6, 1, dtype=torch.bool)
    td["collector", "mask"] = torch.ones(3, 6, dtype=torch.bool)
    operator = make_operator()
    V = operator.module.value(td["next", "observation"]).detach()
    flags: Any = td["next"]
    expected = torch.zeros(3, 6, dtype=torch.float64)
    for i in range(3):
        for t in range(6):
            for k in range(n):
                j = t + k
                expected[i, t] += GAMMA**k * flags["reward"][i, j, 0]
                if flags["done"][i, j] or j == 5 or k == n - 1:
                    expected[i, t] -= GAMMA ** (k + 1) * V[i, j]
                    break
    batch = MultiStep(gamma=GAMMA, n_steps=n)(td.clone())
    out = make_loss(operator=operator, reduction="none")(batch)
    delta = expected - hand_prediction(operator.module, td)
    torch.testing.assert_close(out["loss_value"], 0.5 * delta**2, atol=1e-6, rtol=0)


class Spy(QPActorValueOperator):
    seen: ExplorationType | None = None

    def forward(self, tensordict: Any) -> Any:
        Spy.seen = exploration_type()
        return super().forward(tensordict)


def test_exploration_is_off_inside():
    loss = make_loss(operator=Spy(make_operator().module))
    with set_exploration_type(ExplorationType.RANDOM):
        loss(make_batch(2))
        assert Spy.seen == ExplorationType.DETERMINISTIC
        assert exploration_type() == ExplorationType.RANDOM


@pytest.mark.filterwarnings("ignore:No target network updater")
@pytest.mark.parametrize("delay_value", [False, True])
def test_reset_parameters_recursive(delay_value):
    loss = make_loss(delay_value=delay_value)
    start = loss.value_network_params.clone()
    perturb(loss)
    with torch.no_grad():
        loss.target_value_network_params.apply_(lambda x: x.add_(1) if x.is_floating_point() else x)
    loss.reset_parameters_recursive()
    for key, leaf in learned_leaves(loss).items():
        torch.testing.assert_close(leaf, start[key], atol=1e-12, rtol=0)
        torch.testing.assert_close(
            loss.target_value_network_params[key], start[key].data, atol=1e-12, rtol=0
        )


# The Q-learning loss where a QP has no certified solution


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


def left_out(operator: Any, td: TensorDict, wrong: list[int], reduction: str) -> TensorDictBase:
    """Compare a loss, its gradients and its metadata with those of the samples but for ``wrong``.

    In the mean they count with zero error, so that alpha keeps its meaning.
    """
    others = td[[i for i in range(len(td)) if i not in wrong]].clone()
    expected, step = gradients(make_loss(operator=operator, reduction="sum"), others)
    out, total = gradients(make_loss(operator=operator, reduction=reduction), td)
    count = len(td) if reduction == "mean" else 1
    torch.testing.assert_close(out["loss_value"], expected["loss_value"] / count)
    for gradient, other in zip(total, step, strict=True):
        assert other.norm() > 0
        torch.testing.assert_close(gradient, other / count)
    for key in METADATA:
        torch.testing.assert_close(out[key], expected[key], msg=key)
    assert (td["td_error"][wrong] == 0).all()
    assert td["td_error"].isfinite().all()
    return out


@pytest.mark.parametrize("bad", [5.0, torch.nan, torch.inf])
@pytest.mark.parametrize("where", ["observation", "action", ("next", "observation")])
def test_unsolved_samples_are_masked(where, bad):
    operator, td = hard_operator(), feasible_batch(6)
    td[where][2] = bad
    for reduction in ("sum", "mean"):
        assert left_out(operator, td, [2], reduction)["unsolved"].item() == 1


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
    td["next", "reward"][2] = bad
    td["next", "observation"][4] = 5.0  # and one without a solution
    message = r"\('next', 'reward'\): 1 of 6 rewards are NaN or infinite\. Those transitions are"
    with pytest.warns(RuntimeWarning, match=message) as caught:
        out = left_out(operator, td, [2, 4], reduction)
    assert len(caught) == 1
    assert (out["invalid_reward"].item(), out["unsolved"].item()) == (1, 1)


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
