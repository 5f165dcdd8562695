"""The QP's cost of theta: H, q and w with their discounts (eq:qpH, eq:qp2c0)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torch_qpmpc.mpc.layout import Layout


class Discounts(NamedTuple):
    """What theta's cost is multiplied by.

    ``of_z`` ``(n_z,)`` and ``of_rows`` ``(n_g,)`` are gamma^k, or one. ``hardness`` ``(n_g,)`` is
    added to w: inf for a hard row, whose w is a placeholder, and else zero. ``stages`` is
    ``ties("q")`` of `Layout`.
    """

    of_z: Tensor
    of_rows: Tensor
    hardness: Tensor
    stages: Tensor


def discounted(
    layout: Layout, kind: str, blocks: tuple[Tensor, ...], q: Tensor, w: Tensor, by: Discounts
) -> tuple[Tensor, Tensor, Tensor]:
    """H ``(n_z, n_z)``, q ``(n_z,)`` and w ``(n_g,)`` of the QP.

    From theta's H of the stages and of x_N, or a full one, and its q and w.
    """
    H = layout.hessian(kind, blocks, by.of_z, by.stages)
    return H, by.of_z * q, torch.addcmul(by.hardness, by.of_rows, w)
