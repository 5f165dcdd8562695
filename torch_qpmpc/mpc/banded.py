"""The banded constraint matrix of a linear MPC scheme (eq:cband), and distances from its band.

Rows are grouped in N blocks of n_x, columns in the order of z = [x_0, u_0, x_1, .., x_N]. In row
block k the band is (x_k, u_k, x_{k+1}); columns to its right are above it, those to its left below.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from torch_qpmpc.errors import QPError


def banded_matrix(A: Tensor, B: Tensor, horizon: int) -> Tensor:
    """Return C_0 for the model x+ = A x + B u: ``C_0 z = 0`` is the model over the horizon.

    Args:
        A: ``(n_x, n_x)``, or ``(N, n_x, n_x)`` for one per stage.
        B: ``(n_x, n_u)``, or ``(N, n_x, n_u)``.
        horizon: N.

    Returns:
        ``(N n_x, N (n_x + n_u) + n_x)``.

    Raises:
        QPError: the shapes of A and B do not match each other or the horizon.
    """
    n_x, n_u = A.shape[-1], B.shape[-1]
    for name, matrix, shape in (("A", A, (n_x, n_x)), ("B", B, (n_x, n_u))):
        if tuple(matrix.shape) not in (shape, (horizon, *shape)):
            got = f"shape {tuple(matrix.shape)}"
            raise QPError.expected(name, got, f"shape {shape} or {(horizon, *shape)}")
    blocks = torch.cat((A.expand(horizon, n_x, n_x), B.expand(horizon, n_x, n_u)), dim=-1)
    following = torch.eye(horizon * n_x).to(A).unflatten(-1, (horizon, n_x))
    following = F.pad(F.pad(following, (0, n_u)).flatten(1), (n_x + n_u, -n_u))
    return F.pad(torch.block_diag(*blocks), (0, n_x)) - following


def band_distance(n_x: int, n_u: int, horizon: int) -> Tensor:
    """Return the signed distance from the band in stages, ``(N n_x, n_z)``, > 0 above it."""
    row = torch.arange(horizon).repeat_interleave(n_x).unsqueeze(1)
    n_z = horizon * (n_x + n_u) + n_x
    column = torch.arange(n_z)
    stage = column // (n_x + n_u)
    is_state = column % (n_x + n_u) < n_x
    # x_{k+1} is on the band of row block k, u_{k+1} the first block above it.
    above = (stage - row - is_state.long()).clamp(min=0)
    below = (row - stage).clamp(min=0)
    return above - below
