"""The model of a scheme: its shapes, and the sizes that follow from it."""

import pytest
import torch

from tests.refused import refused
from torch_qpmpc import Cost, Layout, Model, Scheme

A, B = torch.eye(2), torch.ones(2, 1)


@pytest.mark.parametrize(
    ("model", "layout"),
    [
        (Model(A, B), Layout(2, 1, 5)),
        (Model(A.expand(5, 2, 2), B), Layout(2, 1, 5)),
        (Model(A, B, E=torch.ones(2, 4)), Layout(2, 1, 5, n_d=4)),
    ],
)
def test_a_model_has_sizes(model, layout):
    assert model.layout(5) == layout


def test_its_tensors_are_copies_in_double_precision():
    mine = torch.eye(2)
    model = Model(mine, B.numpy())
    mine.mul_(2)
    assert torch.equal(model.A, torch.eye(2).double())
    assert model.B.dtype == torch.float64


@refused(
    ({"A": [[1.0, torch.nan], [0, 1]]}, "A: got NaN or inf, expected finite entries"),
    ({"A": torch.eye(3)}, r"A, B: got shapes \(3, 3\) and \(2, 1\), expected \(n_x, n_x\) and \(n"),
    ({"A": torch.ones(2, 4)}, r"A, B: got shapes \(2, 4\) and \(2, 1\), expected \(n_x, n_x"),
    ({"A": None}, "A: got None, expected a matrix of x"),
    ({"B": None}, "B: got None, expected a matrix of x"),
)
def test_bad_arguments_are_named(arguments):
    Model(**({"A": A, "B": B} | arguments)).layout(3)


@refused(
    (Model(torch.eye(3), torch.ones(3, 1)), r"A, B: got .* expected \(2, 2\) and \(2, 1\)"),
    (Model(A, torch.ones(2, 2, 1)), r"B: got shape \(2, 2, 1\), expected .* or \(3, 2, 1\)"),
    (Model(A, B, offset=[1.0]), r"offset: got shape \(1,\), expected shape \(2,\)"),
    (Model(A, B, C=torch.ones(6, 10)), r"C: got shape \(6, 10\), expected shape \(6, 11\)"),
)
def test_a_scheme_refuses_a_model_of_other_sizes(model):
    Scheme(Layout(2, 1, 3), model, Cost([1.0, 1.0, 0.1]))
