"""What a backend hands back: a claim, which the certificate judges."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor


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
        found = torch.as_tensor(iterations, dtype=torch.int64, device=g.device)
        return cls(torch.from_numpy(v).to(g), torch.from_numpy(lam).to(g), found)
