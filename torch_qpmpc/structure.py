"""How far a constraint matrix is from the banded one of a linear MPC scheme (eq:cband).

These are raw, entrywise distances, as in the paper's figures. They depend on the gauge of C: T C
is the same QP for any invertible T.
"""

from __future__ import annotations

from torch import Tensor

from torch_qpmpc.banded import band_distance


def distance_by_band(C: Tensor, C_0: Tensor, n_x: int, n_u: int) -> dict[str, float]:
    """``sum |C - C_0|`` on, above and below the band: C, C_0 ``(N n_x, n_z)``."""
    distance = band_distance(n_x, n_u, C_0.shape[0] // n_x).to(C.device)
    deviation = (C.detach() - C_0).abs()
    return {
        "on": deviation[distance == 0].sum().item(),
        "above": deviation[distance > 0].sum().item(),
        "below": deviation[distance < 0].sum().item(),
    }
