"""A batch of QPs as arrays (eq:qp2, eq:qp3), the data of the pipeline.

Arrays are NumPy's on the CPU and tensors elsewhere, float64 and contiguous, without autograd. They
are made here, once, and determine the kernels: `torch_qpmpc.qp.kernels.sample` or
`torch_qpmpc.qp.kernels.sample_torch`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torch_qpmpc.qp.batching import broadcast
from torch_qpmpc.qp.kernels import sample, sample_torch
from torch_qpmpc.qp.pipeline.arrays import (
    Array,
    BackendSolution,
    BatchSolution,
    SoftQPs,
    Theta,
    on_device,
    to_numpy,
    to_tensor,
)
from torch_qpmpc.qp.pipeline.prepared import Prepared, prepared_for
from torch_qpmpc.qp.program import NDIMS

#: The positions of H, C and G.
MATRICES = (0, 3, 5)


@dataclass(frozen=True, eq=False)
class Programs:
    """B QPs: their prepared theta, and the values ``fixed`` ``(B, n_f)`` of the first entries of z.

    ``group`` ``(B,)`` is the index of each QP's matrices among the M of theta.
    """

    prepared: Prepared
    group: Array
    fixed: Array

    @classmethod
    def of(
        cls, *operands: Tensor, n_kept: int | None = None, device: torch.device | None = None
    ) -> tuple[Programs, torch.Size]:
        """Return the QPs of H, q, c, C, b, G, lb, ub, w, fixed, flattened, and their batch shape.

        QPs that share matrices share one copy, as do those whose matrices are equal. The
        preparation of a theta that the whole batch shares is cached.

        Args:
            operands: the tensors, of any batch shapes.
            n_kept: the number of leading entries of z that the elimination of C z = b keeps; by
                default those that are fixed.
            device: the device for tensors; None for NumPy arrays.
        """
        *theta, fixed = operands
        n_f = fixed.shape[-1]
        n_kept = n_f if n_kept is None else n_kept
        shared = all(x.ndim == n for x, n in zip(theta, NDIMS, strict=True))
        batch = fixed.shape[:-1]
        if not shared:
            batches = (x.shape[: x.ndim - n] for x, n in zip(theta, NDIMS, strict=True))
            batch = broadcast(batch, *batches)
        fixed = _flattened(fixed.detach(), batch, (n_f,)).to(device, torch.float64).contiguous()
        flat, group = [to_numpy(x)[np.newaxis] for x in theta], np.zeros(len(fixed), np.int64)
        if not shared:
            flat, group = _flat_theta(theta, batch)
        if all(len(x) == 1 for x in flat):
            prepared = prepared_for([x[0] for x in flat], n_kept, device)
        else:
            prepared = Prepared(Theta.of(flat), group, n_kept, device)
        if device is None:
            return cls(prepared, group, fixed.numpy(force=True)), batch
        own = len(prepared.theta.H) > 1
        zeros = fixed.new_zeros(len(fixed), dtype=torch.int64)
        where = on_device(group, device) if own else zeros
        return cls(prepared, where, fixed), batch

    def __len__(self) -> int:
        return len(self.group)

    @property
    def n_f(self) -> int:
        return self.fixed.shape[-1]

    @property
    def theta(self) -> Theta:
        """Theta on the batch's device."""
        return self.prepared.native_theta

    @property
    def kernels(self) -> ModuleType:
        """Functions for the batch's arrays."""
        return sample if isinstance(self.fixed, np.ndarray) else sample_torch

    def take(self, index: np.ndarray) -> Programs:
        """Return the QPs at ``index``."""
        group = to_numpy(self.group)[index]
        prepared = self.prepared
        if not prepared.shared:
            group, prepared = prepared.part(group, index)
        device = prepared.device
        at = on_device(index, device)
        return Programs(prepared, on_device(group, device), self.fixed[at])

    def on_cpu(self) -> Programs:
        """Return the same QPs as NumPy arrays."""
        if isinstance(self.fixed, np.ndarray):
            return self
        prepared = self.prepared.on_cpu()
        return Programs(prepared, to_numpy(self.group), to_numpy(self.fixed))

    def valid(self) -> np.ndarray | None:
        """Return the mask of QPs with valid data, ``(B,)``; None if all are valid."""
        valid = self.prepared.valid
        # A sum is finite if its terms are (except on overflow, which no solver survives either).
        if np.isfinite(float(self.fixed.sum())):
            return valid if valid is None or len(valid) == len(self) else valid.repeat(len(self))
        finite = np.isfinite(to_numpy(self.fixed.sum(-1)))
        return finite if valid is None else finite & valid

    def reduced_qps(self) -> SoftQPs:
        """Return the QPs for a backend, with C z = b and the fixed entries eliminated."""
        reduced = self.prepared.reduced(self.n_f)
        d, r = reduced.H.shape[-1], len(reduced.rows)
        g_l_u = self.kernels.offsets(self.fixed, self.group, reduced.matrix, reduced.constant)
        w = reduced.w
        if len(w) != len(self):  # the same row for each QP, without a copy
            if isinstance(w, np.ndarray):
                w = np.ndarray((len(self), r), buffer=w, strides=(0, w.itemsize))
            else:
                w = w.expand(len(self), r)
        g, lower, upper = g_l_u[:, :d], g_l_u[:, d : d + r], g_l_u[:, d + r :]
        return SoftQPs(reduced.H, reduced.G, self.group, g, lower, upper, w)

    def try_active_sets(self, qps: SoftQPs, active: Array) -> tuple[BackendSolution, Array]:
        """Solve the `reduced_qps` from active sets ``(B, n_g)``, corrected where needed.

        The warm start of every solver, for the whole batch at once. Codes are those of
        `QPSolution.active`; a set with any other code starts as the empty one, and usually settles.

        Returns:
            The solutions, and True where an active set settled, ``(B,)``.
        """
        active = active[:, self.prepared.reduced(self.n_f).rows]
        forces = self.prepared.forces(self.n_f)
        *solution, settled = self.kernels.try_active_sets(qps, forces, active)
        return BackendSolution(*solution), settled

    def hold(self, vy: Tensor, held: Tensor, level: Tensor) -> tuple[Tensor, Tensor]:
        """Return v ``(B, d)`` and t ``(B, n_g)`` with ``G v = level`` in the ``held`` rows.

        vy are v and the `reduced_qps`' G v for t = 0, ``(B, d + r)``. The result is wrong or NaN
        where H or the held rows are singular.
        """
        forces, rows = self.prepared.forces(self.n_f), self.prepared.reduced(self.n_f).rows
        t, rows = torch.zeros_like(level), to_tensor(rows)
        arrays = vy, held[:, rows], level[:, rows]
        if isinstance(self.fixed, np.ndarray):
            arrays = map(to_numpy, arrays)
        vy, t[:, rows] = map(to_tensor, self.kernels.hold(forces, self.group, *arrays, 0.0))
        return vy[:, : vy.shape[-1] - len(rows)], t

    def recover(self, claim: BackendSolution, passes: int = 0) -> BatchSolution:
        """Complete a backend's solutions of the `reduced_qps`, and certify them.

        ``passes`` iterative refinements of z and chi reduce errors of an ill-conditioned
        elimination.
        """
        parts = self.kernels.recover(claim.v, claim.lam, *self._data(), passes)
        value, z, chi, lam, xi, active, residual, error = parts
        steps = claim.iterations
        status = 0 * steps  # SOLVED, unless an error is too large
        return BatchSolution(value, z, chi, lam, xi, status, residual, error, steps, active)

    def certify(self, z: Array, lam: Array, chi: Array, xi: Array) -> tuple[Array, Array, Array]:
        """Certify z ``(B, n_z)`` and lam ``(B, n_g)``, chi ``(B, n_c)``, xi ``(B, n_f)``.

        Returns:
            The value, the residual and the error of the value, ``(B,)``. The residual is the
            largest error in stationarity, C z = b, the fixed entries, hard rows, and multipliers
            (outside [-w, w] or at absent bounds), each relative to the size of its terms; or, if
            larger, the sum of the errors in C z = b, weighted by |chi|, and of the rows'
            complementarity gaps, relative to the cost.
        """
        return self.kernels.certify(z, lam, chi, xi, *self._data())

    def _data(self) -> tuple:
        prepared, n_f = self.prepared, self.n_f
        sizes = prepared.reduced(n_f), prepared.sizes(n_f)
        return self.group, self.fixed, self.theta, *sizes, prepared.diagonal


def _flattened(x: Tensor, batch: torch.Size, event: Sequence[int]) -> Tensor:
    """Broadcast ``x`` to the batch, and flatten the batch to one leading dimension."""
    if len(batch) == 1 and x.shape == (*batch, *event):
        return x
    return x.expand(*batch, *event).reshape(batch.numel(), *event)


def _flat_theta(theta: Sequence[Tensor], batch: torch.Size) -> tuple[list[np.ndarray], np.ndarray]:
    """Return theta with one leading dimension, and the group of each QP.

    A vector that the batch shares has one row, and so have all three matrices together.
    """
    flat: list[Any] = [None] * len(theta)
    matrix_batch = broadcast(*(theta[i].shape[:-2] for i in MATRICES))
    for i, (x, n) in enumerate(zip(theta, NDIMS, strict=True)):
        event = x.shape[x.ndim - n :]
        shape = matrix_batch if n == 2 else batch
        rows = x.reshape(event) if x.numel() == event.numel() else x
        flat[i] = to_numpy(_flattened(rows, torch.Size([1]) if rows.ndim == n else shape, event))
        if len(flat[i]) > 1 and (flat[i] == flat[i][0]).all():
            flat[i] = flat[i][:1]
    if all(len(flat[i]) == 1 for i in MATRICES):
        return flat, np.zeros(batch.numel(), np.int64)
    M = matrix_batch.numel()
    for i in MATRICES:
        flat[i] = flat[i] if len(flat[i]) == M else flat[i].repeat(M, axis=0)
    group = np.arange(M).reshape(matrix_batch)
    return flat, np.broadcast_to(group, batch).reshape(-1).astype(np.int64)
