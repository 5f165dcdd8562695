"""Certified solutions of a flat batch, and what stands for those that are missing."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torch_qpmpc.qp.pipeline.batch import FlatPrograms
from torch_qpmpc.qp.pipeline.certificate import TOLERANCE
from torch_qpmpc.qp.program import Status
from torch_qpmpc.qp.twofold import Twofold


class RawArrays(NamedTuple):
    """`RawSolution` as NumPy arrays."""

    value: np.ndarray
    z: np.ndarray
    sigma: np.ndarray
    chi: np.ndarray
    lam: np.ndarray
    xi: np.ndarray
    status: np.ndarray
    residual: np.ndarray
    iterations: np.ndarray


@dataclass
class RawSolution(Twofold[RawArrays]):
    """Certified primal-dual solutions of B QPs, float64; lam = eta - upsilon.

    No residual is larger than ``worst``; up to the tolerance, that says that all are solved.
    """

    Arrays = RawArrays

    value: Tensor
    z: Tensor
    sigma: Tensor
    chi: Tensor
    lam: Tensor
    xi: Tensor
    status: Tensor
    residual: Tensor
    iterations: Tensor
    worst: float = math.inf

    def accepted(self) -> Tensor:
        """Which of them the certificate accepts, ``(B,)``."""
        return self.residual <= TOLERANCE

    @property
    def all_accepted(self) -> bool:
        return self.worst <= TOLERANCE

    def at(self, index: Tensor) -> RawSolution:
        """The solutions at ``index``."""
        return RawSolution(*(x[index] for x in self.all_tensors()))  # pyright: ignore[reportArgumentType]

    def put(self, index: Tensor, other: RawSolution) -> None:
        for own, others in zip(self.all_tensors(), other.all_tensors(), strict=True):
            own[index] = others
        self.worst = math.inf
        self.forget_arrays()


def unsolved(p: FlatPrograms, status: Status = Status.INVALID_DATA) -> RawSolution:
    """What an element carries that has no solution: an infinite cost, and zeros."""
    n, zeros = len(p), p.q.new_zeros
    z = zeros(n, p.q.shape[-1])
    z[:, : p.fixed.shape[-1]] = p.fixed.nan_to_num(0, 0, 0)
    return RawSolution(
        value=p.q.new_full((n,), torch.inf),
        z=z,
        sigma=zeros(n, p.lb.shape[-1]),
        chi=zeros(n, p.b.shape[-1]),
        lam=zeros(n, p.lb.shape[-1]),
        xi=torch.zeros_like(p.fixed),
        status=p.group.new_full((n,), int(status)),
        residual=p.q.new_full((n,), torch.inf),
        iterations=p.group.new_zeros(n),
    )
