"""The solutions of a batch of QPs, and placeholders for unsolved ones."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from torch_qpmpc.qp.pipeline.arrays import Array, to_numpy
from torch_qpmpc.qp.program import UNKNOWN, Status

#: The certificate rejects a solution with a larger relative residual.
TOLERANCE = 1e-6


class BatchSolution(NamedTuple):
    """Primal-dual solutions of B QPs, see `torch_qpmpc.QPSolution`; lam = eta - upsilon."""

    value: Array
    z: Array
    chi: Array
    lam: Array
    xi: Array
    status: Array
    residual: Array
    iterations: Array
    active: Array

    def accepted(self) -> Array:
        """Return the mask of solutions that the certificate accepts, ``(B,)``."""
        return self.residual <= TOLERANCE

    @property
    def all_accepted(self) -> bool:
        return bool(self.accepted().all())

    def at(self, index: np.ndarray) -> BatchSolution:
        """Return copies of the solutions at ``index``."""
        return BatchSolution._make(x[index] for x in self)

    def put(self, index: np.ndarray, others: BatchSolution) -> None:
        """Replace the solutions at ``index``."""
        for own, new in zip(self, others, strict=True):
            own[index] = new

    def on_cpu(self) -> BatchSolution:
        return BatchSolution._make(map(to_numpy, self))


def unsolved(fixed: np.ndarray, n_z: int, n_c: int, n_g: int, status: Status) -> BatchSolution:
    """Return placeholders for unsolved QPs: infinite costs, the fixed entries, and zeros."""
    n = len(fixed)
    z = np.zeros((n, n_z))
    z[:, : fixed.shape[1]] = np.nan_to_num(fixed, posinf=0.0, neginf=0.0)
    return BatchSolution(
        value=np.full(n, np.inf),
        z=z,
        chi=np.zeros((n, n_c)),
        lam=np.zeros((n, n_g)),
        xi=np.zeros_like(fixed),
        status=np.full(n, int(status)),
        residual=np.full(n, np.inf),
        iterations=np.zeros(n, np.int64),
        active=np.full((n, n_g), UNKNOWN, np.int8),
    )
