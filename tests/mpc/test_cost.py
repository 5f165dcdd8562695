"""The cost of a scheme: its weights, and messages."""

import pytest
import torch

from tests.refused import refused
from torch_qpmpc import QPMPC, Cost, Layout, Model, QPError, Scheme

LAYOUT, MODEL = Layout(2, 1, 3), Model(torch.eye(2), torch.ones(2, 1))


def test_q_and_c_are_without_discounts():
    q = torch.arange(11.0)
    mpc = QPMPC(Scheme(LAYOUT, MODEL, Cost([1.0, 1.0, 0.1], q=q, c=3.0), gamma=0.5))
    assert torch.equal(mpc.q, q.double())
    powers = torch.tensor([1.0, 0.5, 0.25]).repeat_interleave(3)
    powers = torch.cat((powers, torch.tensor([0.125, 0.125])))
    torch.testing.assert_close(mpc.quadratic_program().q, (powers * q).double())
    assert mpc.c == 3


@refused(({"stage_weight": [1.0, torch.inf, 0.0]}, "stage_weight: got NaN or inf"))
def test_bad_arguments_are_named(arguments):
    Cost(**arguments)


@refused(
    ({"stage_weight": [1.0, 1.0]}, r"stage_weight: got shape \(2,\), expected shape \(3,\)"),
    ({"stage_weight": torch.ones(4, 3)}, r"stage_weight: got shape \(4, 3\), expected shape \(3,"),
    ({"stage_weight": [1.0, -2.0, 0.0]}, "stage_weight: got smallest eigenvalue -2"),
    ({"terminal_weight": [1.0]}, r"terminal_weight: got shape \(1,\), expected shape \(2,\)"),
    (
        {"terminal_weight": [[1.0, 2.0], [2.0, 1.0]], "hessian": "block"},
        "terminal_weight: got smallest eigenvalue -1, expected a positive semidefinite weight",
    ),
    (
        {"terminal_weight": [[1.0, 0.5], [0.0, 1.0]], "hessian": "block"},
        r"terminal_weight: got asymmetry 0.5, .* Pass \(W \+ W.mT\) / 2",
    ),
    ({"q": [1.0]}, r"q: got shape \(1,\), expected shape \(11,\)"),
)
def test_a_scheme_refuses_a_cost_that_does_not_fit(arguments):
    cost = Cost(**({"stage_weight": [1.0, 1.0, 0.1]} | arguments))
    Scheme(LAYOUT, MODEL, cost)


def test_an_asymmetry_is_relative_to_its_row_and_column():
    """Rounding beside 1e10 is none, and 1e-3 of an entry of 1e-9 is one."""
    weight = torch.tensor([[1e10, 1e3, 0.0], [1e3, 1e-3, 0.0], [0.0, 0.0, 1.0]]).double()
    slight, wrong = weight.clone(), 1e-9 * torch.eye(3).double()
    slight[0, 1] += 1e-6
    wrong[0, 1] = 1e-12
    Scheme(LAYOUT, MODEL, Cost(slight, hessian="block"))
    with pytest.raises(QPError, match=r"^stage_weight: got asymmetry 1e-12"):
        Scheme(LAYOUT, MODEL, Cost(wrong, hessian="block"))
