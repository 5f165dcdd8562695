"""The metric D of Gauss-Newton's steps, which has no free units.

For each part p of theta

    D_p = scale_p U_p / size_p,    size_p <- max(mean_i g_ip'U_p g_ip, 0.9 size_p),

so that mu damps each part in relation to its own gradients. A part of the cost has a size of its
own; C, b, G, lb and ub share the sum of theirs, as they describe one model. Sizes rise at once, as
those of MINPACK's scaling: otherwise a part would move the more freely, the less Q depends on it.
They fall slowly, so that the large gradients of a bad start do not damp a part for ever.

U is the identity except where C is free. With m_j the mean square of signal j, an entry of x, u
or d, over a batch and z's stages, with the same slow fall, U is m_i / m_j for the entry of C in a
row that predicts x's entry i and a column of signal j, and m_i for that row's entry of b: entries
are measured by the prediction's relative change. For q it is 1 / m_j. The step is then the same in
any unit of the cost and, for c, q, C and b, in any units of the signals. A signal has one m for all
stages, because a single entry of z may be nearly zero in a batch without being small.

Sizes and mean squares are entries of the optimiser's parameter groups, and so of its state.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from torch_qpmpc.learning.kernel import Block
from torch_qpmpc.mpc.module import QPMPC
from torch_qpmpc.mpc.validation import COST

#: Smallest size of a part and smallest mean square of a signal, as a fraction of the largest.
FLOOR = 1e-12
#: Factor by which a size or a mean square can fall from one batch to the next.
FORGET = 0.9
#: The entries of a parameter group before the first batch.
FRESH = {"size": 0.0, "signals": None, "variance": 0.0}


def signal_sizes(mpc: QPMPC, group: dict[str, Any], z: Tensor) -> tuple[Tensor, Tensor]:
    """Return m for the rows ``(n_c,)`` and the columns ``(n_z,)`` of C, updated with z.

    A signal that was always zero counts as one.
    """
    signals = mpc.layout.signals().to(z.device)
    count = signals.bincount()
    squares = torch.zeros_like(z[0, : len(count)]).index_add(0, signals, z.square().mean(0))
    m = squares / count
    if group["signals"] is not None:
        m = m.maximum(FORGET * m.new_tensor(group["signals"]))
    if m.isfinite().all():
        group["signals"] = m.tolist()
    m = torch.where(m > 0, m.clamp(min=FLOOR * m.max()), 1)
    return m[: mpc.n_x].repeat(mpc.horizon), m[signals]


def scale(blocks: Sequence[Block], count: int) -> None:
    """Update the parts' sizes with the gradients of ``count`` pairs, and scale the metric."""
    sizes = {block.group["name"]: 0.0 for block in blocks}
    for block in blocks:
        sizes[block.group["name"]] += float(block.diagonal().sum()) / count
    for block in blocks:
        group = block.group
        if math.isfinite(size := sizes[group["name"]]):
            group["size"] = max(FORGET * group["size"], size)
        sizes[group["name"]] = group["size"]
    model = sum(size for name, size in sizes.items() if name not in COST)
    least = FLOOR * max(sizes.values(), default=0.0)
    for block in blocks:
        name = block.group["name"]
        size = max(sizes[name] if name in COST else model, least)
        block.scale = block.group["scale"] / (size or 1.0)
