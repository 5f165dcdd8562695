"""TD errors: the visited pairs that an update can learn from."""

import warnings

import pytest
import torch

from torch_qpmpc.learning.td_error import usable


def test_pairs_lack_a_solution_or_a_target():
    value = torch.tensor([3.0, 3.0, torch.inf, torch.inf])  # an unsolved QP's cost is infinite
    target = torch.tensor([1.0, torch.nan, 2.0, torch.inf])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert usable(value, target).tolist() == [True, False, False, False]


def test_no_pair_is_left():
    message = "None of the 2 pairs is usable: 1 without a QP solution, 1 without a finite target"
    with pytest.warns(RuntimeWarning, match=message):
        usable(torch.tensor([3.0, torch.inf]), torch.full((2,), torch.nan))
