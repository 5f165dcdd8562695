"""Windows of past outputs and actions, in any TorchRL environment."""

from __future__ import annotations

from functools import partial
from typing import Any

import gymnasium
import pytest
import torch
from gymnasium.vector import AutoresetMode
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.collectors import Collector, MultiSyncCollector
from torchrl.envs import (
    Compose,
    DoubleToFloat,
    GymEnv,
    GymWrapper,
    ParallelEnv,
    SerialEnv,
    StepCounter,
    TransformedEnv,
    check_env_specs,
)

from torch_qpmpc.envs import PastWindow, PointMass, PointMassEnv
from torch_qpmpc.errors import QPError

ID, PAST = "Pendulum-v1", 3
STEPS = 7


def transformed(env: Any, *transforms: Any) -> Any:
    compose: Any = Compose
    return TransformedEnv(env, compose(*transforms))


def pendulum() -> Any:
    return GymEnv(ID)


def windowed() -> Any:
    return transformed(pendulum(), StepCounter(STEPS), PastWindow(PAST))


def vectorised(count: int = 3) -> Any:
    disabled = {"autoreset_mode": AutoresetMode.DISABLED}
    options: Any = {"vectorization_mode": "sync", "vector_kwargs": disabled}
    envs = gymnasium.make_vec(ID, count, max_episode_steps=STEPS, **options)
    return transformed(GymWrapper(envs), DoubleToFloat(), PastWindow(PAST))


def make_policy() -> Any:
    torch.manual_seed(0)
    net = torch.nn.Sequential(torch.nn.Linear(11, 1), torch.nn.Tanh())
    return TensorDictModule(net, in_keys=["observation"], out_keys=["action"])


def check_windows(data: Any) -> None:
    """Check every window ``(envs, T)`` against the outputs and actions of its episode."""
    done, y, u = data["next", "done"].squeeze(-1), data["observation"][..., -3:], data["action"]
    following = data["next", "observation"]
    for i in range(data.shape[0]):
        past: list[Tensor] = []
        for k in range(data.shape[1]):
            if not past:
                past = [y[i, k], torch.zeros(1)] * (PAST - 1) + [y[i, k]]
            assert torch.equal(data["observation"][i, k], torch.cat(past))
            past = [*past[2:], u[i, k], following[i, k, -3:]]
            assert torch.equal(following[i, k], torch.cat(past))
            past = [] if done[i, k] else past


@pytest.mark.parametrize(
    "env",
    [
        windowed,
        vectorised,
        partial(SerialEnv, 2, windowed),
        lambda: transformed(SerialEnv(2, pendulum), StepCounter(STEPS), PastWindow(PAST)),
        lambda: transformed(pendulum(), PastWindow(1), PastWindow(PAST)),
    ],
    ids=["one", "vectorised", "inside of a batch", "outside of a batch", "after another"],
)
def test_windows_are_those_of_each_episode(env):
    made = env()
    check_env_specs(made, seed=0)
    made.set_seed(0)
    data = made.rollout(20, make_policy(), break_when_any_done=False)
    if len(data.batch_size) == 1:
        data = data.unsqueeze(0)
    data["next", "done"][:, -1] = True
    check_windows(data)
    made.close()


@pytest.mark.slow
def test_windows_in_a_worker_process():
    env = ParallelEnv(1, windowed)
    check_env_specs(env, seed=0)
    check_windows(env.rollout(20, make_policy(), break_when_any_done=False))
    env.close()


def test_windows_in_a_collector():
    env = vectorised()
    collector = Collector(
        env,
        make_policy(),
        frames_per_batch=6,
        total_frames=60,
        auto_register_policy_transforms=False,
    )
    check_windows(torch.cat([batch.clone() for batch in collector], dim=1))
    collector.shutdown()


@pytest.mark.slow
def test_windows_in_a_collector_of_another_process():
    collector = MultiSyncCollector(
        [vectorised],
        make_policy(),
        frames_per_batch=6,
        total_frames=60,
        auto_register_policy_transforms=False,
    )
    batches = [batch.clone() for batch in collector]
    check_windows(torch.cat([batch.reshape(-1, batch.shape[-1]) for batch in batches], dim=1))
    collector.shutdown()


def test_a_window_of_one_changes_nothing():
    def rollout(*transforms):
        env = transformed(PointMassEnv(3, PointMass(), 5, seed=0), *transforms)
        torch.manual_seed(0)
        return env.rollout(12, break_when_any_done=False)

    assert (rollout(PastWindow(1)) == rollout()).all()


def test_the_first_actions_and_the_keys_are_options():
    fill = torch.tensor([0.25, -0.5])
    env = TransformedEnv(PointMassEnv(3, seed=0), PastWindow(2, fill=fill))
    assert torch.equal(env.reset()["observation"][:, 4:6], fill.expand(3, -1))
    env = TransformedEnv(PointMassEnv(3, seed=0), PastWindow(2, fill=0.25))
    assert (env.reset()["observation"][:, 4:6] == 0.25).all()
    env = TransformedEnv(PointMassEnv(3, seed=0), PastWindow(2, observation_key="noise"))
    assert env.reset()["noise"].shape == (3, 10)
    assert env.observation_spec["observation"].shape == (3, 4)


def test_bad_arguments_are_an_error():
    with pytest.raises(QPError, match="past: got 0, expected a whole number >= 1"):
        PastWindow(0)
    with pytest.raises(QPError, match="fill: got 'a', expected a number or"):
        PastWindow(2, fill="a")
    env = TransformedEnv(pendulum(), PastWindow(2, observation_key="s"))
    with pytest.raises(QPError, match="observation_key: got s, expected one of observation"):
        _ = env.observation_spec
    with pytest.raises(QPError, match=r"fill: got shape \(2,\), expected shape \(1,\)"):
        TransformedEnv(pendulum(), PastWindow(2, fill=[0.0, 1.0])).reset()
