"""Distances by band against a loop over blocks."""

from __future__ import annotations

import torch

from torch_qpmpc.banded import banded_matrix
from torch_qpmpc.structure import distance_by_band

N_X, N_U, N = 3, 2, 4
generator = torch.Generator().manual_seed(0)
A = torch.randn(N_X, N_X, generator=generator, dtype=torch.float64)
B = torch.randn(N_X, N_U, generator=generator, dtype=torch.float64)
C_0 = banded_matrix(A, B, N)
C = C_0 + torch.randn(C_0.shape, generator=generator, dtype=torch.float64)


def test_distances_are_the_blocks_sums():
    expected = {"on": 0.0, "above": 0.0, "below": 0.0}
    for k in range(N):
        rows = slice(k * N_X, (k + 1) * N_X)
        first, last = k * (N_X + N_U), (k + 1) * (N_X + N_U) + N_X
        deviation = (C - C_0)[rows].abs()
        expected["below"] += deviation[:, :first].sum().item()
        expected["on"] += deviation[:, first:last].sum().item()
        expected["above"] += deviation[:, last:].sum().item()
    found = distance_by_band(C, C_0, N_X, N_U)
    assert found.keys() == expected.keys()
    for band, value in expected.items():
        assert isinstance(found[band], float)
        assert abs(found[band] - value) < 1e-12 * value
    assert abs(sum(found.values()) - (C - C_0).abs().sum().item()) < 1e-9


def test_the_start_has_no_distance():
    parameter = torch.nn.Parameter(C_0.clone())
    assert distance_by_band(parameter, C_0, N_X, N_U) == {"on": 0, "above": 0, "below": 0}


def test_one_entry_is_in_one_band():
    for row, column, band in ((0, 0, "on"), (0, N_X + N_U + N_X, "above"), (N_X, 0, "below")):
        other = C_0.clone()
        other[row, column] += 2.0
        nothing = dict.fromkeys(("on", "above", "below"), 0.0)
        assert distance_by_band(other, C_0, N_X, N_U) == nothing | {band: 2.0}


def test_distances_depend_on_the_gauge():
    """T C is the same QP, and yet far away: why the docstring warns."""
    T = torch.linalg.qr(torch.randn(N * N_X, N * N_X, generator=generator).double()).Q
    assert distance_by_band(T @ C_0, C_0, N_X, N_U)["above"] > 1
