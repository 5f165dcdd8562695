"""What a backend hands back of a condensed QP (eq:qp2, eq:qp3): a claim, which is judged."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torch_qpmpc.qp.twofold import Twofold


class AnswerArrays(NamedTuple):
    """`Answer` as NumPy arrays."""

    v: np.ndarray
    lam: np.ndarray
    iterations: np.ndarray


@dataclass(frozen=True)
class Answer(Twofold[AnswerArrays]):
    """v ``(B, d)``, signed row multipliers lam = eta - upsilon ``(B, r)``, iterations ``(B,)``.

    There is no status: the project's own certificate decides what is solved.
    """

    Arrays = AnswerArrays

    v: Tensor
    lam: Tensor
    iterations: Tensor

    def put(self, index: Tensor, other: Answer) -> None:
        """Replace what there is at ``index``."""
        self.v[index], self.lam[index] = other.v, other.lam
        self.iterations[index] = other.iterations
        self.forget_arrays()

    @classmethod
    def on(
        cls,
        device: torch.device,
        v: np.ndarray,
        lam: np.ndarray,
        iterations: np.ndarray | Sequence[int],
    ) -> Answer:
        """What a solver of arrays found."""
        return cls.of_arrays(AnswerArrays(v, lam, np.asarray(iterations, np.int64)), device)
