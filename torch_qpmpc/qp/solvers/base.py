"""The input and the output of a backend: condensed QPs (eq:qp2, eq:qp3), and solutions."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch

from torch_qpmpc.qp.pipeline.arrays import Array, to_numpy, to_tensor


class SoftQPs(NamedTuple):
    """The input of a backend: B problems of d variables and r rows,

        min over v:  1/2 v'Hv + g'v + sum_i w_i dist(G_i v, [l_i, u_i]),

    with H ``(M, d, d)``, G ``(M, r, d)``, group ``(B,)``, g ``(B, d)``, l, u, w ``(B, r)``;
    ``w_i = inf`` means a hard row. The vectors need not be contiguous.
    """

    H: Array
    G: Array
    group: Array
    g: Array
    l: Array  # noqa: E741 - the literature's name for the lower bound
    u: Array
    w: Array

    def take(self, index: Array) -> SoftQPs:
        """Return the problems at ``index``, with the same matrices."""
        return SoftQPs(self.H, self.G, *(x[index] for x in self[2:]))

    def in_numpy(self) -> SoftQPs:
        return SoftQPs._make(map(to_numpy, self))

    def in_torch(self) -> SoftQPs:
        return SoftQPs._make(map(to_tensor, self))


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
