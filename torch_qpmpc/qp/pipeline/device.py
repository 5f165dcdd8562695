"""The first attempt of a device that is not the CPU: QPs solved and certified there, in torch.

What it certifies is taken; the rest goes the CPU's way.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from torch_qpmpc.qp.kernels import sample_torch
from torch_qpmpc.qp.pipeline.arrays import BatchSolution, SoftQPs, Theta, to_numpy
from torch_qpmpc.qp.pipeline.batch import Prepared, Programs, kept
from torch_qpmpc.qp.pipeline.condensing import Reduced, Sizes
from torch_qpmpc.qp.program import Status
from torch_qpmpc.qp.solvers import interior_point


def accelerator(x: Tensor) -> torch.device | None:
    """Return the device of x; None if that is the CPU."""
    return x.device if x.is_cuda else None


def attempt(device: torch.device, programs: Programs, _: Any) -> BatchSolution:
    """Return candidates of the interior-point method on ``device``, completed and certified."""
    if not len(programs) or not len(programs.prepared.reduced(programs.n_f).rows):
        return programs.unsolved(Status.NOT_CONVERGED)
    theta, reduced, sizes = on_device(programs.prepared, device, programs.n_f)
    group, fixed = (torch.from_numpy(x).to(device) for x in (programs.group, programs.fixed))
    qps = reduced_qps(reduced, group, fixed)
    found = interior_point.solve(qps)
    parts = sample_torch.recover(*found, group, fixed, theta, reduced, sizes)
    return BatchSolution._make(map(to_numpy, parts))


@kept
def on_device(prepared: Prepared, device: torch.device, n_f: int) -> tuple[Theta, Reduced, Sizes]:
    """Return theta and what follows from it as tensors, copied once for each theta."""

    def moved(x: Any) -> Any:
        if isinstance(x, np.ndarray):
            return torch.from_numpy(x).to(device)
        return type(x)._make(map(moved, x)) if hasattr(x, "_make") else x

    return moved(prepared.theta), moved(prepared.reduced(n_f)), moved(prepared.sizes(n_f))


def reduced_qps(reduced: Reduced, group: Tensor, fixed: Tensor) -> SoftQPs:
    """Return the QPs for the interior-point method, as `Programs.reduced_qps`."""
    d, r = reduced.H.shape[-1], len(reduced.rows)
    offsets = sample_torch.multiply(reduced.matrix.mT, group, fixed) + reduced.constant
    g, lower, upper = offsets.split((d, r, r), -1)
    return SoftQPs(reduced.H, reduced.G, group, g, lower, upper, reduced.w.expand(len(group), r))
