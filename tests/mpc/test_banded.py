import pytest
import torch
from torch.testing import assert_close

from tests.refused import refused
from torch_qpmpc.mpc.layout import Layout, band_distance, banded_matrix

N_X, N_U, N = 3, 2, 4


def model(*stages: int) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    return (
        torch.randn(*stages, N_X, N_X, generator=generator, dtype=torch.float64),
        torch.randn(*stages, N_X, N_U, generator=generator, dtype=torch.float64),
    )


@pytest.mark.parametrize("stages", [(), (N,)])
def test_trajectories_of_the_model_are_its_null_space(stages):
    A, B = model(*stages)
    x, u = torch.ones(N_X).double(), torch.arange(N * N_U).double().reshape(N, N_U)
    z = [x]
    for k in range(N):
        x = A.expand(N, N_X, N_X)[k] @ x + B.expand(N, N_X, N_U)[k] @ u[k]
        z += [u[k], x]
    C = banded_matrix(A, B, N)
    assert C.shape == (N * N_X, N * (N_X + N_U) + N_X)
    assert C.dtype == torch.float64
    assert torch.linalg.matrix_rank(C) == N * N_X  # and nothing else is
    assert_close(C @ torch.cat(z), torch.zeros(N * N_X).double())


@refused(
    ((2, 3), (3, 2), r"A: got shape \(2, 3\), expected shape \(2, 2\) or \(4, 2, 2\)"),
    ((5, 3, 3), (3, 2), r"A: got shape \(5, 3, 3\), expected shape \(3, 3\) or \(4, 3, 3\)"),
    ((3, 3), (2, 2), r"B: got shape \(2, 2\), expected shape \(3, 2\) or \(4, 3, 2\)"),
    ((3, 3), (5, 3, 2), r"B: got shape \(5, 3, 2\), expected shape \(3, 2\) or \(4, 3, 2\)"),
)
def test_a_model_that_does_not_fit_is_named(A, B):
    banded_matrix(torch.ones(A), torch.ones(B), N)


def test_band_distance_counts_stages():
    expected = [
        # x_0, u_0, x_1, u_1, x_2, u_2, x_3
        [0, 0, 0, 1, 1, 2, 2],
        [-1, -1, 0, 0, 0, 1, 1],
        [-2, -2, -1, -1, 0, 0, 0],
    ]
    assert band_distance(Layout(1, 1, 3)).tolist() == expected
