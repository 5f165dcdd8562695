"""Arguments that `QPMPC` accepts: NumPy integers, lists, and tensors on any default device."""

import warnings

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from torch_qpmpc import QPMPC, QPError
from torch_qpmpc.checks import check_whole
from torch_qpmpc.mpc.validation import as_tensor

A, B = [[1.0, 0.1], [0.0, 0.9]], [[0.0], [0.1]]


@pytest.mark.parametrize("kind", [np.int64, np.int32, np.uint8])
def test_numpys_integers_are_integers(kind):
    check_whole("count", kind(3), 1)
    theta, s = {"A": A, "B": B, "stage_weight": [1.0] * 3}, torch.ones(2, 2)
    mpc, expected = QPMPC.of(kind(2), kind(1), kind(3), **theta), QPMPC.of(2, 1, 3, **theta)
    assert_close(mpc.value(s), expected.value(s), rtol=0, atol=0)


@pytest.mark.parametrize("value", [True, np.True_, 2.0, np.float64(2.0), "2", None, np.int64(0)])
def test_other_than_whole_numbers_are_named(value):
    with pytest.raises(QPError, match=r"count: got .*, expected a whole number >= 1"):
        check_whole("count", value, 1)


def test_lists_are_read_on_a_default_device_of_meta():
    expected = QPMPC.from_model(A, B, 3, stage_weight=[1.0] * 3).state_dict()
    with torch.device("meta"):
        mpc = QPMPC.from_model(A, B, 3, stage_weight=[1.0] * 3)
    assert {x.device.type for x in (*mpc.parameters(), *mpc.buffers())} == {"meta"}
    mpc.to_empty(device="cpu").reset_parameters()
    assert_close(mpc.state_dict(), expected, rtol=0, atol=0)


@pytest.mark.parametrize("kind", [">f8", "g", "f4", "i8", "?"])
def test_an_array_of_any_numbers_that_cannot_be_written_is_read_without_a_warning(kind):
    column = np.ones(2, kind)
    column.flags.writeable = False
    with warnings.catch_warnings(action="error"):
        assert as_tensor("x", column).tolist() == [1, 1]


def test_a_tensor_without_values_is_named():
    with torch.device("meta"):
        value = torch.eye(2)
        with pytest.raises(QPError, match=r"A: got a tensor of torch.float32 on meta, expected"):
            as_tensor("A", value)
