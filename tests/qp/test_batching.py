import pytest
import torch

from tests.problems import known_qp
from torch_qpmpc import solve_qp


@pytest.mark.parametrize("missing", [{"n_c": 0}, {"n_f": 0}, {"soft": (), "hard": ()}], ids=str)
def test_a_shared_part_without_entries_has_a_gradient_without_entries(missing):
    known = known_qp(0, batch=(3,), **missing)
    leaves = [x.requires_grad_() for x in known.qp.tensors()]
    solution = solve_qp(known.qp, known.fixed, solver="daqp")
    for part in (solution.value, solution.z):
        gradients = torch.autograd.grad(part.sum(), leaves, retain_graph=True, allow_unused=True)
        for leaf, gradient in zip(leaves, gradients, strict=True):
            assert gradient is None or gradient.shape == leaf.shape
