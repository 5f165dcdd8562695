"""The point mass: dynamics, cost, noise, starts, and random streams, which must not change."""

from dataclasses import replace

import gymnasium
import numpy as np
import pytest
import torch

from torch_qpmpc.envs import LinearSystemEnv, PointMass, PointMassGymEnv
from torch_qpmpc.envs.closed_loop import closed_loop

# `mark` of the state after three steps without an action, from seed 0, by TorchRL's environment,
# Gymnasium's, and the evaluation. Another random stream would make old runs incomparable.
STREAMS = {
    "gaussian": (4.8465756249529, -2.218637277861, -5.2233684511586),
    "brownian": (4.8806446444929, -2.1625073835243, -5.1438585627065),
}


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


def test_the_kind_alone_changes_the_default_noise():
    assert replace(PointMass(), noise_kind="brownian").std == 0.002
    assert PointMass("brownian", noise_std=0.5).std == 0.5


def test_gymnasium_random_walk_restarts_with_the_episode():
    env = PointMassGymEnv(PointMass("brownian", noise_std=1.0))
    first, _ = env.reset(seed=1)
    one = env.step(np.zeros(2, dtype=np.float32))[0]
    again, _ = env.reset(seed=1)
    np.testing.assert_array_equal(again, first)
    np.testing.assert_array_equal(env.step(np.zeros(2, dtype=np.float32))[0], one)


def mark(states) -> float:
    entries = np.ravel(states)
    return float(entries @ np.sqrt(np.arange(1, len(entries) + 1)))


@pytest.mark.parametrize("kind", STREAMS)
def test_random_streams_stay_as_they_were(kind):
    p, nothing = PointMass(kind), torch.zeros(2, 2, dtype=torch.float64)
    torchrl, gym, evaluation = STREAMS[kind]

    env = LinearSystemEnv(p, 2, dtype=torch.float64, seed=0)
    data = env.rollout(3, policy=lambda td: td.set("action", nothing))
    assert mark(data["next", "observation"][:, -1]) == pytest.approx(torchrl, abs=1e-11)

    one, observation = PointMassGymEnv(p), np.empty(4)
    one.reset(seed=0)
    for _ in range(3):
        observation, *_ = one.step(np.zeros(2, dtype=np.float32))
    assert mark(observation) == pytest.approx(gym, abs=1e-6)

    run = closed_loop(lambda s: nothing, p, steps=3, starts=2, seed=0)
    assert mark(run.states[-1]) == pytest.approx(evaluation, abs=1e-11)


def test_corrupted_stays_as_it_was():
    A_hat, B_hat, theta = PointMass().corrupted(0)
    row = [1.0136961687321455, -0.02302132862361297, 0.05409735239361947, -0.04834723644714709]
    np.testing.assert_allclose(A_hat[0], row, atol=1e-15)
    np.testing.assert_allclose(B_hat[0], [0.03631789223498866, 0.004146122024909174], atol=1e-15)
    expected = [3.2692330016656426, 2.2265489941784757, 4.98744471105145, 4.913759024493036]
    np.testing.assert_allclose(theta, expected, atol=1e-14)


def test_environments_are_of_fifty_steps_with_the_papers_bounds():
    one = gymnasium.make("torch_qpmpc/PointMass-v0")
    assert one.spec.max_episode_steps == 50
    bound = np.array([2, 2, 10, 10], dtype=np.float32)
    assert one.observation_space == gymnasium.spaces.Box(-bound, bound)
    env = LinearSystemEnv(PointMass())
    assert (env.batch_size, env.max_steps) == ((8,), 50)
    far = env.reset()
    far["observation"] += 2 * torch.as_tensor(bound)
    assert not env.observation_spec.is_in(far.select("observation", "noise", "step_count"))
    for environment in (env, one.unwrapped):
        assert isinstance(environment, LinearSystemEnv | PointMassGymEnv)
        assert isinstance(environment.plant, PointMass)
        assert environment.plant.std == 0.01
