"""Arrays of the pipeline: data, reduced QPs, candidates of backends, certified solutions.

They are NumPy's on the CPU, and tensors on other devices.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torch_qpmpc.qp.program import crossed

#: The certificate rejects a solution with a larger relative residual or error of its value.
TOLERANCE = 1e-6
#: ``np.ndarray`` on the CPU, ``torch.Tensor`` elsewhere.
Array = Any


class Theta(NamedTuple):
    """B QPs over M distinct matrix triples, in float64, in another order than `QuadraticProgram`.

    H ``(M, n_z, n_z)``, symmetric, C ``(M, n_c, n_z)``, G ``(M, n_g, n_z)``, q ``(B, n_z)``, c
    ``(B,)``, b ``(B, n_c)``, lb, ub, w ``(B, n_g)``. A vector that the batch shares has one row.
    """

    H: Array
    C: Array
    G: Array
    q: Array
    c: Array
    b: Array
    lb: Array
    ub: Array
    w: Array

    @classmethod
    def of(cls, data: Sequence[np.ndarray]) -> Theta:
        """Convert H, q, c, C, b, G, lb, ub, w, each with its leading dimension, to float64.

        H becomes its symmetric part, and lb becomes ub where they cross by rounding alone.
        """
        swapped = data[6] > data[7]
        H, q, c, C, b, G, lb, ub, w = (np.ascontiguousarray(x, np.float64) for x in data)
        if swapped.any():
            bounds = torch.from_numpy(data[6].copy()), torch.from_numpy(data[7].copy())
            lb = np.where(swapped & ~crossed(*bounds).numpy(), ub, lb)
        return cls((H + H.swapaxes(1, 2)) / 2.0, C, G, q, c, b, lb, ub, w)


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


class BatchSolution(NamedTuple):
    """Solutions of B QPs, see `QPSolution`; a candidate has status 0, and `accepted` judges it."""

    value: Array
    z: Array
    chi: Array
    lam: Array
    xi: Array
    status: Array
    residual: Array
    value_error: Array
    iterations: Array
    active: Array

    def accepted(self) -> Array:
        """Return the mask of solutions that the certificate accepts, ``(B,)``."""
        return (self.residual <= TOLERANCE) & (self.value_error <= TOLERANCE)

    @property
    def all_accepted(self) -> bool:
        return bool(self.accepted().all())

    def at(self, index: np.ndarray) -> BatchSolution:
        """Return copies of the solutions at ``index``."""
        return BatchSolution._make(x[index] for x in self)

    def put(self, index: Array, others: BatchSolution) -> None:
        """Replace the solutions at ``index``."""
        for own, new in zip(self, others, strict=True):
            own[index] = new

    def error(self) -> Array:
        """Return the larger of the residual and the value's error, ``(B,)``."""
        larger: Any = np.maximum if isinstance(self.residual, np.ndarray) else torch.maximum
        return larger(self.residual, self.value_error)

    def improve(self, index: Array, others: BatchSolution) -> None:
        """Replace placeholders, and solutions with larger errors than the others', at ``index``."""
        nothing = ~(self.residual[index] < float("inf"))
        better = indices(nothing | (others.error() < self.error()[index]))
        self.put(index[better], others.at(better))

    def clear(self, index: np.ndarray, placeholders: BatchSolution) -> None:
        """Replace all but the errors of the solutions at ``index``."""
        errors = {"residual": self.residual, "value_error": self.value_error}
        self.put(index, placeholders._replace(**errors).at(index))

    def on_cpu(self) -> BatchSolution:
        return BatchSolution._make(map(to_numpy, self))


def to_numpy(x: Array) -> np.ndarray:
    """Return ``x`` as an array on the CPU, without a copy if it is there already."""
    return x if isinstance(x, np.ndarray) else x.numpy(force=True)


def to_tensor(x: Array) -> Tensor:
    """Return ``x`` as a tensor on its device, without a copy."""
    return torch.from_numpy(x) if isinstance(x, np.ndarray) else x


def native_device(x: Tensor) -> torch.device | None:
    """Return the device of the pipeline's tensors for data like ``x``; None for NumPy arrays."""
    return x.device if x.is_cuda else None


def on_device(x: np.ndarray, device: torch.device | None) -> Array:
    """Return ``x`` as a tensor on ``device``, or unchanged if ``device`` is None."""
    return x if device is None else torch.from_numpy(x).to(device)


def indices(mask: Array) -> Array:
    """Return the indices where ``mask`` is True."""
    return np.flatnonzero(mask) if isinstance(mask, np.ndarray) else mask.nonzero().squeeze(-1)


def per_qp(unit: np.ndarray, group: Array) -> Array:
    """Return the row of ``unit`` ``(M, n)`` for each QP, ``(B, n)``, or ``(1, n)`` if M = 1."""
    if isinstance(group, np.ndarray):
        return unit if len(unit) == 1 else unit[group]
    rows = torch.from_numpy(unit).to(group.device)
    return rows if len(rows) == 1 else rows[group]
