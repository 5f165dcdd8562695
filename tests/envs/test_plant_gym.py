"""Plants as Gymnasium environments."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import torch_qpmpc as qm
from tests.store import Store
from torch_qpmpc import QPError
from torch_qpmpc.envs.closed_loop import plant_loop

IDS = [name for name in gymnasium.registry if name.startswith("torch_qpmpc/")]


@pytest.mark.parametrize("name", IDS)
@pytest.mark.filterwarnings("ignore:.*(infinity|not symmetric and normalized)")
def test_gymnasiums_own_check(name):
    check_env(gymnasium.make(name).unwrapped)


@pytest.mark.filterwarnings("ignore:.*(infinity|not symmetric and normalized)")
def test_gymnasiums_own_check_of_a_plant():
    check_env(qm.envs.PlantGymEnv(Store(), 20))


@pytest.mark.parametrize("past", [1, 3])
def test_it_is_the_closed_loop_of_the_same_seed(past):
    plant = Store(past=past)
    env = qm.envs.PlantGymEnv(plant, 20)
    middle = (plant.lb_a + plant.ub_a) / 2
    loop = plant_loop(lambda p: middle + p[:, -1:] / 100, plant, steps=20, starts=1, seed=5)
    observation, _ = env.reset(seed=5)
    for k in range(20):
        np.testing.assert_allclose(observation, loop.known[k, 0], rtol=1e-6)
        action = (middle + loop.known[k, :, -1:] / 100)[0].numpy()
        observation, reward, terminated, truncated, info = env.step(action)
        assert reward == pytest.approx(-loop.costs[k].item(), rel=1e-9)
        assert (terminated, truncated) == (False, k == 19)
        assert info["violation"] >= 0


def test_a_policy_predicts_from_its_observations():
    env = qm.envs.PlantGymEnv(Store(horizon=8), max_steps=3)
    mpc = qm.QPMPC(1, 1, 8, past=2, n_d=2, action_bounds=([0.0], [1.0]), stage_weight=[1.0, 0.1])
    observation, _ = env.reset(seed=0)
    action = mpc.predict(observation)
    assert action.dtype == np.float32
    assert env.action_space.contains(action)


def test_mistakes_are_named():
    env = qm.envs.PlantGymEnv(Store(), max_steps=1)
    with pytest.raises(QPError, match=r"^step: got no episode, expected one that runs. Call reset"):
        env.step(np.ones(1))
    env.reset()
    with pytest.raises(QPError, match=r"^action: got .*, expected finite numbers of shape \(1,\)"):
        env.step(np.ones(2))
    env.step(np.ones(1))
    with pytest.raises(QPError, match=r"^step: got no episode"):
        env.step(np.ones(1))
    with pytest.raises(QPError, match=r"^plant: got PointMass, expected a Plant"):
        qm.envs.PlantGymEnv(qm.envs.PointMass(), max_steps=1)  # pyright: ignore[reportArgumentType] - the mistake
    with pytest.raises(QPError, match=r"^max_steps: got 0, expected a whole number >= 1"):
        qm.envs.PlantGymEnv(Store(), max_steps=0)
