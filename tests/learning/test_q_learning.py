"""The Q-learning loss: its values, its gradients, and the paper's update."""

import copy
import math

import pytest
import torch
from tensordict import TensorDictBase
from torch import Tensor
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
from torch_qpmpc import QPMPC
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
    """Compute E[delta grad Q], one gradient of Q at a time."""
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
