"""The four tanks: dynamics, outputs, cost, noise and starts, by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from torch_qpmpc.envs.four_tanks import FourTanks
from torch_qpmpc.errors import QPError


def test_a_step_an_output_and_a_cost_by_hand():
    p = FourTanks()
    x = torch.tensor([1.0, 2.0, 3.0, 4.0]).double()
    u = torch.tensor([0.5, -1.0]).double()
    w = torch.tensor([0.1, 0.2, 0.3, 0.4, 0.5, -0.5]).double()
    by_hand = [
        0.921 + 3 * 0.041 + 0.5 * 0.017 - 0.001 + 0.1,
        2 * 0.918 + 4 * 0.033 + 0.5 * 0.001 - 0.023 + 0.2,
        3 * 0.924 - 0.061 + 0.3,
        4 * 0.937 + 0.5 * 0.072 + 0.4,
    ]
    torch.testing.assert_close(p.step(x, u, w), torch.tensor(by_hand).double(), atol=1e-7, rtol=0)
    assert p.output(x, w).tolist() == [1.5, 1.5]
    _, u_r = p.set_point()
    inputs = 1e-4 * (u - u_r).square().sum().item()
    by_hand = 35 * ((1 - 0.65) ** 2 + (2 - 0.77) ** 2) + inputs
    # The cost is that of the noiseless outputs.
    assert p.cost(x, u, w).item() == pytest.approx(by_hand, rel=1e-12)


def test_the_set_point_is_steady_and_free_of_cost():
    p = FourTanks()
    x, u = p.set_point()
    nothing = torch.zeros(6).double()
    torch.testing.assert_close(p.step(x, u, nothing), x)
    torch.testing.assert_close(x[:2], p.r)
    assert p.cost(x, u, nothing).item() == pytest.approx(0, abs=1e-20)
    assert (p.lb_a < u).all()
    assert (u < p.ub_a).all()


@pytest.mark.parametrize("rng", [np.random.default_rng(0), torch.Generator().manual_seed(0)])
def test_noise_has_the_two_standard_deviations(rng):
    w = FourTanks(state_std=0.02).signals(rng, 200, 100)
    assert w.shape == (200, 100, 6)
    std = w.flatten(0, 1).std(0)
    torch.testing.assert_close(std[:4], torch.full((4,), 0.02).double(), rtol=0.03, atol=0)
    torch.testing.assert_close(std[4:], torch.full((2,), 0.1).double(), rtol=0.03, atol=0)
    assert w.mean().abs() < 1e-3
    assert not torch.equal(w[0], w[1])


def test_seeds_are_apart_and_starts_are_at_rest():
    p = FourTanks()
    first, again, other = (p.signals(np.random.default_rng(seed), 2, 5) for seed in (1, 1, 2))
    assert torch.equal(first, again)
    assert not torch.isclose(first, other).any()
    assert torch.equal(p.starts(np.random.default_rng(0), 3), torch.zeros(3, 4).double())
    assert (p.n_y, p.n_d) == (2, 0)


@pytest.mark.parametrize("name", ["state_std", "output_std"])
@pytest.mark.parametrize("value", [-0.1, math.inf])
def test_a_standard_deviation_is_a_finite_number(name, value):
    with pytest.raises(QPError, match=f"{name}: got {value}, expected a finite number >= 0"):
        FourTanks(**{name: value})
