"""What a backend hands back: a claim, which the certificate judges."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from torch import Tensor

from torch_qpmpc import kernels


@dataclass(frozen=True)
class Answer:
    """v ``(B, d)``, signed row multipliers lam = eta - upsilon ``(B, r)``, iterations ``(B,)``.

    There is no status: the project's own certificate decides what is solved.
    """

    v: Tensor
    lam: Tensor
    iterations: Tensor

    def put(self, index: Tensor, other: Answer) -> None:
        """Replace what there is at ``index``."""
        self.v[index], self.lam[index] = other.v, other.lam
        self.iterations[index] = other.iterations

    @classmethod
    def like(
        cls, g: Tensor, v: np.ndarray, lam: np.ndarray, iterations: np.ndarray | Sequence[int]
    ) -> Answer:
        """From what a solver of arrays found, on the device of ``g``."""
        return cls(*kernels.tensors((v, lam, np.asarray(iterations, np.int64)), g.device))
