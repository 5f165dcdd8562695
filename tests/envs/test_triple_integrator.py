"""The triple integrator: dynamics, cost and starts, by hand."""

from __future__ import annotations

import numpy as np
import torch

from torch_qpmpc.envs import TripleIntegrator
from torch_qpmpc.envs.triple_integrator import REACH


def test_a_step_and_its_cost_by_hand():
    p = TripleIntegrator()
    x = torch.tensor([[1.0, 2.0, 3.0]]).double()
    u = p.applied(torch.tensor([[-4.0]]))
    w = p.signals(np.random.default_rng(0), 1, 1)[:, 0]
    by_hand = [[1 + 0.4 + 0.06 - 0.008 / 6, 2 + 0.6 - 0.02, 3 - 0.2]]
    torch.testing.assert_close(p.step(x, u, w), torch.tensor(by_hand).double())
    costs = torch.tensor([(1 + 0.4 + 0.09 + 0.01) / 2]).double()
    torch.testing.assert_close(p.cost(x, u, w), costs)
    assert torch.equal(p.output(x, w), x)


def test_starts_fill_their_box():
    for rng in (np.random.default_rng(0), torch.Generator().manual_seed(0)):
        x = TripleIntegrator().starts(rng, 2000) / torch.tensor(REACH)
        assert x.abs().max() <= 1
        assert x.min() < -0.99
        assert x.max() > 0.99


def test_the_model_is_the_plant():
    p, (A, B, offset) = TripleIntegrator(), TripleIntegrator().true_model()
    x, u = torch.tensor([0.3, -0.2, 0.1]).double(), torch.tensor([0.4]).double()
    torch.testing.assert_close(p.step(x, u, x[:0]), A @ x + B @ u + offset)
