"""What all vectorised environments keep in TorchRL: their specs, and their streams of numbers."""

import copy
from collections.abc import Callable
from functools import partial
from typing import Any

import pytest
import torch
from torchrl.envs import ObservationNorm, SerialEnv, TransformedEnv, check_env_specs

from tests.envs.test_kalman_filter import model
from tests.rollouts import Staggered, collected, network_policy
from tests.store import Store
from torch_qpmpc import envs


def observed(*arguments: Any, **options: Any) -> Any:
    return TransformedEnv(
        envs.PlantEnv(Store(), *arguments, **options), envs.KalmanFilter(model(3, 2, 2))
    )


ENVS = {
    "gaussian": partial(envs.LinearSystemEnv, envs.PointMass("gaussian")),
    "brownian": partial(envs.LinearSystemEnv, envs.PointMass("brownian")),
    "gros_zanon": partial(envs.LinearSystemEnv, envs.GrosZanonLTI()),
    "preview": partial(envs.PlantEnv, Store()),
    "no preview": partial(envs.PlantEnv, Store(n_d=0)),
    "estimate": observed,
}


@pytest.fixture(params=ENVS)
def make(request: pytest.FixtureRequest) -> Callable[..., Any]:
    return ENVS[request.param]


def test_torchrl_accepts_the_specs(make):
    check_env_specs(make(3, 5, dtype=torch.float64, seed=0), seed=0)
    check_env_specs(SerialEnv(2, lambda: make(3, 5, dtype=torch.float32)), seed=0)


def test_a_transform_of_the_observation_does_not_move_the_plant(make):
    env = make(4, 6, seed=5)
    halved = TransformedEnv(make(4, 6, seed=5), ObservationNorm(0.0, 0.5, ["observation"]))
    action = torch.ones(4, *env.action_spec.shape[1:])
    plain, other = (x.rollout(5, lambda td: td.set("action", action)) for x in (env, halved))
    torch.testing.assert_close(other["observation"], 0.5 * plain["observation"])
    assert torch.equal(other["next", "reward"], plain["next", "reward"])


def test_rollouts_depend_on_the_seed_only(make):
    def rollout(seed, reseed=None):
        env = make(4, 6, seed=seed)
        if reseed is not None:
            env.set_seed(reseed)
        policy = network_policy(env)
        torch.seed()
        return env.rollout(5, policy)

    assert (rollout(5) == rollout(5)).all()
    assert (rollout(6, reseed=5) == rollout(5)).all()
    assert not (rollout(5) == rollout(6)).all()


def test_exploration_after_the_same_seed_is_not_the_noise():
    class Own(envs.PointMass):
        stream = envs.LinearSystem.stream

    own, torchs = Own().vectorised(4, 6, seed=5).rng, torch.Generator().manual_seed(5)
    draws = [torch.rand(5000, generator=rng, dtype=torch.float64) for rng in (own, torchs)]
    assert not torch.isin(*draws).any()


def test_without_a_seed_the_global_generator_decides(make):
    def rollout():
        torch.manual_seed(9)
        return make(4, 5).rollout(1)

    assert (rollout() == rollout()).all()


def test_saved_generator_continues_the_stream(make):
    env, other = make(4, 3, seed=1), make(4, 3, seed=1)
    td, state, policy = env.reset(), env.rng.get_state(), network_policy(env)

    def rollout(env):
        options = {"auto_reset": False, "break_when_any_done": False, "tensordict": td.clone()}
        return env.rollout(9, policy, **options)["observation"]

    expected = rollout(env)
    other.reset()
    other.rollout(2)
    assert not torch.equal(rollout(other), expected)
    for one in (other, env):
        one.rng.set_state(state)
        assert torch.equal(rollout(copy.deepcopy(one)), expected)


class StaggeredSystem(Staggered, envs.LinearSystemEnv):
    """Episodes that start at different steps, so that every later reset is partial."""


class StaggeredPlant(Staggered, envs.PlantEnv):
    """The same of a plant with previews."""


@pytest.mark.parametrize(
    ("kind", "plant", "begun"),
    [
        (StaggeredSystem, envs.PointMass("gaussian", noise_std=0.1), "noise"),
        (StaggeredSystem, envs.PointMass("brownian", noise_std=0.1), "noise"),
        (StaggeredSystem, envs.GrosZanonLTI(), "noise"),
        (StaggeredPlant, Store(horizon=3), "pump"),
    ],
)
def test_partial_resets_in_a_collector_restart_exactly_the_finished_episodes(kind, plant, begun):
    env = kind(plant, 8, 5, torch.float64, seed=2)
    data = collected(env, batches=20, steps=2)
    done = data["next", "done"].squeeze(-1)
    assert done.any(0).all(), "every step ends some episode"
    assert not done.all(0).any(), "no step ends all"
    now, then, ended = data[:, 1:], data[:, :-1], done[:, :-1]
    for key in env.observation_spec:
        assert torch.equal(now[key][~ended], then["next", key][~ended]), key
        assert not torch.isclose(now[key][ended], then["next", key][ended]).all(-1).any(), key
    assert (now["step_count"][ended] == 0).all()
    first = now["state"][..., 1] if begun == "pump" else now["noise"]
    assert (first[ended] == 0).all()
    assert ((now["collector", "traj_ids"] != then["collector", "traj_ids"]) == ended).all()
    if begun == "noise":
        following = plant.step(data["observation"], data["action"], data["next", "noise"])
        assert torch.equal(data["next", "observation"], following), "the stored nu entered it"
    if getattr(plant, "noise_kind", "") == "brownian":
        increments = data["next", "noise"] - data["noise"]
        assert increments.std().item() == pytest.approx(0.1, rel=0.05)
        assert data["next", "noise"].std().item() > 0.13
