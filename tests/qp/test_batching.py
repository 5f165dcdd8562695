import pytest
import torch
from torch.testing import assert_close

from tests.problems import known_qp, normal
from torch_qpmpc import solve_qp
from torch_qpmpc.qp.batching import outer, weighted_sum


@pytest.mark.parametrize("n", [0, 1, 3])
@pytest.mark.parametrize("batch", [(), (4,), (2, 3), (0,)])
def test_sums_over_the_batch(batch, n):
    left, right, weight = normal(*batch, n), normal(*batch, 2, seed=1), normal(*batch, seed=2)
    products = left.unsqueeze(-1) * right.unsqueeze(-2)
    assert_close(outer(left, right, normal(n, 2)), products.sum_to_size(n, 2))
    weighted = (weight.unsqueeze(-1) * left).sum_to_size(n)
    assert_close(weighted_sum(weight, left, normal(n)), weighted)


@pytest.mark.parametrize("missing", [{"n_c": 0}, {"n_f": 0}, {"soft": (), "hard": ()}], ids=str)
def test_a_shared_part_without_entries_has_a_gradient_without_entries(missing):
    known = known_qp(0, batch=(3,), **missing)
    leaves = [x.requires_grad_() for x in known.qp.tensors()]
    solution = solve_qp(known.qp, known.fixed, solver="daqp")
    for part in (solution.value, solution.z):
        gradients = torch.autograd.grad(part.sum(), leaves, retain_graph=True, allow_unused=True)
        for leaf, gradient in zip(leaves, gradients, strict=True):
            assert gradient is None or gradient.shape == leaf.shape
