"""The Q-learning loss: TorchRL's contract of a loss module, and the paper's update."""

from __future__ import annotations

import copy
import math
import pickle
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import MultiStep
from torchrl.envs.utils import ExplorationType, exploration_type, set_exploration_type
from torchrl.objectives import HardUpdate, SoftUpdate, ValueEstimators
from torchrl.objectives.value import TD0Estimator, TD1Estimator, TDLambdaEstimator

from torch_qpmpc import QPMPC, QPActorValueOperator, QPError, QPQLearningLoss
from torch_qpmpc.objectives import td_loss

#: Exact in float32, in which TorchRL keeps them.
GAMMA, LMBDA = 0.875, 0.75
LEARN = ("H", "H_f", "q", "c", "w", "C", "b", "G", "lb", "ub")
#: The trace parameter lambda that makes each estimator a TD(lambda).
TRACE = {"td0": 0.0, "td1": 1.0, "tdlambda": LMBDA}
METADATA = ["td_error", "pred_value", "target_value", "pred_value_max", "target_value_max"]


def make_operator(keys: dict[str, Any] | None = None, **options: Any) -> QPActorValueOperator:
    """A small QP that learns everything, on a double integrator with friction."""
    settings = {
        "gamma": GAMMA,
        "state_bounds": ([-1.0, -1.0], [1.0, 1.0]),
        "action_bounds": ([-1.0], [1.0]),
        "stage_weight": [1.0, 0.5, 0.1],
        "state_slack": 10.0,
        "learn": LEARN,
        "solver": "daqp",
        "on_failure": "mask",
    } | options
    mpc = QPMPC.from_model([[1.0, 0.1], [0.0, 0.9]], [[0.0], [0.1]], 3, **settings)
    return QPActorValueOperator(mpc, **(keys or {}))


def make_loss(estimator: Any = "td0", operator=None, **options: Any) -> QPQLearningLoss:
    loss = QPQLearningLoss(operator or make_operator(), **options)
    more = {"lmbda": LMBDA} if estimator == "tdlambda" else {}
    loss.make_value_estimator(estimator, gamma=GAMMA, **more)
    return loss


def make_batch(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> TensorDict:
    """Transitions of episodes along the last dimension; some end inside, by either flag."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(bound: float, *size: int) -> Tensor:
        return bound * (2 * torch.rand(size, generator=generator, dtype=torch.float64) - 1)

    *batch, steps = shape
    s = uniform(1.5, *batch, steps + 1, 2).to(dtype)
    ended = torch.rand(*shape, 1, generator=generator)
    following = {
        "observation": s[..., 1:, :].clone(),
        "reward": uniform(3.0, *shape, 1).to(dtype),
        "done": ended < 0.4,
        "terminated": ended < 0.2,
        "truncated": (ended >= 0.2) & (ended < 0.4),
    }
    return TensorDict(
        {
            "observation": s[..., :-1, :].clone(),
            "action": uniform(0.9, *shape, 1).to(dtype),
            "next": TensorDict(following, batch_size=shape),
        },
        batch_size=shape,
    )


def hand_target(mpc: QPMPC, td: TensorDictBase, trace: float) -> Tensor:
    """-L - gamma (1 - terminated) V(s+), and TD(lambda) beyond it, in a loop over time."""
    with torch.no_grad():
        V = mpc.value(td["next", "observation"])
    reward, done, terminated = (td["next", k].squeeze(-1) for k in ("reward", "done", "terminated"))
    target, steps = torch.zeros_like(reward), reward.shape[-1]
    for t in reversed(range(steps)):
        future = -V[..., t]
        if t + 1 < steps:
            mixed = (1 - trace) * future + trace * target[..., t + 1]
            future = torch.where(done[..., t], future, mixed)
        target[..., t] = reward[..., t] + GAMMA * torch.where(terminated[..., t], 0.0, future)
    return target


def hand_prediction(mpc: QPMPC, td: TensorDictBase) -> Tensor:
    return -mpc.action_value(td["observation"], td["action"])


def perturb(module: torch.nn.Module, size: float = 0.05, seed: int = 1) -> None:
    """Move every parameter at random, in place."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in module.parameters():
            normal = torch.randn(parameter.shape, generator=generator, dtype=torch.float64)
            parameter += size * normal.to(parameter)


def learned_leaves(loss: QPQLearningLoss) -> dict[Any, Tensor]:
    leaves = loss.value_network_params.items(True, True)
    return {key: leaf for key, leaf in leaves if isinstance(leaf, torch.nn.Parameter)}


def unravel_keys(key: Any) -> tuple[str, ...]:
    return (key,) if isinstance(key, str) else key


# --- TorchRL's contract --------------------------------------------------------------------------


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


def test_input_is_left_alone_by_an_estimator_that_rewrites_rewards():
    loss, td = make_loss(), make_batch(6)
    loss.make_value_estimator("td0", average_rewards=True)
    before = td.clone()
    loss(td)
    assert (td.exclude("td_error") == before).all()


def test_the_operators_follow_the_loss():
    """The critic given to the loss, and the policy on it, share the learned parameters."""
    operator = make_operator()
    loss, td = make_loss(operator=operator), make_batch(8)
    policy = operator.get_policy_operator()
    before = policy(td.clone())["action"]
    optimizer = torch.optim.SGD(loss.parameters(), lr=1e-2)
    loss(td)["loss_value"].backward()
    optimizer.step()
    assert {id(p) for p in loss.parameters()} == {id(p) for p in operator.parameters()}
    assert not torch.equal(policy(td.clone())["action"], before)


@pytest.mark.parametrize("estimator", [ValueEstimators.GAE, ValueEstimators.VTrace, "gae"])
def test_other_estimators_are_not_implemented(estimator):
    with pytest.raises(NotImplementedError, match="not implemented for loss QPQLearningLoss"):
        make_loss().make_value_estimator(estimator)


@pytest.mark.parametrize(
    ("name", "kind", "estimator"),
    [
        ("td0", ValueEstimators.TD0, TD0Estimator),
        ("td1", ValueEstimators.TD1, TD1Estimator),
        ("tdlambda", ValueEstimators.TDLambda, TDLambdaEstimator),
    ],
)
def test_estimator_by_string_enum_class_and_instance(name, kind, estimator):
    td, losses = make_batch(2, 4), []
    options: dict[str, Any] = {"gamma": GAMMA} | ({"lmbda": LMBDA} if name == "tdlambda" else {})
    operator = make_operator()
    for how in ("string", "enum", "class", "instance"):
        loss = QPQLearningLoss(operator)
        value_network = loss.state_value_network
        if how == "string":
            assert loss.make_value_estimator(name, **options) is None
        elif how == "enum":
            loss.make_value_estimator(kind, **options)
        elif how == "class":
            loss.make_value_estimator(estimator, value_network=value_network, **options)
        else:
            loss.make_value_estimator(estimator(value_network=value_network, **options))
        assert isinstance(loss.value_estimator, estimator)
        losses.append(loss(td)["loss_value"])
    assert len({value.item() for value in losses}) == 1


def test_default_estimator_is_td0():
    loss = QPQLearningLoss(make_operator())
    assert isinstance(loss.value_estimator, TD0Estimator)
    assert loss.value_estimator.gamma.item() == pytest.approx(0.99)


@pytest.mark.filterwarnings("ignore:No target network updater")
@pytest.mark.parametrize("delay_value", [False, True])
def test_state_dict_round_trip(delay_value):
    first = make_loss(delay_value=delay_value)
    second = make_loss(delay_value=delay_value)
    perturb(first)
    state = first.state_dict()
    second.load_state_dict(state)
    assert state.keys() == second.state_dict().keys()
    assert all(torch.equal(value, second.state_dict()[key]) for key, value in state.items())
    td = make_batch(6)
    assert torch.equal(first(td.clone())["loss_value"], second(td.clone())["loss_value"])


KEYS = {
    "advantage": "advantage",
    "value_target": "value_target",
    "value": "state_value",
    "state_action_value": "state_action_value",
    "action": "action",
    "priority": "td_error",
    "reward": "reward",
    "done": "done",
    "terminated": "terminated",
    "priority_weight": "priority_weight",
}


def test_keys_can_be_set_and_reset():
    loss = QPQLearningLoss(make_operator())
    assert vars(loss.tensor_keys) == KEYS
    for key, default in KEYS.items():
        loss.set_keys(**{key: ("nested", "new")})
        assert getattr(loss.tensor_keys, key) == ("nested", "new")
        loss.set_keys(**{key: None})
        assert getattr(loss.tensor_keys, key) == default
    with pytest.raises(ValueError, match="unknown_key is not an accepted tensordict key"):
        loss.set_keys(unknown_key="x")


@pytest.mark.parametrize("estimator", TRACE)
@pytest.mark.parametrize("when", ["before", "after"])
def test_keys_reach_the_estimator(estimator, when):
    names = ("advantage", "value_target", "value", "reward", "done", "terminated")
    # The estimator insists that the value is a key that its network writes.
    loss = QPQLearningLoss(make_operator({"state_value_key": "value_2"}))
    loss.set_keys(value="value_2")
    assert ("next", "reward") in loss.in_keys
    if when == "after":
        loss.make_value_estimator(estimator)
    loss.set_keys(**{name: f"{name}_2" for name in names})
    if when == "before":
        loss.make_value_estimator(estimator)
    assert [getattr(loss.value_estimator.tensor_keys, n) for n in names] == [
        f"{n}_2" for n in names
    ]
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
    """The same loss and batch, under the default keys and under renamed, nested ones."""
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
    assert len(results) == len(loss.out_keys) == 7
    for key, value in zip(loss.out_keys, results, strict=True):
        assert torch.equal(value, out[key]), key

    renamed = {"_".join(unravel_keys(key)): new[key] for key in other.in_keys}
    assert "next_agent_minus_L" in renamed
    assert torch.equal(other(**renamed)[0], out["loss_value"])
    loss.select_out_keys("loss_value")
    assert torch.equal(loss(**arguments), out["loss_value"])


def test_reduction():
    td = make_batch(6)
    none = make_loss(reduction="none")(td)["loss_value"]
    assert none.shape == (6,)
    torch.testing.assert_close(make_loss(reduction="sum")(td)["loss_value"], none.sum())
    torch.testing.assert_close(make_loss(reduction="mean")(td)["loss_value"], none.mean())
    torch.testing.assert_close(make_loss()(td)["loss_value"], none.mean())


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


def test_padding_mask_of_the_collector():
    td = make_batch(4, 3)
    none = make_loss(reduction="none")(td)["loss_value"]
    mask = torch.ones(4, 3, dtype=torch.bool)
    mask[1, 2] = mask[3, 0] = False
    td["collector", "mask"] = mask
    td["observation"][~mask] = torch.nan
    torch.testing.assert_close(make_loss()(td)["loss_value"], none[mask].mean())
    torch.testing.assert_close(make_loss(reduction="sum")(td)["loss_value"], none[mask].sum())


@pytest.mark.parametrize("n", [1, 2, 3])
def test_multi_step_returns(n):
    """r_t + gamma r_{t+1} + .., and gamma^k V(s_{t+k}) k steps on, cut at an episode's end.

    Truncations only, as `MultiStep` leaves the flags of the first step where they are.
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


def test_target_network_updaters():
    loss = make_loss(delay_value=True)
    with pytest.warns(UserWarning, match="No target network updater"):
        loss(make_batch(2))
    soft = SoftUpdate(loss, tau=0.25)
    start = copy.deepcopy(loss.value_network)
    perturb(loss)
    soft.step()
    target, online = loss.target_value_network_params, loss.value_network_params
    for key, leaf in learned_leaves(loss).items():
        old = dict(start.named_parameters())[".".join(key)].detach()
        torch.testing.assert_close(target[key], old + 0.25 * (leaf.detach() - old))

    hard = HardUpdate(loss, value_network_update_interval=1)
    perturb(loss)
    C = ("module", "C")
    assert not torch.equal(target[C], online[C])
    hard.step()
    hard.step()
    assert torch.equal(target[C], online[C])


@pytest.mark.parametrize(
    "updater",
    [lambda loss: SoftUpdate(loss, tau=0.1), lambda loss: HardUpdate(loss)],
    ids=["soft", "hard"],
)
def test_updaters_need_delayed_parameters(updater):
    with pytest.raises(RuntimeError, match="Did not find any target parameters"):
        updater(make_loss(delay_value=False))


@pytest.mark.parametrize("how", ["deepcopy", "pickle"])
def test_copies_are_independent_and_whole(how):
    loss, td = make_loss("tdlambda"), make_batch(3, 4)
    expected = loss(td.clone())["loss_value"]
    twin = copy.deepcopy(loss) if how == "deepcopy" else pickle.loads(pickle.dumps(loss))
    perturb(loss)
    out = twin(td.clone())["loss_value"]
    assert torch.equal(out, expected)
    perturb(twin)  # Q, and V inside the estimator, both follow the copy's parameters
    assert torch.equal(twin(td.clone())["loss_value"], loss(td.clone())["loss_value"])


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


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_output_has_the_dtype_of_the_batch(dtype):
    out = make_loss()(make_batch(6, dtype=dtype))
    assert {out[key].dtype for key in ("loss_value", *METADATA)} == {dtype}


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


def test_metadata_are_detached_scalars():
    operator, td = make_operator(), make_batch(6)
    out = make_loss(operator=operator)(td)
    assert set(out.keys()) == {"loss_value", "unsolved", *METADATA}
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
    }
    for key, value in expected.items():
        assert not out[key].requires_grad
        assert out[key].shape == ()
        torch.testing.assert_close(out[key], value, atol=1e-9, rtol=0)


@pytest.mark.filterwarnings("ignore:torch._dynamo.config.inline_inbuilt:FutureWarning")
def test_compiled_without_graph_breaks():
    loss = make_loss(reduction="none")
    compiled = torch.compile(loss, fullgraph=True, backend="aot_eager")
    for seed in (0, 1):
        first, second = make_batch(6, seed=seed), make_batch(6, seed=seed)
        expected = loss(first)
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


def test_bad_arguments():
    operator = make_operator()
    with pytest.raises(TypeError, match="gamma"):
        QPQLearningLoss(operator, gamma=0.9)
    with pytest.raises(QPError, match=r"value_network: got \w*QPMPC, .* Wrap the QPMPC"):
        QPQLearningLoss(operator.module)  # pyright: ignore[reportArgumentType] - what is tested
    for clip in (0.0, -1.0, math.nan):
        with pytest.raises(QPError, match=rf"td_error_clip: got {clip}, expected a positive"):
            QPQLearningLoss(operator, td_error_clip=clip)
    with pytest.raises(QPError, match="reduction: got 'median', expected 'mean', 'sum' or 'none'"):
        QPQLearningLoss(operator, reduction="median")


# --- The paper's update --------------------------------------------------------------------------


def test_termination_stops_the_bootstrap_and_truncation_does_not():
    operator = make_operator()
    td = make_batch(3)
    done, terminated = torch.tensor([[0, 0], [1, 0], [1, 1]], dtype=torch.bool).T
    td["next", "done"], td["next", "terminated"] = done.unsqueeze(-1), terminated.unsqueeze(-1)
    out = make_loss(operator=operator, reduction="none")(td)
    L: Tensor = -td["next", "reward"].squeeze(-1)
    V = operator.module.value(td["next", "observation"])
    Q = operator.module.action_value(td["observation"], td["action"])
    bootstraps = torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64)
    delta = L + GAMMA * bootstraps * V - Q
    torch.testing.assert_close(out["loss_value"], 0.5 * delta**2, atol=0, rtol=0)


def expected_step(mpc: QPMPC, td: TensorDictBase, clip: float = math.inf) -> list[Tensor]:
    """E[delta grad Q] by one gradient of Q at a time."""
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
def test_one_sgd_step_is_the_papers_update(clip):
    """theta + alpha E[delta grad Q] (eq:thup), semi-gradient: nothing flows through V(s+)."""
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


def test_gradient_against_finite_differences():
    """With the target held, the loss' gradient is its derivative in every learned entry."""
    operator, td = make_operator(), make_batch(5)
    mpc = operator.module
    loss = make_loss(operator=operator)
    loss(td)["loss_value"].backward()
    target = hand_target(mpc, td, 0.0)
    generator = torch.Generator().manual_seed(0)
    for name, parameter in mpc.named_parameters():
        direction = torch.randn(parameter.shape, generator=generator, dtype=torch.float64)
        values = []
        for sign in (1, -1):
            with torch.no_grad():
                parameter += sign * 1e-6 * direction
                values.append((0.5 * (target - hand_prediction(mpc, td)) ** 2).mean().item())
                parameter -= sign * 1e-6 * direction
        slope = (values[0] - values[1]) / 2e-6
        assert parameter.grad is not None
        assert (parameter.grad * direction).sum().item() == pytest.approx(slope, 1e-5, 1e-8), name


def test_td_loss_is_huber_beyond_the_clip():
    prediction = torch.linspace(-4, 4, 33, dtype=torch.float64, requires_grad=True)
    target = torch.zeros(33, dtype=torch.float64)
    for clip in (None, 1.5):
        loss = td_loss(prediction, target, clip)
        (gradient,) = torch.autograd.grad(loss.sum(), prediction)
        bound = math.inf if clip is None else clip
        assert torch.equal(gradient, prediction.clamp(-bound, bound))
        assert (loss >= 0).all()
        assert loss[16] == 0


# --- Unsolved QPs --------------------------------------------------------------------------------


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
