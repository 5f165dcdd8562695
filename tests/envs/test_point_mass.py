"""The physics, and that both environments are nothing but the physics."""

from __future__ import annotations

import copy
import importlib
import warnings
from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector
from torchrl.envs import SerialEnv, check_env_specs

import torch_qpmpc.envs
from torch_qpmpc.envs import PointMass, PointMassEnv, PointMassGymEnv
from torch_qpmpc.errors import QPError

KINDS = ["gaussian", "brownian"]


class StaggeredEnv(PointMassEnv):
    """The episodes' clocks start apart, so that every later reset is a partial one."""

    def _reset(self, tensordict=None, **kwargs):
        out = super()._reset(tensordict, **kwargs)
        if tensordict is None or "_reset" not in tensordict:
            out["step_count"] = torch.arange(self.batch_size[0]).unsqueeze(-1) % self.max_steps
        return out


def linear_policy() -> TensorDictModule:
    torch.manual_seed(0)
    net = torch.nn.Sequential(torch.nn.Linear(4, 2), torch.nn.Tanh())
    return TensorDictModule(net, in_keys=["observation"], out_keys=["action"])


def collect(env: PointMassEnv, batches: int, steps: int) -> Any:
    """TensorDict of ``(num_envs, batches * steps)`` transitions."""
    collector = Collector(
        env,
        linear_policy(),
        frames_per_batch=steps * env.batch_size[0],
        total_frames=batches * steps * env.batch_size[0],
        auto_register_policy_transforms=False,
    )
    data: list[Any] = [batch.clone() for batch in collector]
    collector.shutdown()
    return torch.cat(data, dim=1)


# --- PointMass ---------------------------------------------------------------------------------


def test_step_and_cost_are_the_papers():
    p = PointMass()
    s, a = torch.tensor([1.0, -1.0, 2.0, 4.0]), torch.tensor([0.5, -1.0])
    nu = torch.tensor([0.01, 0.02, 0.03, 0.04])
    expected = torch.tensor([1.21, -0.58, 1.88, 3.54], dtype=torch.float64)
    torch.testing.assert_close(p.step(s, a, nu), expected, atol=1e-7, rtol=0)
    assert p.cost(s, a).item() == 3 + 3 + 0.25 * 4 + 0.25 * 16
    assert p.cost(s.expand(5, 3, 4), a.expand(5, 3, 2)).shape == (5, 3)


def test_actions_and_states_are_clipped_to_their_bounds():
    p, zero = PointMass(), torch.zeros(4)
    s = torch.tensor([1.99, -1.99, 10.0, -10.0])
    torch.testing.assert_close(
        p.step(s, 50 * torch.ones(2), zero), p.step(s, torch.ones(2), zero), atol=0, rtol=0
    )
    assert p.step(s, torch.zeros(2), zero)[:2].tolist() == [2, -2]


def test_gaussian_noise_is_independent_and_brownian_noise_a_random_walk():
    normal = torch.randn(20_000, 30, 4, generator=torch.Generator().manual_seed(0))
    for kind, std in (("gaussian", 0.01), ("brownian", 0.002)):
        p, nu, path = PointMass(kind), torch.zeros(20_000, 4), []
        for k in range(30):
            nu = p.noise(nu, normal[:, k])
            path.append(nu)
        last, before = path[-1], path[-11]
        correlation = ((last * before).mean() / (last.std() * before.std())).item()
        grown, correlated = (30**0.5, (20 / 30) ** 0.5) if kind == "brownian" else (1, 0)
        assert last.mean().item() == pytest.approx(0, abs=4 * std * grown / 80_000**0.5)
        assert last.std().item() == pytest.approx(std * grown, rel=0.02)
        assert correlation == pytest.approx(correlated, abs=0.02)


def test_corrupted_draws_A_then_B_then_theta():
    p, rng = PointMass(), np.random.default_rng(3)
    dA, dB = rng.uniform(-0.05, 0.05, (4, 4)), rng.uniform(-0.05, 0.05, (4, 2))
    theta = rng.uniform(0.5, 5, 4)
    A_hat, B_hat, theta_hat = p.corrupted(3)
    torch.testing.assert_close(A_hat - p.A, torch.tensor(dA), atol=1e-15, rtol=0)
    torch.testing.assert_close(B_hat - p.B, torch.tensor(dB), atol=1e-15, rtol=0)
    assert theta_hat.tolist() == theta.tolist()
    assert all(torch.equal(x, y) for x, y in zip(p.corrupted(3), p.corrupted(3), strict=True))
    assert not torch.equal(p.corrupted(4)[0], A_hat)


def test_the_kind_alone_changes_the_default_noise():
    assert replace(PointMass(), noise_kind="brownian").std == 0.002
    assert PointMass("brownian", noise_std=0.5).std == 0.5
    assert PointMass().to("cpu").A.dtype == torch.float64


def test_bad_noise_is_an_error():
    match = "noise_kind: got 'pink', expected 'gaussian' or 'brownian'"
    with pytest.raises(QPError, match=match):
        PointMass("pink")
    for std in (-0.1, float("nan"), float("inf")):
        with pytest.raises(QPError, match=rf"noise_std: got {std}, expected a finite number >= 0"):
            PointMass(noise_std=std)


# --- Gymnasium ---------------------------------------------------------------------------------


def test_gymnasium_finds_nothing_to_complain_about():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gymnasium.make("torch_qpmpc/PointMass-v0").unwrapped)


def test_importing_again_does_not_register_again():
    spec = gymnasium.registry["torch_qpmpc/PointMass-v0"]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        importlib.reload(torch_qpmpc.envs)
    assert gymnasium.registry["torch_qpmpc/PointMass-v0"] is spec


@pytest.mark.parametrize("kind", KINDS)
def test_gymnasium_environment_follows_the_physics(kind):
    p = PointMass(kind)
    env = gymnasium.make("torch_qpmpc/PointMass-v0", physics=p)
    rng, actions = np.random.default_rng(7), np.random.default_rng(8)
    observation, _ = env.reset(seed=7)
    s, nu, ends = p.starts(rng, 1)[0], torch.zeros(4), []
    np.testing.assert_array_equal(observation, s.float().numpy())
    for _ in range(50):
        action = actions.uniform(-1, 1, 2).astype(np.float32)
        a = torch.as_tensor(action)
        observation, reward, terminated, truncated, _ = env.step(action)
        assert reward == -p.cost(s, a).item()
        nu = p.noise(nu, torch.as_tensor(rng.standard_normal(4)))
        s = p.step(s, a, nu)
        np.testing.assert_array_equal(observation, s.float().numpy())
        assert not terminated
        ends.append(truncated)
    assert ends == [False] * 49 + [True]


def test_gymnasium_random_walk_restarts_with_the_episode():
    env = PointMassGymEnv(PointMass("brownian", noise_std=1.0))
    first, _ = env.reset(seed=1)
    one = env.step(np.zeros(2, dtype=np.float32))[0]
    again, _ = env.reset(seed=1)
    np.testing.assert_array_equal(again, first)
    np.testing.assert_array_equal(env.step(np.zeros(2, dtype=np.float32))[0], one)


# --- TorchRL -----------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_torchrl_accepts_the_specs(kind, dtype):
    check_env_specs(PointMassEnv(3, PointMass(kind), dtype=dtype, seed=0), seed=0)
    check_env_specs(SerialEnv(2, lambda: PointMassEnv(3, PointMass(kind), dtype=dtype)), seed=0)


@pytest.mark.parametrize("kind", KINDS)
def test_torchrl_environment_follows_the_physics(kind):
    p = PointMass(kind)
    env = PointMassEnv(5, p, dtype=torch.float64, seed=11)
    data = env.rollout(50, policy=linear_policy().double())
    rng = torch.Generator().manual_seed(11)
    s = p.start_range * (2 * torch.rand(5, 4, generator=rng, dtype=torch.float64) - 1)
    nu = torch.zeros(5, 4)
    for k in range(50):
        now = data[:, k]
        torch.testing.assert_close(now["observation"], s, atol=0, rtol=0)
        assert torch.equal(now["next", "reward"], -p.cost(s, now["action"]).unsqueeze(-1))
        nu = p.noise(nu, torch.randn(5, 4, generator=rng, dtype=torch.float64))
        s = p.step(s, now["action"], nu)
        torch.testing.assert_close(now["next", "observation"], s, atol=0, rtol=0)
    assert data.shape == (5, 50)
    assert not data["next", "terminated"].any()
    assert data["next", "truncated"].squeeze(-1).nonzero()[:, 1].tolist() == [49] * 5
    assert torch.equal(data["next", "truncated"], data["next", "done"])


def test_starts_fill_their_range():
    s = PointMassEnv(4000, seed=0).reset()["observation"]
    limits = torch.tensor([1.5, 1.5, 0.5, 0.5])
    assert (s.abs() <= limits).all()
    torch.testing.assert_close(s.std(0), limits / 3**0.5, atol=0, rtol=0.05)
    assert (PointMass().starts(np.random.default_rng(0), 4000).abs().amax(0) > 0.99 * limits).all()


@pytest.mark.parametrize("kind", KINDS)
def test_partial_resets_in_a_collector_restart_exactly_the_finished_episodes(kind):
    env = StaggeredEnv(8, PointMass(kind, noise_std=0.1), max_steps=5, seed=2)
    data = collect(env, batches=20, steps=2)
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

    # What was stored as nu is what entered the dynamics.
    p = env.physics
    following = p.step(data["observation"], data["action"], data["next", "noise"])
    torch.testing.assert_close(data["next", "observation"], following.float())
    if kind == "brownian":
        increments = data["next", "noise"] - data["noise"]
        assert increments.std().item() == pytest.approx(0.1, rel=0.05)
        assert data["next", "noise"].std().item() > 0.13


def test_same_seed_same_rollouts_whatever_the_global_generator_does():
    def rollout(seed):
        env = PointMassEnv(4, seed=seed)
        torch.manual_seed(seed + torch.seed() % 1000)
        return env.rollout(20, policy=linear_policy())["next", "observation"]

    assert torch.equal(rollout(5), rollout(5))
    assert not torch.equal(rollout(5), rollout(6))


def test_without_a_seed_the_global_generator_decides():
    def start():
        torch.manual_seed(9)
        return PointMassEnv(4).reset()["observation"]

    assert torch.equal(start(), start())


def test_saved_generator_continues_the_stream():
    env = PointMassEnv(4, PointMass("brownian"), max_steps=7, seed=1)
    td, state = env.reset(), env.get_rng_state()

    def rollout(env):
        return env.rollout(
            30, linear_policy(), auto_reset=False, tensordict=td, break_when_any_done=False
        )["observation"]

    expected, other = rollout(env), PointMassEnv(4, PointMass("brownian"), max_steps=7, seed=2)
    assert not torch.equal(rollout(other), expected)
    other.set_rng_state(state)
    assert torch.equal(rollout(other), expected)
    env.set_rng_state(state)
    assert torch.equal(rollout(copy.deepcopy(env)), expected)


def test_bad_sizes_are_an_error():
    with pytest.raises(QPError, match="num_envs: got 0, expected an integer >= 1"):
        PointMassEnv(0)
    with pytest.raises(QPError, match="max_steps: got -1, expected an integer >= 1"):
        PointMassEnv(1, max_steps=-1)
