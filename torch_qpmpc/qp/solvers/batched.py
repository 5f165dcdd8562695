"""Soft QPs in the form of the batched algorithms, on any device.

This module, and `active_set` and `interior_point`, which use it, do not loop over the batch.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor

from torch_qpmpc.qp.batching import largest
from torch_qpmpc.qp.pipeline.arrays import SoftQPs

#: Replaces infinity: its reciprocal vanishes in sums, and its square does not overflow.
HUGE = 1e100
#: A row up to this narrow, relative to its larger bound, counts as an equality.
NARROW = 1e-6
#: A typical multiplier, relative to the largest force.
TYPICAL = 0.05
#: Least typical curvature, relative to the largest force over a length.
FLAT = 1e-2
#: Curvatures that hold a row at its bound and damp every step, relative to the typical one.
PENALTY, DAMPING = 1e10, 1e-10
#: Added to a matrix that is indefinite by rounding, relative to its largest diagonal entry.
ROUNDING = 1e-12


@dataclass(frozen=True)
class BatchedQPs:
    """`SoftQPs` with `HUGE` for infinity, and typical sizes.

    H and G are ``(1, ..)`` if the batch shares them, and ``products`` then holds the outer products
    of G's rows, ``(r, d d)``; else they are ``(B, ..)``. Typical sizes make all decisions
    independent of units: the ``width`` between a row's bounds, the ``force`` of its multiplier, the
    ``penalty`` that holds it, ``(B, r)``; the ``cost``, or least width times force, and the
    ``curvature``, ``(B,)``.
    """

    H: Tensor
    G: Tensor
    products: Tensor | None
    g: Tensor
    lower: Tensor
    upper: Tensor
    w: Tensor
    width: Tensor
    force: Tensor
    penalty: Tensor
    cost: Tensor
    curvature: Tensor

    @classmethod
    def of(cls, qps: SoftQPs) -> BatchedQPs:
        H, G, g, products = qps.H, qps.G, qps.g, None
        if len(H) == 1:
            products = (G[0].unsqueeze(-1) * G[0].unsqueeze(-2)).flatten(1)
        else:
            H, G = H[qps.group], G[qps.group]
        lower, upper, w = qps.l.clamp(min=-HUGE), qps.u.clamp(max=HUGE), qps.w.clamp(max=HUGE)
        size = _largest(G).squeeze(-1)
        size = torch.where(size > 1 / HUGE, size, 1.0)
        width = (upper - lower) / size
        narrow = upper - lower <= NARROW * lower.abs().maximum(upper.abs())
        known = ~narrow & (width < 1e-10 * HUGE)
        median = width.masked_fill(~known, torch.nan).nanmedian(-1, keepdim=True).values
        median = median.nan_to_num(1.0)
        width = torch.where(known, width, median).maximum(1e-3 * median)
        length, stiffest = width.amin(-1, keepdim=True), _largest(H.flatten(1))
        push = _largest(g) + stiffest * length
        push = torch.where(push > 0, push, 1.0)
        curvature = stiffest.maximum(FLAT * push / length)
        width, force = width * size, TYPICAL * push / size
        penalty, cost = PENALTY * curvature / size.square(), (force * width).amin(-1)
        curvature = curvature.squeeze(-1)
        typical = (width, force, penalty, cost, curvature)
        return cls(H, G, products, g, lower, upper, w, *typical)

    def __len__(self) -> int:
        return len(self.g)

    def take(self, index: Tensor) -> BatchedQPs:
        """Return the QPs at ``index``."""
        same = ("H", "G", "products") if self.products is not None else ("products",)
        tensors = {field.name: getattr(self, field.name) for field in fields(self)}
        return BatchedQPs(**{n: t if n in same else t[index] for n, t in tensors.items()})

    def bend(self, v: Tensor) -> Tensor:
        """Return H v, ``(B, d)``."""
        return self._multiply(self.H, v)

    def rows(self, v: Tensor) -> Tensor:
        """Return y = G v, ``(B, r)``."""
        return self._multiply(self.G, v)

    def pull(self, lam: Tensor) -> Tensor:
        """Return G' lam, ``(B, d)``."""
        return self._multiply(self.G.mT, lam)

    def factor(self, weight: Tensor) -> Tensor:
        """Return Cholesky factors of ``H + G' diag(weight) G``, slightly damped, ``(B, d, d)``."""
        if self.products is not None:
            normal = torch.addmm(self.H.flatten(1), weight, self.products)
            normal = normal.unflatten(1, self.H.shape[1:])
        else:
            normal = torch.baddbmm(self.H, (self.G * weight.unsqueeze(-1)).mT, self.G)
        diagonal = normal.diagonal(dim1=-2, dim2=-1)
        diagonal += DAMPING * self.curvature.unsqueeze(-1)
        factor, info = torch.linalg.cholesky_ex(normal)
        if (failed := info > 0).any():
            diagonal += ROUNDING * diagonal.amax(-1, keepdim=True)
            factor[failed] = torch.linalg.cholesky_ex(normal[failed])[0]
        return factor

    def residual(self, v: Tensor, lam: Tensor) -> Tensor:
        """Return the certificate's relative KKT residual for the condensed QPs, ``(B,)``."""
        Hv, y, pull = self.bend(v), self.rows(v), self.pull(lam)
        stationarity = _largest(Hv + self.g + pull)
        stationarity /= 1 + _largest(torch.cat((Hv, self.g, pull), dim=-1))
        hard = self.w == HUGE
        weight, outside = self.w.masked_fill(hard, 0), (y - y.clip(self.lower, self.upper)).abs()
        violation = _largest(outside * hard / (1 + y.abs()))
        excess = _largest((lam.abs() - self.w).clamp(min=0) / (1 + weight))
        charge = weight * outside
        gap = charge + lam.clamp(min=0) * (self.upper - y) + lam.clamp(max=0) * (self.lower - y)
        cost = (v * (Hv / 2 + self.g)).sum(-1, keepdim=True) + charge.sum(-1, keepdim=True)
        gap = gap.abs().sum(-1, keepdim=True) / (1 + cost.abs())
        errors = (stationarity, violation, excess, gap)
        return torch.cat(errors, dim=-1).amax(-1).nan_to_num(torch.inf, torch.inf)

    def _multiply(self, matrices: Tensor, vectors: Tensor) -> Tensor:
        if self.products is not None:
            return vectors @ matrices[0].mT
        return torch.bmm(matrices, vectors.unsqueeze(-1)).squeeze(-1)


def _largest(x: Tensor) -> Tensor:
    """Return the largest absolute entry along the last dimension, which is kept."""
    return largest(x).unsqueeze(-1)
