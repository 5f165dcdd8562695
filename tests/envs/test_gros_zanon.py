"""Gros and Zanon's system: dynamics, cost, violations, noise and starts, by hand."""

import numpy as np
import pytest
import torch

from torch_qpmpc.envs import GrosZanonLTI, LinearSystemEnv


def test_step_cost_and_violation_are_those_of_the_paper():
    p = GrosZanonLTI()
    s = torch.tensor([[0.5, 0.2], [-0.1, 1.5], [1.2, -1.3]], dtype=torch.float64)
    a = torch.tensor([[1.0], [-0.5], [0.0]], dtype=torch.float64)
    nu = torch.tensor([[-0.05, 0], [0, 0], [-0.1, 0]], dtype=torch.float64)
    expected = torch.tensor([[0.5513, 0.42], [0.39435, 1.55], [0.525, -1.43]]).double()
    torch.testing.assert_close(p.step(s, a, nu), expected, atol=1e-7, rtol=0)
    # Violations: none, 0.1 below and 0.5 above, 0.2 above and 0.3 below.
    violations = torch.tensor([0, 0.6, 0.5], dtype=torch.float64)
    torch.testing.assert_close(p.violation(s), violations)
    costs = torch.tensor([0.395, 31.1925, 26.565], dtype=torch.float64)
    torch.testing.assert_close(p.cost(s, a), costs)
    torch.testing.assert_close(GrosZanonLTI(w=0).cost(s, a), costs - 50 * violations)


def test_actions_are_clipped_and_states_are_not():
    p, s, zero = GrosZanonLTI(), torch.tensor([3.0, 2.0]), torch.zeros(2)
    at_the_bound, beyond = torch.ones(1), torch.tensor([50.0])
    assert torch.equal(p.step(s, beyond, zero), p.step(s, at_the_bound, zero))
    assert torch.equal(p.cost(s, beyond), p.cost(s, at_the_bound))
    following = p.step(s, -beyond, zero)
    torch.testing.assert_close(following, torch.tensor([3.3187, 2.0]).double(), rtol=0, atol=1e-6)


def test_noise_is_one_uniform_number_for_the_first_state():
    p, rng = GrosZanonLTI(), np.random.default_rng(0)
    expected = rng.uniform(-0.1, 0.0, size=20_000)
    draw = p.draw(np.random.default_rng(0), 20_000)
    assert draw.shape == (20_000, 1)
    nu = p.noise(torch.ones(20_000, 2), draw)
    np.testing.assert_allclose(nu[:, 0], expected, atol=1e-16, rtol=0)
    assert (nu[:, 1] == 0).all()

    by_torch = p.noise(nu, p.draw(torch.Generator().manual_seed(0), 20_000))[:, 0]
    for e in (nu[:, 0], by_torch):
        assert (e >= -0.1).all()
        assert (e <= 0).all()
        assert e.mean().item() == pytest.approx(-0.05, abs=4 * 0.1 / (12 * 20_000) ** 0.5)
        assert e.std().item() == pytest.approx(0.1 / 12**0.5, rel=0.02)


def test_episodes_start_at_one_state_without_a_draw():
    for rng, untouched in (
        (np.random.default_rng(3), np.random.default_rng(3)),
        (torch.Generator().manual_seed(3), torch.Generator().manual_seed(3)),
    ):
        s = GrosZanonLTI().starts(rng, 4)
        assert s.tolist() == [[0, 0.15]] * 4
        assert torch.equal(GrosZanonLTI().draw(rng, 1), GrosZanonLTI().draw(untouched, 1))
        s[0] = 1
        assert s[1].tolist() == [0, 0.15], "memory of its own"


def test_the_true_model_has_the_mean_of_the_noise():
    plant = GrosZanonLTI()
    A, B, offset = plant.true_model()
    assert A is plant.A
    assert B is plant.B
    draws = plant.noise(torch.zeros(1001, 2), torch.linspace(0, 1, 1001)[:, None])
    torch.testing.assert_close(offset, draws.mean(0), rtol=0, atol=1e-9)


def test_observations_are_unbounded():
    env = LinearSystemEnv(GrosZanonLTI(), 8, 5000)
    far = env.reset()
    far["observation"] += 1e6
    assert env.observation_spec.is_in(far.select(*env.observation_spec.keys()))
    assert env.plant.w == 100
