"""Gains against the regulator."""

import pytest
import torch

from torch_qpmpc import QPMPC
from torch_qpmpc.analysis.policy import spectral_radius
from torch_qpmpc.mpc.riccati import stage_weight

A = torch.tensor([[1.0, 0.2], [-0.1, 1.1]], dtype=torch.float64)
B = torch.tensor([[0.0, 0.1], [0.3, 0.1]], dtype=torch.float64)


@pytest.mark.parametrize("hessian", ["diagonal", "block"])
def test_stage_weight_is_that_of_the_first_pair(hessian):
    weight = torch.tensor([2.0, 1.0, 0.3, 0.5])
    mpc = QPMPC.from_model(A, B, 3, hessian=hessian, stage_weight=weight, learn=("H", "C"))
    torch.testing.assert_close(stage_weight(mpc), torch.diag(weight).double())


def test_spectral_radius():
    diagonal = torch.diag(torch.tensor([0.5, -1.2])).double()
    nothing = torch.zeros(2, 2).double()
    assert spectral_radius(diagonal, B, nothing).item() == pytest.approx(1.2)
    rotation = torch.tensor([[0.0, -0.9], [0.9, 0.0]]).double()
    both = spectral_radius(torch.stack((diagonal, rotation)), B, nothing)
    assert both.tolist() == pytest.approx([1.2, 0.9])
