"""The plants that have a function or a known optimum."""

import gymnasium
import numpy as np
import pytest

from tests.benchmarks.plants import CONVERSE, Converse, pendulum


@pytest.mark.parametrize("name", CONVERSE)
def test_the_known_optimum_solves_bellmans_equation(name):
    plant, rng = CONVERSE[name], np.random.default_rng(0)
    for x in rng.uniform(-plant.starts, plant.starts, (20, len(plant.starts))):
        u = plant.optimum(x)

        def Q(u, x=x):
            noise = plant.noise**2 @ plant.P.diagonal()
            after = plant.f(x) + plant.G(x) @ u
            return plant.cost(x, u) + plant.gamma * (plant.V(after) + noise)

        assert np.isclose(Q(u), plant.V(x), rtol=1e-9)
        assert all(Q(u + change) > Q(u) for change in rng.normal(size=(4, len(u))))


def test_an_episode_has_the_plants_cost_and_noise():
    name = "Unicycle"
    env, plant = Converse(name), CONVERSE[name]
    x, _ = env.reset(seed=1)
    u = np.array([1.0, -2.0])
    after, reward, *_ = env.step(u)
    assert -reward == plant.cost(x, u)
    noise = np.abs(after - plant.f(x) - plant.G(x) @ u)
    assert np.all((noise > 0) & (noise < 5 * plant.noise))


def test_the_pendulum_is_gymnasiums():
    env = gymnasium.make("Pendulum-v1")
    y, _ = env.reset(seed=1)
    s = np.arctan2(y[1], y[0]), y[2]
    for torque in np.random.default_rng(0).uniform(-2, 2, 50):
        y, reward, *_ = env.step(np.array([torque]))
        s, cost = pendulum(s, torque)
        np.testing.assert_allclose(-float(reward), cost, rtol=0, atol=1e-4)
    np.testing.assert_allclose(y, (np.cos(s[0]), np.sin(s[0]), s[1]), rtol=0, atol=1e-4)
