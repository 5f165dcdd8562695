"""Data in two forms, each made of the other when it is asked for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pytest
import torch
from torch import Tensor

from torch_qpmpc.qp.twofold import Twofold


class PairArrays(NamedTuple):
    x: np.ndarray
    y: np.ndarray


@dataclass(frozen=True)
class Pair(Twofold[PairArrays]):
    Arrays = PairArrays

    x: Tensor
    y: Tensor
    label: str = ""


def of_arrays() -> Pair:
    return Pair.of_arrays(PairArrays(np.zeros(2), np.ones(3)), torch.device("cpu"), label="a")


def test_tensors_are_made_of_arrays_once():
    pair = of_arrays()
    assert pair.y is pair.y
    assert torch.equal(pair.y, torch.ones(3, dtype=torch.float64))
    assert pair.label == "a"
    assert "x" not in vars(pair)


def test_all_tensors_can_be_made_at_once():
    pair = of_arrays()
    x, y = pair.all_tensors()
    assert x is pair.x
    assert y is pair.y


def test_arrays_are_made_of_tensors_once():
    columns = torch.arange(6.0).reshape(2, 3).mT
    pair = Pair(columns, torch.ones(3))
    assert pair.device == torch.device("cpu")
    assert pair.arrays is pair.arrays
    assert pair.arrays.x.flags.c_contiguous  # as the kernels ask
    assert np.array_equal(pair.arrays.x, columns.numpy())


def test_on_the_cpu_both_forms_are_one_memory():
    pair = of_arrays()
    pair.x[0] = 7.0
    assert pair.arrays.x[0] == 7.0


def test_arrays_of_tensors_that_have_changed_are_made_anew():
    pair = Pair(torch.zeros(3, 2).mT, torch.ones(3))
    assert not pair.arrays.x.any()
    pair.x.fill_(5.0)
    pair.forget_arrays()
    assert (pair.arrays.x == 5.0).all()


@pytest.mark.parametrize("pair", [of_arrays(), Pair(torch.zeros(2), torch.ones(3))])
def test_what_neither_form_has_is_an_attribute_error(pair):
    with pytest.raises(AttributeError, match="Pair has no 'z'"):
        _ = pair.z
