"""Plants with previews and hidden states in TorchRL."""

from typing import Any

import pytest
import torch

from tests.envs.test_kalman_filter import model
from tests.rollouts import network_policy
from tests.store import Store
from torch_qpmpc.envs import PlantEnv
from torch_qpmpc.envs.plant import EPISODES
from torch_qpmpc.errors import QPError

PLANT = Store(horizon=3)


def make_env(num_envs: int = 4, max_steps: int = 6, seed: int = 0) -> Any:
    return PlantEnv(PLANT, num_envs, max_steps, torch.float64, seed=seed)


def test_sizes_are_those_of_what_a_controller_sees():
    env = PLANT.vectorised(4, 6, seed=0)
    assert env.observation_spec["observation"].shape == (4, 2)
    assert env.observation_spec["preview"].shape == (4, 8)
    assert PLANT.n_preview == 8
    observed = PLANT.observed(model(3, 2, 2))
    assert observed.vectorised(4, 6, seed=0).observation_spec["observation"].shape == (4, 3)
    assert (observed.n_x, PLANT.n_x) == (3, 2)


def test_transitions_follow_the_plant():
    env = make_env(seed=11)
    data = env.rollout(6, network_policy(env))
    rng = torch.Generator().manual_seed(11)
    signals = PLANT.signals(rng, EPISODES, 6 + PLANT.horizon + 1)
    x = PLANT.starts(rng, 4)
    w = signals[torch.randint(EPISODES, (4,), generator=rng)]
    for k in range(6):
        now, u = data[:, k], PLANT.applied(data[:, k]["action"])
        assert torch.equal(now["state"], x)
        assert torch.equal(now["observation"], PLANT.output(x, w[:, k]))
        assert torch.equal(now["preview"], w[:, k : k + 4, :2].flatten(1))
        assert torch.equal(now["next", "reward"], -PLANT.cost(x, u, w[:, k]).unsqueeze(-1))
        x = PLANT.step(x, u, w[:, k])
        assert torch.equal(now["next", "state"], x)
        assert torch.equal(now["next", "preview"], w[:, k + 1 : k + 5, :2].flatten(1))
    assert not data["next", "terminated"].any()
    assert data["next", "truncated"].squeeze(-1).nonzero()[:, 1].tolist() == [5] * 4


def test_actions_are_clipped():
    env = make_env(num_envs=2)
    td = env.reset().set("action", torch.tensor([[2.0], [1.0]]).double())
    for name in ("state", "episode", "step_count"):
        td[name] = td[name][:1].expand(2, -1)
    following = env.step(td)["next"]
    assert torch.equal(*following["state"])
    assert torch.equal(*following["reward"])


def test_bad_arguments_are_an_error():
    with pytest.raises(QPError, match="plant: got int, expected a Plant"):
        PlantEnv(3, 1, 5)  # pyright: ignore[reportArgumentType]
    with pytest.raises(QPError, match="n_y: got 0, expected a whole number >= 1"):
        Store(n_y=0)
