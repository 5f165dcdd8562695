"""Properties common to all plants, and the environments' agreement with their physics."""

from __future__ import annotations

import copy
import importlib
import warnings
from dataclasses import fields
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.envs import SerialEnv, check_env_specs

import torch_qpmpc.envs
from tests.staggered import Staggered
from torch_qpmpc.envs import (
    GrosZanonLTI,
    LinearSystem,
    LinearSystemEnv,
    LinearSystemGymEnv,
    PointMass,
)
from torch_qpmpc.errors import QPError

PLANTS = {
    "gaussian": PointMass("gaussian", noise_std=0.1),
    "brownian": PointMass("brownian", noise_std=0.1),
    "gros_zanon": GrosZanonLTI(),
}
IDS = ["torch_qpmpc/PointMass-v0", "torch_qpmpc/GrosZanonLTI-v0"]


@pytest.fixture(params=PLANTS)
def plant(request: pytest.FixtureRequest) -> LinearSystem:
    """Return each plant in turn, with each kind of noise."""
    return PLANTS[request.param]


class StaggeredEnv(Staggered, LinearSystemEnv):
    """A plant whose episodes start at different steps, so that every later reset is partial."""


def linear_policy(plant: LinearSystem) -> TensorDictModule:
    torch.manual_seed(0)
    n_x, n_u = plant.B.shape
    net = torch.nn.Sequential(torch.nn.Linear(n_x, n_u), torch.nn.Tanh())
    return TensorDictModule(net, in_keys=["observation"], out_keys=["action"])


def collect(env: LinearSystemEnv, batches: int, steps: int) -> Any:
    """Collect a TensorDict of ``(num_envs, batches * steps)`` transitions."""
    collector = Collector(
        env,
        linear_policy(env.physics),
        frames_per_batch=steps * env.batch_size[0],
        total_frames=batches * steps * env.batch_size[0],
        auto_register_policy_transforms=False,
    )
    data: list[Any] = [batch.clone() for batch in collector]
    collector.shutdown()
    return torch.cat(data, dim=1)


# --- LinearSystem ------------------------------------------------------------------------------


@pytest.mark.parametrize("make", [np.random.default_rng, torch.Generator().manual_seed])
def test_both_kinds_of_generators_draw_the_same_shapes(plant, make):
    n_x = plant.A.shape[0]
    starts, draw = plant.starts(make(1), 5), plant.draw(make(1), 5)
    nu = plant.noise(torch.zeros(5, n_x), draw)
    assert starts.shape == nu.shape == (5, n_x)
    assert draw.shape[0] == 5
    assert starts.dtype == draw.dtype == nu.dtype == torch.float64
    assert torch.equal(plant.starts(make(1), 5), starts)
    assert torch.equal(plant.draw(make(1), 5), draw)
    assert not torch.equal(plant.draw(make(2), 5), draw)
    assert len(draw[:, 0].unique()) == 5


def test_batches_have_any_shape(plant):
    n_x, n_u = plant.B.shape
    s, a = plant.starts(np.random.default_rng(0), 6), torch.linspace(-2, 2, 6 * n_u).view(6, n_u)
    draw = plant.draw(np.random.default_rng(1), 6)

    def following(s, a, draw):
        return plant.step(s, a, plant.noise(torch.zeros_like(s), draw))

    flat, cost = following(s, a, draw), plant.cost(s, a)
    s, a, draw = (x.view(2, 3, -1) for x in (s, a, draw))
    assert plant.cost(s, a).shape == (2, 3)
    torch.testing.assert_close(plant.cost(s, a).flatten(), cost)
    torch.testing.assert_close(following(s, a, draw).view(6, n_x), flat)


def test_moving_keeps_every_field(plant):
    moved = plant.to("meta")
    assert type(moved) is type(plant)
    for field in fields(plant):
        before, after = getattr(plant, field.name), getattr(moved, field.name)
        if isinstance(before, Tensor):
            assert (after.device.type, after.dtype) == ("meta", torch.float64)
        else:
            assert after == before


# --- Gymnasium ---------------------------------------------------------------------------------


@pytest.mark.parametrize("name", IDS)
def test_gymnasium_finds_nothing_to_complain_about(name):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # With soft bounds the observation space is unbounded, about which Gymnasium warns.
        warnings.filterwarnings("ignore", ".*(minimum|maximum) value is -?infinity")
        check_env(gymnasium.make(name).unwrapped)


@pytest.mark.parametrize("name", IDS)
def test_importing_again_does_not_register_again(name):
    spec = gymnasium.registry[name]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        importlib.reload(torch_qpmpc.envs)
    assert gymnasium.registry[name] is spec


def test_gymnasium_environment_follows_the_physics(plant):
    env = gymnasium.wrappers.TimeLimit(LinearSystemGymEnv(plant), 50)
    rng, actions = np.random.default_rng(7), np.random.default_rng(8)
    observation, _ = env.reset(seed=7)
    s, ends = plant.starts(rng, 1)[0], []
    nu = torch.zeros_like(s)
    np.testing.assert_array_equal(observation, s.float().numpy())
    for _ in range(50):
        action = actions.uniform(-1, 1, plant.B.shape[1]).astype(np.float32)
        a = torch.as_tensor(action)
        observation, reward, terminated, truncated, _ = env.step(action)
        assert reward == -plant.cost(s, a).item()
        nu = plant.noise(nu, plant.draw(rng, 1)[0])
        s = plant.step(s, a, nu)
        np.testing.assert_array_equal(observation, s.float().numpy())
        assert not terminated
        ends.append(truncated)
    assert ends == [False] * 49 + [True]


# --- TorchRL -----------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_torchrl_accepts_the_specs(plant, dtype):
    check_env_specs(LinearSystemEnv(plant, 3, 50, dtype, seed=0), seed=0)
    check_env_specs(SerialEnv(2, lambda: LinearSystemEnv(plant, 3, 50, dtype)), seed=0)


def test_torchrl_environment_follows_the_physics(plant):
    env = LinearSystemEnv(plant, 5, 50, torch.float64, seed=11)
    data = env.rollout(50, policy=linear_policy(plant).double())
    rng = torch.Generator().manual_seed(11)
    s = plant.starts(rng, 5)
    nu = torch.zeros_like(s)
    for k in range(50):
        now = data[:, k]
        torch.testing.assert_close(now["observation"], s, atol=0, rtol=0)
        assert torch.equal(now["next", "reward"], -plant.cost(s, now["action"]).unsqueeze(-1))
        nu = plant.noise(nu, plant.draw(rng, 5))
        s = plant.step(s, now["action"], nu)
        torch.testing.assert_close(now["next", "observation"], s, atol=0, rtol=0)
    assert data.shape == (5, 50)
    assert not data["next", "terminated"].any()
    assert data["next", "truncated"].squeeze(-1).nonzero()[:, 1].tolist() == [49] * 5
    assert torch.equal(data["next", "truncated"], data["next", "done"])


def test_partial_resets_in_a_collector_restart_exactly_the_finished_episodes(plant):
    data = collect(StaggeredEnv(plant, 8, max_steps=5, seed=2), batches=20, steps=2)
    done = data["next", "done"].squeeze(-1)
    assert done.any(0).all(), "every step ends some episode"
    assert not done.all(0).any(), "no step ends all"

    now, then = data[:, 1:], data[:, :-1]
    ended = done[:, :-1]
    for key in ("noise", "step_count"):
        assert (now[key][ended] == 0).all()
        assert torch.equal(now[key][~ended], then["next", key][~ended])
    assert torch.equal(now["observation"][~ended], then["next", "observation"][~ended])
    assert (
        not torch.isclose(now["observation"][ended], then["next", "observation"][ended])
        .all(-1)
        .any()
    )
    assert ((now["collector", "traj_ids"] != then["collector", "traj_ids"]) == ended).all()

    # The stored nu entered the dynamics.
    following = plant.step(data["observation"], data["action"], data["next", "noise"])
    torch.testing.assert_close(data["next", "observation"], following.float())
    if plant is PLANTS["brownian"]:
        increments = data["next", "noise"] - data["noise"]
        assert increments.std().item() == pytest.approx(0.1, rel=0.05)
        assert data["next", "noise"].std().item() > 0.13


def test_rollouts_depend_on_the_seed_only(plant):
    def rollout(seed):
        env = LinearSystemEnv(plant, 4, 50, seed=seed)
        torch.manual_seed(seed + torch.seed() % 1000)
        return env.rollout(20, policy=linear_policy(plant))["next", "observation"]

    assert torch.equal(rollout(5), rollout(5))
    assert not torch.equal(rollout(5), rollout(6))


def test_without_a_seed_the_global_generator_decides(plant):
    def first():
        torch.manual_seed(9)
        return LinearSystemEnv(plant, 4, 50).rollout(1)["next", "noise"]

    assert torch.equal(first(), first())


def test_saved_generator_continues_the_stream(plant):
    env = LinearSystemEnv(plant, 4, max_steps=7, seed=1)
    td, state = env.reset(), env.get_rng_state()

    def rollout(env):
        return env.rollout(
            30,
            linear_policy(plant),
            auto_reset=False,
            tensordict=td,
            break_when_any_done=False,
        )["observation"]

    expected, other = rollout(env), LinearSystemEnv(plant, 4, max_steps=7, seed=2)
    assert not torch.equal(rollout(other), expected)
    other.set_rng_state(state)
    assert torch.equal(rollout(other), expected)
    env.set_rng_state(state)
    assert torch.equal(rollout(copy.deepcopy(env)), expected)


def test_bad_sizes_are_an_error(plant):
    with pytest.raises(QPError, match="num_envs: got 0, expected a whole number >= 1"):
        LinearSystemEnv(plant, 0, 50)
    with pytest.raises(QPError, match="max_steps: got -1, expected a whole number >= 1"):
        LinearSystemEnv(plant, 1, max_steps=-1)
