"""The banded constraint matrix of a linear MPC scheme (eq:cband), and distances from its band.

Rows are grouped in N blocks of n_x, columns in the order of z (see `torch_qpmpc.mpc.layout`). In
row block k the band is (x_k, u_k, x_{k+1}) or, with a preview, (d_k, x_k, u_k, x_{k+1}). Later
columns are above it, earlier ones below.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from torch_qpmpc.errors import QPError
from torch_qpmpc.mpc.layout import Layout


def banded_matrix(A: Tensor, B: Tensor, horizon: int, E: Tensor | None = None) -> Tensor:
    """Return C_0 for a linear model: ``C_0 z = 0`` is the model over the horizon.

    The model is ``x_{k+1} = A x_k + B u_k`` or, with a preview d, ``.. + E d_k``.

    Args:
        A: ``(n_x, n_x)``; a leading N has one per stage.
        B: ``(n_x, n_u)``; likewise.
        horizon: N.
        E: ``(n_x, n_d)``, likewise; None without a preview.

    Returns:
        ``(N n_x, n_z)``.

    Raises:
        QPError: the shapes of A, B and E do not match each other or the horizon.
    """
    E = A.new_zeros(*A.shape[:-1], 0) if E is None else E
    n_x = A.shape[-2] if A.ndim > 1 else len(A)
    n_u, n_d = max(B.shape[-1], 1), E.shape[-1]
    shapes = {"A": (A, (n_x, n_x)), "B": (B, (n_x, n_u)), "E": (E, (n_x, n_d))}
    for name, (matrix, shape) in shapes.items():
        if tuple(matrix.shape) not in (shape, (horizon, *shape)):
            got = f"shape {tuple(matrix.shape)}"
            raise QPError.expected(name, got, f"shape {shape} or {(horizon, *shape)}")
    following = torch.diag_embed(-A.new_ones(horizon, n_x))
    parts = (*(x.expand(horizon, n_x, -1) for x in (A, B)), following)
    C = _staircase(torch.cat(parts, dim=-1), n_x + n_u)
    preview = F.pad(torch.block_diag(*E.expand(horizon, n_x, n_d)), (0, n_d))
    return torch.cat((preview, C), dim=-1)


def model_of(C: Tensor, layout: Layout) -> tuple[Tensor, ...]:
    """Return A and B and, with a preview, E from the band of C, each with a leading N."""
    E, A, B = layout.stage_blocks(C).split((layout.n_d, layout.n_x, layout.n_u), dim=-1)
    return (A, B, E) if layout.n_d else (A, B)


def _staircase(blocks: Tensor, step: int) -> Tensor:
    """Return rows with ``blocks`` ``(N, i, width)``, each ``step`` columns after the one above."""
    N, width = len(blocks), blocks.shape[-1]
    total = (N - 1) * step + width
    # Padded to total + step columns and read with a stride of total, each block moves by step.
    padded = F.pad(blocks.movedim(1, 0), (0, total + step - width)).flatten(1)
    rows = padded[:, : N * total].unflatten(-1, (N, total))
    return rows.movedim(0, 1).flatten(0, 1)


def band_distance(layout: Layout) -> Tensor:
    """Return the signed distance from the band in stages, ``(N n_x, n_z)``, > 0 above it."""
    n_x, n, horizon = layout.n_x, layout.n, layout.horizon
    row = torch.arange(horizon).repeat_interleave(n_x).unsqueeze(1)
    column = torch.arange(horizon * n + n_x)
    stage = column // n
    is_state = column % n < n_x
    # x_{k+1} is on the band of row block k, u_{k+1} the first block above it.
    above = (stage - row - is_state.long()).clamp(min=0)
    below = (row - stage).clamp(min=0)
    preview = torch.arange(horizon + 1).repeat_interleave(layout.n_d) - row
    return torch.cat((preview, above - below), dim=-1)
