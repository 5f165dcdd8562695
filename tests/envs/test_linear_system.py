"""Properties common to all plants, and the environments' agreement with their physics."""

import importlib
import warnings
from dataclasses import fields

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from torch import Tensor

import torch_qpmpc.envs
from tests.rollouts import network_policy
from torch_qpmpc import envs

PLANTS = {
    "gaussian": envs.PointMass("gaussian", noise_std=0.1),
    "brownian": envs.PointMass("brownian", noise_std=0.1),
    "gros_zanon": envs.GrosZanonLTI(),
}
ID = "torch_qpmpc/PointMass-v0"


@pytest.fixture(params=PLANTS)
def plant(request: pytest.FixtureRequest) -> envs.LinearSystem:
    return PLANTS[request.param]


# --- LinearSystem ------------------------------------------------------------------------------


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


def test_gymnasium_finds_nothing_to_complain_about(plant):
    with warnings.catch_warnings(action="error"):
        # With soft bounds the observation space is unbounded, about which Gymnasium warns.
        warnings.filterwarnings("ignore", ".*(minimum|maximum) value is -?infinity")
        check_env(envs.LinearSystemGymEnv(plant), skip_render_check=True)


def test_importing_again_does_not_register_again():
    spec = gymnasium.registry[ID]
    with warnings.catch_warnings(action="error"):
        importlib.reload(torch_qpmpc.envs)
    assert gymnasium.registry[ID] is spec


def test_gymnasium_environment_follows_the_physics(plant):
    env = gymnasium.wrappers.TimeLimit(envs.LinearSystemGymEnv(plant), 50)
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


def test_torchrl_environment_follows_the_physics(plant):
    env = envs.LinearSystemEnv(plant, 5, 50, torch.float64, seed=11)
    data = env.rollout(50, network_policy(env))
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
