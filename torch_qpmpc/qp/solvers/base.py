"""The result of a backend for condensed QPs (eq:qp2, eq:qp3), before its certification."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch

from torch_qpmpc.qp.pipeline.arrays import Array, to_numpy


class BackendSolution(NamedTuple):
    """v ``(B, d)``, signed row multipliers lam = eta - upsilon ``(B, r)``, iterations ``(B,)``.

    It has no status: the certificate decides which QPs are solved.
    """

    v: Array
    lam: Array
    iterations: Array

    def put(self, index: Array, other: BackendSolution) -> None:
        """Replace the solutions at ``index``."""
        for own, new in zip(self, other, strict=True):
            own[index] = new

    def like(self, x: Array) -> BackendSolution:
        """Return the same as arrays, or as tensors on one device, like ``x``."""
        if isinstance(x, np.ndarray):
            return BackendSolution._make(map(to_numpy, self))
        return BackendSolution._make(torch.as_tensor(field, device=x.device) for field in self)
