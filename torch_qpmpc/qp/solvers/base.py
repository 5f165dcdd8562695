"""What a backend returns for condensed QPs (eq:qp2, eq:qp3): a claim, which is certified."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch

from torch_qpmpc.qp.pipeline.arrays import Array, to_numpy


class BackendSolution(NamedTuple):
    """v ``(B, d)``, signed row multipliers lam = eta - upsilon ``(B, r)``, iterations ``(B,)``.

    There is no status: the project's own certificate decides what is solved.
    """

    v: Array
    lam: Array
    iterations: Array

    def put(self, index: Array, other: BackendSolution) -> None:
        """Replace the solutions at ``index``."""
        for own, new in zip(self, other, strict=True):
            own[index] = new

    def like(self, x: Array) -> BackendSolution:
        """The same in NumPy's arrays, or in tensors on one device, as ``x`` is."""
        if isinstance(x, np.ndarray):
            return BackendSolution._make(map(to_numpy, self))
        return BackendSolution._make(torch.as_tensor(part, device=x.device) for part in self)
