"""The report of a known scheme has its numbers; an unreadable C is refused."""

import math

import pytest
import torch

from torch_qpmpc import QPMPC, QPError
from torch_qpmpc.analysis.report import read, structure_metrics

A = torch.tensor([[1.0, 0.1], [0.0, 0.9]], dtype=torch.float64)
B = torch.tensor([[0.0], [0.1]], dtype=torch.float64)
WRONG_A, WRONG_B = A + torch.tensor([[0.0, 0.03], [-0.04, 0.0]]), 1.5 * B


def scheme() -> QPMPC:
    options = {"stage_weight": [1.0] * 3, "hessian": "block", "solver": "daqp"}
    return QPMPC.from_model(WRONG_A, WRONG_B, 6, **options)


def test_unknown_numbers_are_nan():
    scalars = read(scheme()).scalars()
    unknown = {"radius", "model_error"}
    assert {name for name, value in scalars.items() if math.isnan(value)} == unknown


def test_a_report_without_a_regulator():
    """Without weight on an unstable first state the Riccati equation has no solution."""
    mpc = QPMPC.from_model(
        [[1.2, 0.0], [0.0, 0.5]], [[0.0], [1.0]], 3, stage_weight=[0.0, 1.0, 1.0], solver="daqp"
    )
    found = read(mpc)
    assert found.K_lqr is None
    assert math.isnan(found.gain_to_lqr)


def test_the_gain_is_taken_at_the_given_state():
    mpc = QPMPC.from_model(
        A, B, 4, action_bounds=([-0.5], [0.5]), stage_weight=[9.0, 1.0, 0.01], solver="daqp"
    )
    assert (read(mpc, at=torch.tensor([1.5, 1.0])).K.abs() < 1e-12).all()
    assert (read(mpc).K.abs() > 0.1).any()


@pytest.mark.parametrize("value", [0.0, torch.nan])
def test_metrics_of_a_C_that_cannot_be_read_are_nan(value):
    mpc = scheme()
    with torch.no_grad():
        mpc.C[:, -1] = value
    metrics = structure_metrics(mpc)
    assert len(metrics) == 3
    assert all(math.isnan(number) for number in metrics.values())
    with pytest.raises(QPError, match=r"^C"):
        read(mpc)
