"""The report of a known scheme has its numbers; an unreadable C is refused."""

import math

import pytest
import torch

from tests.problems import normal
from torch_qpmpc import QPMPC, QPError
from torch_qpmpc.analysis.report import read, structure_metrics

A = torch.tensor([[1.0, 0.1], [0.0, 0.9]], dtype=torch.float64)
B = torch.tensor([[0.0], [0.1]], dtype=torch.float64)
WRONG_A, WRONG_B = A + torch.tensor([[0.0, 0.03], [-0.04, 0.0]]), 1.5 * B


def scheme() -> QPMPC:
    options = {"stage_weight": [1.0] * 3, "hessian": "block", "solver": "daqp"}
    return QPMPC.from_model(WRONG_A, WRONG_B, 6, **options)


def test_a_scheme_is_read_in_any_gauge():
    mpc = scheme()
    before = read(mpc, (A, B))
    T = normal(len(mpc.C), len(mpc.C))
    with torch.no_grad():
        mpc.C.copy_(T @ mpc.C)
        mpc.b.copy_(T @ mpc.b)
    found = read(mpc, (A, B))
    torch.testing.assert_close(found.nearest.A, WRONG_A, rtol=0, atol=1e-9)
    torch.testing.assert_close(found.nearest.B, WRONG_B, rtol=0, atol=1e-9)
    expected = {
        "causality": 0.0,
        "toeplitz": 0.0,
        "non_markov": 0.0,
        "distance_to_mpc": 0.0,
        "gain_to_lqr": 0.0,
        "model_error": 0.005**0.5,
    }
    scalars = found.scalars()
    assert {name: scalars[name] for name in expected} == pytest.approx(expected, abs=1e-6)
    for name, K, plant in (
        ("radius", found.K, (A, B)),
        ("radius_predicted", found.K, (WRONG_A, WRONG_B)),
    ):
        eigenvalues = torch.linalg.eigvals(plant[0] - plant[1] @ K)
        assert scalars[name] == pytest.approx(eigenvalues.abs().max().item(), abs=1e-6)
    assert before.scalars() == pytest.approx(scalars | {"condition": before.condition}, abs=1e-6)


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
