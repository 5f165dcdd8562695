"""Windows of past outputs and actions as the observation of a Gymnasium environment."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.envs.registration import EnvSpec
from gymnasium.spaces import Box
from gymnasium.utils.env_checker import check_env

from torch_qpmpc.envs import GymnasiumPlant, WindowObservation
from torch_qpmpc.envs.closed_loop import gymnasium_loop
from torch_qpmpc.errors import QPError


class Sum(gymnasium.Env):
    """The sum of its actions and of the steps; its cost is the output, and it ends at ``last``."""

    def __init__(self, last: int = 1000, low: float = -1.0) -> None:
        self.observation_space = Box(-100.0, 100.0, (1,), np.float64)
        self.action_space = Box(low, 2.0, (1,), np.float32)
        self.last = last

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.k, self.y = 0, np.full(1, 10.0)
        return self.y, {"first": True}

    def step(self, action):
        self.k, self.y = self.k + 1, self.y + 1 + action
        return self.y, -self.y.item(), self.k >= self.last, False, {"first": False}


def test_the_window_has_past_outputs_and_actions():
    env = WindowObservation(Sum(), 3)
    window, info = env.reset(seed=0)
    assert window.tolist() == [10, 0, 11, 0, 12]
    assert (info, env.waited) == ({"first": False}, -11.0 - 12.0)
    window, reward, terminated, truncated, _ = env.step(np.full(1, 0.5, np.float32))
    assert window.tolist() == [11, 0, 12, 0.5, 13.5]
    assert (reward, terminated, truncated) == (-13.5, False, False)
    assert env.reset()[0].tolist() == [10, 0, 11, 0, 12]


@pytest.mark.filterwarnings("ignore:.*WARN")
def test_its_space_is_that_of_the_window():
    env = WindowObservation(Sum(), 2)
    assert env.observation_space == Box(
        np.array([-100.0, -1, -100]), np.array([100.0, 2, 100]), dtype=np.float64
    )
    check_env(env, skip_render_check=True)


def test_it_waits_with_the_action_nearest_to_zero():
    env = WindowObservation(Sum(low=0.5), 2)
    assert env.reset()[0].tolist() == [10, 0.5, 11.5]


def test_an_episode_that_ends_while_it_waits_ends_in_the_first_step():
    env = WindowObservation(Sum(last=1), 3)
    window, _ = env.reset()
    assert window.tolist() == [10, 0, 11, 0, 11]
    assert env.waited == -11
    again, reward, terminated, truncated, _ = env.step(np.full(1, 2.0, np.float32))
    assert again.tolist() == window.tolist()
    assert (reward, terminated, truncated) == (0, True, False)
    assert env.unwrapped.k == 1  # pyright: ignore[reportAttributeAccessIssue]


def test_it_keeps_copies_of_outputs_and_actions():
    class Writes(Sum):
        def step(self, action):
            y = self.y
            self.y, *rest = super().step(action)
            y[:], self.y = self.y, y
            return y, *rest

    env, u = WindowObservation(Writes(), 3), np.full(1, 0.5, np.float32)
    assert env.reset()[0].tolist() == [10, 0, 11, 0, 12]
    env.step(u)
    u[:] = 1
    assert env.step(u)[0].tolist() == [12, 0.5, 13.5, 1, 15.5]


def test_a_step_before_the_first_reset_is_gymnasiums_error():
    env = WindowObservation(gymnasium.make("Pendulum-v1"), 2)
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(np.zeros(1, np.float32))


def test_other_spaces_are_an_error():
    with pytest.raises(
        QPError, match=r"env: got the space Discrete.2., expected Box spaces of one"
    ):
        WindowObservation(gymnasium.make("CartPole-v1"), 2)


@pytest.mark.parametrize("past", [0, 1.5])
def test_a_wrong_past_is_an_error(past):
    with pytest.raises(QPError, match=r"^past: got "):
        WindowObservation(Sum(), past)


@pytest.fixture
def plant(monkeypatch):
    spec = EnvSpec("Sum-v0", lambda **options: Sum(**options), max_episode_steps=6)
    monkeypatch.setitem(gymnasium.registry, "Sum-v0", spec)
    return GymnasiumPlant("Sum-v0").windowed(3)


def test_the_cost_of_an_episode_has_the_steps_that_wait(plant):
    seen = []

    def policy(s):
        seen.append(s)
        return s[:, -1:] * 0 + 0.5

    loop = gymnasium_loop(policy, plant, starts=2)
    assert seen[0].tolist() == [[10, 0, 11, 0, 12]] * 2
    y = [11, 12, 13.5, 15, 16.5, 18]
    assert loop.costs.sum(0).tolist() == [sum(y)] * 2
    assert loop.states[:5, 0].flatten().tolist() == y[1:]


def test_a_windowed_plant_leaves_the_other_as_it_is(plant):
    other = plant.windowed(1)
    assert (other.past, plant.past) == (1, 3)
    assert other.make().observation_space.shape == (1,)
    assert plant.make().observation_space.shape == (5,)
    assert plant.lb_s.tolist() == [-100]
    assert plant.violation(torch.tensor([[500.0, 0, 500, 0, 101]])).tolist() == [1]
    assert plant.vectorised(2, None, seed=0).reset()["observation"].shape == (2, 5)
