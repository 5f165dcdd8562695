"""The tanks with references: dynamics, cost, signals and starts, by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from torch_qpmpc.envs.tank_references import TankReferences
from torch_qpmpc.errors import QPError


def signals(plant: TankReferences, seed: int = 0, count: int = 3, length: int = 10) -> torch.Tensor:
    return plant.signals(np.random.default_rng(seed), count, length)


def test_a_nominal_step_and_its_cost_by_hand():
    p = TankReferences(price=10.0)
    x = torch.tensor([1.0, 2.0, 3.0, 21.0]).double()
    u = torch.tensor([0.5, 1.0]).double()
    w = torch.zeros(14).double()
    w[:4] = torch.tensor([1.0, 2.0, 5.0, 21.0])
    by_hand = [
        0.984 + 3 * 0.0422029 + 0.5 * 0.825822 + 0.0101995,
        2 * 0.98895 + 21 * 0.0326014 + 0.5 * 0.00512673 + 0.624648,
        3 * 0.957453 + 0.468317,
        21 * 0.967216 + 0.5 * 0.307042,
    ]
    torch.testing.assert_close(p.step(x, u, w), torch.tensor(by_hand).double(), atol=1e-6, rtol=0)
    assert p.violation(x, w).item() == 1
    assert p.violation(-x, w).item() == 27
    assert p.cost(x, u, w).item() == pytest.approx(4 + 0.1 * 1.25 + 10)


def test_the_model_of_an_episode_conserves_what_the_upper_tanks_lose():
    p = TankReferences(mismatch=1.0, noise_std=0.1)
    w = signals(p, count=50)
    A, B, v = p.model(w)
    dA, gains = A - p.A, B / p.B
    assert torch.equal(A[:, 0], A[:, -1])  # constant for an episode
    assert not torch.isclose(A[0, 0, 0, 0], A[1, 0, 0, 0])
    torch.testing.assert_close(dA[..., 2, 2], -dA[..., 0, 2])
    torch.testing.assert_close(dA[..., 3, 3], -dA[..., 1, 3])
    assert dA.abs().max() <= 0.002
    assert dA.abs().max() > 0.0018
    assert (dA != 0).any(0).any(0).sum() == 6
    gains = gains[..., 0, :]  # one for each pump
    torch.testing.assert_close(B, p.B * gains.unsqueeze(-2))
    assert (gains - 1).abs().max() <= 0.02
    x, u = p.starts(np.random.default_rng(0), 50), torch.ones(50, 2).double()
    following = torch.einsum("nij,nj->ni", A[:, 0], x) + B[:, 0].sum(-1) + v[:, 0]
    torch.testing.assert_close(p.step(x, u, w[:, 0]), following)


def test_references_are_held_and_do_not_depend_on_the_disturbance():
    w = signals(TankReferences(), count=200, length=500)
    assert w.shape == (200, 500, 14)
    assert (w[..., 4:] == 0).all()
    r = w[..., :4]
    assert (r == r[:, :1]).all()
    assert r.min() >= 0
    assert 19 < r.max() <= 20
    assert r.mean().item() == pytest.approx(10, abs=1)
    disturbed = signals(TankReferences(noise_std=0.1, mismatch=1.0), count=200, length=500)
    assert torch.equal(r, disturbed[..., :4])
    assert disturbed[..., 4:8].std().item() == pytest.approx(0.1, rel=0.01)

    changing = signals(TankReferences(hold=4))[..., :4]
    changes = (changing.diff(dim=1) != 0).all(-1)
    assert changes[0].nonzero().flatten().tolist() == [3, 7]


def test_seeds_are_apart_and_starts_are_in_the_range_of_the_original():
    p = TankReferences(noise_std=0.1)
    assert torch.equal(signals(p, 1), signals(p, 1))
    assert not torch.isclose(signals(p, 1)[..., :8], signals(p, 2)[..., :8]).any()
    for rng in (np.random.default_rng(0), torch.Generator().manual_seed(0)):
        x = p.starts(rng, 1000)
        assert x.shape == (1000, 4)
        assert x.min() >= 0
        assert 15 < x.max() <= 16
    assert torch.equal(p.output(x, signals(p)), x)


@pytest.mark.parametrize("name", ["price", "noise_std", "mismatch"])
def test_a_negative_number_is_refused(name):
    with pytest.raises(QPError, match=f"{name}: got -1, expected a finite number >= 0"):
        TankReferences(**dict[str, Any]({name: -1}))
    with pytest.raises(QPError, match="hold: got 0, expected a whole number >= 1"):
        TankReferences(hold=0)
