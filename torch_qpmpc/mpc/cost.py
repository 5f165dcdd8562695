"""The cost of the QP: theta's H, q and w with discounts (eq:qpH, eq:qp2c0)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torch_qpmpc.mpc.layout import Layout


class Discounts(NamedTuple):
    """The discount factors of theta's cost.

    ``z`` ``(n_z,)`` and ``rows`` ``(n_g,)`` are gamma^k, or one. ``hardness`` ``(n_g,)`` is added
    to w: inf for a hard row, whose w is a placeholder, and zero otherwise. ``stages`` is
    ``ties("q")`` of `Layout`.
    """

    z: Tensor
    rows: Tensor
    hardness: Tensor
    stages: Tensor


def discounted(
    layout: Layout,
    kind: str,
    blocks: tuple[Tensor, ...],
    q: Tensor,
    w: Tensor,
    discounts: Discounts,
) -> tuple[Tensor, Tensor, Tensor]:
    """Return H ``(n_z, n_z)``, q ``(n_z,)`` and w ``(n_g,)`` of the QP.

    ``blocks`` are theta's H of the stages and of x_N, or a full one.
    """
    H = layout.hessian(kind, blocks, discounts.z, discounts.stages)
    return H, discounts.z * q, torch.addcmul(discounts.hardness, discounts.rows, w)
