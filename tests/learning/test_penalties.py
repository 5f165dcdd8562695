"""The penalties against the paper's formulas, written out entry by entry."""

import math
from typing import Any

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from tests.problems import drawn_mpc
from torch_qpmpc import QPMPC, DeviationPenalty, QPError, SystemIdentificationPenalty

N_X, N_U, N = 2, 1, 4
N_Z = N * (N_X + N_U) + N_X


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def normal(generator: torch.Generator, *shape: int) -> torch.Tensor:
    return torch.randn(shape, generator=generator, dtype=torch.float64)


def make_mpc(generator: torch.Generator) -> QPMPC:
    A, B = normal(generator, N_X, N_X), normal(generator, N_X, N_U)
    return drawn_mpc(N_X, N_U, N, A=A, B=B)


# --- Deviation -----------------------------------------------------------------------------------


def test_deviation_penalty_entry_by_entry(generator):
    mpc = make_mpc(generator)
    C_0 = mpc.C_0
    C = C_0 + normal(generator, *C_0.shape)
    c_1: Any = np.float32(2.0)
    penalty = DeviationPenalty(mpc, c_1=c_1, c_2=0.5, c_3=0.25)
    mask = penalty.C_mask
    total = sum(
        abs(mask[i, j] * (C[i, j] - C_0[i, j])).item()
        for i in range(C.shape[0])
        for j in range(C.shape[1])
    )
    assert penalty(C).item() == pytest.approx(total, rel=1e-12)
    assert penalty(C_0).item() == 0
    (gradient,) = torch.autograd.grad(penalty(C.requires_grad_()), C)
    assert torch.equal(gradient, mask * (C - C_0).sign())


@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_proximal_step_reaches_C_0_exactly(generator, scale):
    mpc = make_mpc(generator)
    C_0 = mpc.C_0
    penalty = DeviationPenalty(mpc, c_1=1.0, c_2=0.01, c_3=0.0)
    start = C_0 + 0.1 * normal(generator, *C_0.shape)
    C = torch.nn.Parameter(start.clone())
    pointer = C.data_ptr()
    assert penalty.proximal_step_(C, scale) is None
    above, free = penalty.C_mask == 1, penalty.C_mask == 0
    assert torch.equal(C[above], C_0[above])
    assert torch.equal(C[free], start[free]), "a weight of zero leaves an entry alone"
    on = penalty.C_mask == 0.01
    change = (start - C_0)[on]
    shrunk = change.sign() * (change.abs() - 0.01 * scale).clamp(min=0)
    torch.testing.assert_close((C - C_0)[on].detach(), shrunk)
    assert C.data_ptr() == pointer
    assert C.requires_grad
    assert C.is_leaf
    C.grad = None
    C.square().sum().backward()  # still usable


@pytest.mark.parametrize("name", ["c_1", "c_2", "c_3"])
@pytest.mark.parametrize("weight", [-1.0, math.inf, math.nan])
def test_impossible_deviation_weights(name, weight):
    with pytest.raises(QPError, match=rf"{name}: got {weight}, expected a finite number >= 0"):
        DeviationPenalty(drawn_mpc(1, 1, 3), **{name: weight})


# --- System identification -----------------------------------------------------------------------


def test_system_identification_penalty_window_by_window(generator):
    C, windows = normal(generator, N * N_X, N_Z), normal(generator, 7, N_Z)
    b = normal(generator, N * N_X)
    rows, offset = C.numpy(), b.numpy()
    total = sum(np.linalg.norm(rows @ tau - offset) ** 2 for tau in windows.numpy())
    module = SystemIdentificationPenalty(1e-3)
    assert module(C, windows, b).item() == pytest.approx(1e-3 * total, rel=1e-12)
    assert SystemIdentificationPenalty()(C, windows, 0 * b) == SystemIdentificationPenalty()(
        C, windows
    )


def test_the_si_penalty_as_a_quadratic_in_C():
    generator = torch.Generator().manual_seed(0)
    C, windows = normal(generator, 3, 8), normal(generator, 5, 8)
    penalty = SystemIdentificationPenalty(0.3)
    S, b = penalty.curvature(windows), normal(generator, 3)
    for offset in (b, None):
        D = torch.cat((C, (b if offset is not None else 0 * b).unsqueeze(-1)), -1)
        assert_close(0.5 * ((D @ S) * D).sum(), penalty(C, windows, offset))


def test_of_pairs_of_windows_the_difference_of_errors_counts(generator):
    C, b = normal(generator, 3, 8), normal(generator, 3)
    pairs, penalty = normal(generator, 5, 2, 8), SystemIdentificationPenalty(0.3)
    expected = penalty(C, pairs[:, 1] - pairs[:, 0])
    assert_close(penalty(C, pairs, b), expected)
    D = torch.cat((C, b[:, None]), -1)
    assert_close(0.5 * ((D @ penalty.curvature(pairs)) * D).sum(), expected)
    level = normal(generator, 3)  # which no difference sees
    assert_close(penalty(C, pairs, b + level), expected)
