"""DDPG and TD3 with QPs or networks as actor and critics: learned parameters, rates and delays."""

from __future__ import annotations

import copy
import itertools
import math
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torch.testing import assert_close

from tests.covering import covering
from tests.learners import make, settings
from tests.runs import SMALL, choices, make_config
from torch_qpmpc.experiment.actor_critic import (
    POLICY_DELAY,
    SPREAD,
    actor_groups,
    critic_groups,
    make_actor,
    make_actor_critic_loss,
    make_critic,
)
from torch_qpmpc.experiment.algorithms import Learner
from torch_qpmpc.experiment.tasks import make_mpc, make_physics
from torch_qpmpc.learning.actor_critic import BoundedPolicy, Clip, ClippedPolicy
from torch_qpmpc.learning.operators import POLICY_ACTIVE_SET

TASKS = ("point_mass", "pendulum", "store")
ACTORS = ("qp", "scheduled", "mlp")
NETWORKS = ("qp", "mlp")
ALGOS = ("ddpg", "td3", "sac")
COMBINATIONS = list(itertools.product(ALGOS, ACTORS, NETWORKS))


def parameters(learner: Learner, name: str) -> dict[str, Tensor]:
    """Copy the learned parameters under ``name`` in the loss module."""
    params = getattr(learner.loss_module, name).flatten_keys(".")
    return {key: leaf.detach().clone() for key, leaf in params.items() if leaf.requires_grad}


def moved(before: dict[str, Tensor], after: dict[str, Tensor]) -> set[str]:
    return {key for key, leaf in before.items() if not torch.equal(leaf, after[key])}


@pytest.mark.parametrize(("algo", "actor", "critic"), COMBINATIONS)
def test_every_parameter_that_learns_has_one_rate(algo, actor, critic):
    learner, mpc, _ = make(*settings(algo, actor, critic), "algo.actor_rate=0.25")
    groups = learner.optimizer.param_groups
    listed = [leaf for group in groups for leaf in group["params"]]
    assert len({id(leaf) for leaf in listed}) == len(listed)
    in_loss = {id(leaf) for leaf in learner.loss_module.parameters() if leaf.requires_grad}
    assert {id(leaf) for leaf in listed} == in_loss
    rates = {group["name"]: group["initial_lr"] for group in groups}
    of_actor = {name: rate for name, rate in rates.items() if not name.startswith("critic.")}
    expected = {"alpha": 1e-3} if algo == "sac" else {}
    if actor != "qp" or algo == "sac":  # SAC's scale is the actor's, too
        expected["actor"] = 0.25 * 1e-3
    if actor != "mlp":
        expected |= {"H": 0.25 * 2e-2, "c": 0.25 * 2e-2, "C": 0.25 * 2e-3}
        assert {id(leaf) for leaf in mpc.parameters()} <= in_loss
    assert of_actor == expected
    if actor == "mlp":
        assert not {id(leaf) for leaf in mpc.parameters()} & in_loss
    of_critic = {name: rate for name, rate in rates.items() if name.startswith("critic.")}
    if critic == "mlp":
        assert set(of_critic.values()) == {1e-3}
    else:
        parts = {"H": 2e-2, "c": 2e-2, "C": 2e-3}
        for name, rate in of_critic.items():
            (part,) = [part for part in parts if part in name.split(".")]
            assert rate == parts[part], name
        assert len(of_critic) == len(parts)


@pytest.mark.parametrize("critic", NETWORKS)
def test_the_critics_of_td3_are_stacked_and_start_distinct(critic):
    learner, mpc, _ = make(*settings("td3", "qp", critic))
    leaves = parameters(learner, "qvalue_network_params")
    assert leaves
    nonzero = 0
    for name, leaf in leaves.items():
        assert leaf.shape[0] == 2
        first, second = leaf
        assert (first != second)[first != 0].all(), name
        nonzero += int((first != 0).sum())
    assert nonzero > 10
    if critic == "qp":
        C = next(leaf for name, leaf in leaves.items() if name.split(".")[-1] == "C")
        ratio = (C / mpc.C.detach())[:, mpc.C != 0] - 1
        assert 0.5 * SPREAD < ratio.std() < 2 * SPREAD
        assert (C[:, mpc.C == 0] == 0).all()


@pytest.mark.parametrize("critic", NETWORKS)
def test_one_seed_is_one_critic(critic):
    def leaves(seed: int) -> list[Tensor]:
        torch.manual_seed(seed)
        return [leaf.detach() for leaf in make_critic(cfg, mpc, physics).parameters()]

    cfg = make_config(*SMALL, *settings("ddpg", "qp", critic), "constraint=free")
    physics = make_physics(cfg)
    mpc = make_mpc(cfg, physics)
    assert_close(leaves(1), leaves(1), rtol=0, atol=0)
    assert any(not torch.equal(*pair) for pair in zip(leaves(1), leaves(2), strict=True))


def test_the_actor_is_the_given_qp_itself():
    cfg = make_config(*SMALL, *settings("ddpg", "qp", "qp"), "constraint=free")
    physics = make_physics(cfg)
    mpc = make_mpc(cfg, physics)
    start = copy.deepcopy(mpc.state_dict())
    loss: Any = make_actor_critic_loss(cfg, mpc, physics)
    assert_close(mpc.state_dict(), start)
    with torch.no_grad():
        mpc.H.add_(0)
        next(mpc.parameters()).add_(0.5)
    s = torch.tensor([[0.3, -0.2, 0.1, 0.0]]).double()
    assert_close(loss.actor_network(observation=s), mpc.policy(s))
    trained = {id(leaf) for group in actor_groups(cfg, mpc, loss) for leaf in group["params"]}
    assert trained == {id(leaf) for leaf in mpc.parameters()}
    critics = {id(leaf) for group in critic_groups(cfg, loss) for leaf in group["params"]}
    assert not trained & critics


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_networks_actions_stay_within_their_bounds_and_reach_both(dtype):
    low, high = torch.tensor([-1.0, 0.0]).double(), torch.tensor([2.0, 5.0]).double()
    torch.manual_seed(0)
    policy = BoundedPolicy(3, low, high, width=8)
    a = policy(1e4 * torch.randn(200, 3, dtype=dtype))
    assert a.dtype == dtype
    assert a.shape == (200, 2)
    assert_close(a.amin(0), low.to(dtype))
    assert_close(a.amax(0), high.to(dtype))
    centre = policy(torch.zeros(3, dtype=dtype))
    assert ((centre > low) & (centre < high)).all()


@pytest.mark.parametrize(
    ("a", "gradient", "passed"),
    [
        (0.5, 1.0, 1.0),
        (0.5, -1.0, -1.0),
        (1.0, -1.0, -1.0),
        (1.5, 1.0, 1.0),
        (1.5, -1.0, 0.0),
        (-1.5, 1.0, 0.0),
        (-1.5, -1.0, -1.0),
    ],
)
def test_a_clipped_action_gets_the_gradients_that_lead_back(a, gradient, passed):
    action = torch.tensor([a], requires_grad=True)
    low, high = torch.tensor([-1.0]), torch.tensor([1.0])
    clipped = Clip.apply(action, low, high)
    assert clipped.item() == max(-1, min(a, 1))
    clipped.backward(torch.tensor([gradient]))
    assert action.grad is not None
    assert action.grad.item() == passed


def test_a_qp_with_soft_action_rows_acts_within_the_plants_bounds():
    cfg = make_config(*SMALL, *settings("td3", "qp", "mlp"), "task.action_slack=0.001")
    physics = make_physics(cfg)
    mpc = make_mpc(cfg, physics)
    actor = make_actor(cfg, mpc, physics)
    s = torch.tensor([[2.0, 0.0, 5.0, 0.0], [0.01, 0.0, 0.0, 0.0]])
    free = mpc.policy(s)
    assert (free[0].abs() > 1).all()
    assert (free[1].abs() < 1).all()
    assert_close(actor(observation=s), free.clamp(-1, 1))
    assert isinstance(actor.module, ClippedPolicy)


@pytest.mark.parametrize("actor", ACTORS)
def test_in_closed_loop_the_actor_acts_as_in_the_loss(actor):
    """A QP is warm-started and clipped, in either dtype, and shares the loss's parameters."""
    learner, _, batch = make(*settings("td3", actor, "mlp"), "task.action_slack=0.001")
    for _ in range(4):
        learner.learn(batch.clone(), None)
    in_loss: Any = learner.loss_module.actor_network
    s = torch.tensor([[2.0, 0.0, 5.0, 0.0], [0.01, 0.0, 0.0, 0.0]])
    for states in (s, s.double()):
        td = TensorDict(observation=states, batch_size=2)
        expected = in_loss(td.clone())["action"]
        for _ in range(2):
            a = learner.actor(td)["action"]
            assert_close(a, expected)
            assert a.dtype == states.dtype
        assert (POLICY_ACTIVE_SET in td) == (actor == "qp")


@pytest.mark.parametrize("done", [0, 1, 5])
def test_td3_delays_its_actor_also_after_a_resume(done):
    learner, mpc, batch = make(*settings("td3", "qp", "mlp"), done=done)
    for update in range(done + 1, done + 7):
        actor = copy.deepcopy(mpc.state_dict())
        critics = parameters(learner, "qvalue_network_params")
        learner.learn(batch.clone(), None)
        learner.scheduler.step()
        still = all(torch.equal(x, actor[name]) for name, x in mpc.state_dict().items())
        assert still == (update % POLICY_DELAY != 0), update
        assert moved(critics, parameters(learner, "qvalue_network_params"))


def test_td3_whose_schedule_is_restored_has_the_same_delay():
    learner, mpc, batch = make(*settings("td3", "qp", "mlp"))
    learner.scheduler.last_epoch = 4
    for update in (5, 6, 7):
        before = mpc.C.detach().clone()
        learner.learn(batch.clone(), None)
        learner.scheduler.step()
        assert torch.equal(mpc.C, before) == (update != 6)


@pytest.mark.parametrize(
    ("algo", "actor", "critic", "task"), covering(itertools.product(ALGOS, ACTORS, NETWORKS, TASKS))
)
def test_updates_move_the_actor_the_critics_and_nothing_else(algo, actor, critic, task, store_task):
    learner, mpc, batch = make(*settings(algo, actor, critic, task))
    assert learner.target is not None
    loss_module = learner.loss_module
    learns = {name for name, leaf in loss_module.named_parameters() if leaf.requires_grad}
    before, theta = copy.deepcopy(loss_module.state_dict()), copy.deepcopy(mpc.state_dict())
    for _ in range(4):
        terms, losses = learner.learn(batch.clone(), None)
        learner.scheduler.step()
        learner.target.step()
        assert all(term.isfinite() for term in terms.values())
        assert algo == "sac" or losses["pred_value"].isfinite().all()
        assert algo == "sac" or losses["target_value"].isfinite().all()
    changed = moved(before, loss_module.state_dict())
    of_no_use = {name for name in learns if name.startswith("actor") and name.endswith(".c")}
    if (actor, task) == ("scheduled", "store"):  # after one update, all actions are at hard bounds
        of_no_use |= {name for name in learns if "net.0" in name or "net.2" in name} - changed
    assert changed & learns == learns - of_no_use
    assert changed - learns == {f"target_{name}" for name in learns - of_no_use} & before.keys()
    of_qp = moved(theta, mpc.state_dict())
    assert bool(of_qp) == (actor != "mlp")
    assert of_qp <= {name for name, _ in mpc.named_parameters()}


@pytest.mark.parametrize("algo", ALGOS)
def test_a_loss_that_is_not_finite_moves_nothing_and_is_counted(algo):
    learner, _, batch = make(*settings(algo, "qp", "qp"))
    before = copy.deepcopy(learner.loss_module.state_dict())
    broken = batch.clone()
    broken["next", "reward"][:2] = math.nan
    rewards = r"\('next', 'reward'\): 2 of 12 rewards are NaN or infinite\. The batch moves nothing"
    with pytest.warns(RuntimeWarning, match=rewards):
        _, losses = learner.learn(broken, None)
    assert (losses["invalid_reward"], losses["unsolved"]) == (2, 0)
    assert not moved(before, learner.loss_module.state_dict())
    learner.learn(batch.clone(), None)
    assert moved(before, learner.loss_module.state_dict())


@pytest.mark.parametrize("critic", NETWORKS)
@pytest.mark.parametrize("algo", ALGOS)
def test_gradient_of_theta_agrees_with_finite_differences_of_the_loss(algo, critic):
    # In float64: a network's rounding in float32 exceeds the differences.
    torch.set_default_dtype(torch.float64)
    try:
        learner, mpc, batch = make(*settings(algo, "qp", critic), seed=3)
    finally:
        torch.set_default_dtype(torch.float32)
    loss_module = learner.loss_module
    for key in ("observation", "action", ("next", "observation"), ("next", "reward")):
        batch[key] = batch[key].double()
    batch["observation"] = 0.5 * batch["observation"]

    def loss() -> Tensor:
        torch.manual_seed(0)  # SAC draws actions
        return loss_module(batch.clone())["loss_actor"]

    loss().backward()
    compared = 0
    # A list, because functional calls exchange the parameters during the iteration.
    for leaf in list(mpc.parameters()):
        gradient = leaf.grad
        if gradient is None:
            continue
        for i in gradient.abs().flatten().argsort(descending=True)[:3].tolist():
            step = 1e-6
            with torch.no_grad():
                flat = leaf.view(-1)
                start = flat[i].item()
                ends = []
                for sign in (1, -1):
                    flat[i] = start + sign * step
                    ends.append(loss().item())
                flat[i] = start
            difference = (ends[0] - ends[1]) / (2 * step)
            assert gradient.flatten()[i].item() == pytest.approx(difference, rel=2e-3, abs=1e-6)
            compared += gradient.flatten()[i] != 0
    assert compared >= 5


def test_the_algorithms_are_those_tested():
    assert {*ALGOS, "qlearning"} == set(choices("algo"))
