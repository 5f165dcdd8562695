"""Weights of TD errors: their size, their limits, and what they are good for."""

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from tests.problems import normal
from torch_qpmpc.learning.td_error import FLOOR, inverse_variance

COUNT = 4000


def pairs() -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return p, a, Q and usable pairs; a is spread over two decades."""
    p, a = normal(COUNT, 2, seed=0), torch.exp(normal(COUNT, 1, seed=1)) * normal(COUNT, 1, seed=2)
    return p, a, 5 + p[:, 0].abs(), torch.ones(COUNT).bool()


def test_the_weights_are_one_over_the_variance():
    p, a, value, use = pairs()
    variance = (0.05 + (a - a.mean()).square() / a.var(correction=0))[:, 0]
    error = variance.sqrt() * normal(COUNT, seed=3)
    weight = inverse_variance(p, a, value, error, use)
    expected = 1 / (variance / variance.median()).clamp(min=FLOOR)
    assert_close(weight.mean(), torch.ones(()).double())
    assert_close(weight, expected / expected.mean(), rtol=0.4, atol=0)
    assert weight.max() > 100 * weight.min()


def test_errors_of_one_variance_have_equal_weights():
    p, a, value, use = pairs()
    weight = inverse_variance(p, a, value, normal(COUNT, seed=3), use)
    assert_close(weight, torch.ones_like(weight), rtol=0.25, atol=0)


def test_unusable_pairs_do_not_count():
    p, a, value, use = pairs()
    error = a[:, 0] * normal(COUNT, seed=3)
    use[::3] = False
    weight = inverse_variance(p, a, value, error, use)
    assert_close(weight[use], inverse_variance(p[use], a[use], value[use], error[use], use[use]))
    assert (weight[~use] == 1).all()


def test_units_of_signals_and_costs_change_no_weight():
    p, a, value, use = pairs()
    p[:, 1] = 0.3  # a constant entry tells nothing
    error = a[:, 0] * normal(COUNT, seed=3)
    weight = inverse_variance(p, a, value, error, use)
    for unit, cost in ((1e-7, 1e8), (1e6, 1e-12)):
        other = inverse_variance(p * unit, a / unit, value * cost, error * cost, use)
        assert_close(other, weight, rtol=1e-4, atol=0)


def test_few_pairs_or_errors_of_zero_have_weight_one():
    p, a, value, use = pairs()
    few = slice(0, 15)
    assert (inverse_variance(p[few], a[few], value[few], a[few, 0], use[few]) == 1).all()
    assert (inverse_variance(p, a, value, torch.zeros(COUNT).double(), use) == 1).all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_equal_inputs_leave_the_weights_finite(dtype):
    p, a, value, use = (x[:32] for x in pairs())
    inputs = (0 * p, 0 * a, 0 * value + 1, a[:, 0])
    p, a, value, error = (x.to(dtype) for x in inputs)
    weight = inverse_variance(p, a, value, error, use)
    assert_close(weight, torch.ones(32, dtype=dtype))


def test_a_batch_in_float32_has_the_weights_of_float64():
    p, a, value, use = pairs()
    inputs = (p, a, value, a[:, 0] * normal(COUNT, seed=3))
    weight = inverse_variance(*inputs, use)
    p, a, value, error = (x.float() for x in inputs)
    single = inverse_variance(p, a, value, error, use)
    assert_close(single, weight.float(), rtol=1e-3, atol=0)
