"""The prediction form equals stepping the model in any gauge; the canonical matrix is C_0."""

import pytest
import torch
from torch import Tensor

from tests.problems import normal
from tests.refused import refused
from torch_qpmpc import QPError
from torch_qpmpc.analysis.structure import prediction_form
from torch_qpmpc.mpc.layout import banded_matrix

N_X, N_U, N = 3, 2, 5
OFFSET = normal(N, N_X, seed=7)


def constraints(off: float = 0.1, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Make C and b of an MPC scheme, with entries that are off."""
    C = banded_matrix(0.6 * normal(N_X, N_X, seed=seed), normal(N_X, N_U, seed=seed + 1), N)
    return C + off * normal(*C.shape, seed=seed + 2), -OFFSET.flatten()


def test_a_small_C_is_as_good_as_any():
    C, b = constraints()
    scale = torch.logspace(-12, 3, len(C)).double().unsqueeze(-1)
    form = prediction_form(C, N_X, N_U, b)
    scaled = prediction_form(scale * C, N_X, N_U, scale[:, 0] * b)
    torch.testing.assert_close(scaled.Gamma, form.Gamma)
    torch.testing.assert_close(scaled.condition, form.condition)


def test_a_C_that_does_not_determine_the_states_is_refused():
    C, _ = constraints(off=0.0)
    dependent = C.clone()
    dependent[4] = dependent[2] - dependent[7]
    with pytest.raises(QPError, match=r"C: got state columns of rank 14 of 15 \(condition number"):
        prediction_form(dependent, N_X, N_U)
    unseen = C.clone()
    unseen[:, [N_X + N_U, -1]] = 0  # entries of x_1 and of x_N
    with pytest.raises(QPError, match=r"of rank 13 of 15.*have no prediction form"):
        prediction_form(unseen, N_X, N_U)
    with pytest.raises(QPError, match="of rank 0 of 15"):
        prediction_form(torch.zeros_like(C), N_X, N_U)
    with pytest.raises(QPError, match=r"C: got shape \(2, 15, 28\), expected shape \(N n_x, n_z\)"):
        prediction_form(torch.stack((C, C)), N_X, N_U)


@refused(
    (torch.zeros(15, 27), None, r"C: got shape \(15, 27\)"),
    (torch.zeros(14, 28), None, r"C: got shape \(14, 28\)"),
    (torch.zeros(0, 3), None, r"C: got shape \(0, 3\)"),
    (torch.zeros(15, 28), torch.zeros(3), r"b: got shape \(3,\)"),
    (torch.full((15, 28), torch.nan), None, "C: got NaN or inf"),
    (torch.eye(15, 28), torch.full((15,), torch.inf), "b: got NaN or inf"),
)
def test_bad_input(C, b):
    prediction_form(C, N_X, N_U, b)
