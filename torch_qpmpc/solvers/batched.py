"""The soft QPs as tensors of any device, and what the batched algorithms ask of them.

Neither this module nor `active_set` and `interior_point`, which build on it, loop over the batch.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor

#: Stands for infinity: its reciprocal's products vanish, and its square does not overflow.
HUGE = 1e100
#: Curvature added to H in factorisations, relative to its size: it damps a step, and moves no limit.
REGULARISATION = 1e-10
#: Curvature that holds a row at a bound, relative to the size of H.
PENALTY = 1e8
#: Multipliers are expected at this fraction of the forces that they balance.
TYPICAL = 0.05


@dataclass(frozen=True)
class BatchedQPs:
    """`SoftQPs` as tensors, `HUGE` for infinity, with what a solve computes from them once.

    H, G and the regularised H are ``(1, ..)`` where the batch shares them, and then ``products``
    holds the outer products of G's rows, ``(r, d d)``; else they are ``(B, ..)``. ``width`` and
    ``force``, ``(B, r)``, are the typical distance between a row's bounds and size of its
    multiplier, ``cost`` ``(B,)`` their least product; ``penalty`` is the curvature along a row that
    holds it at a bound.
    """

    H: Tensor
    G: Tensor
    regularised: Tensor
    penalty: Tensor
    products: Tensor | None
    g: Tensor
    l: Tensor
    u: Tensor
    w: Tensor
    width: Tensor
    force: Tensor
    cost: Tensor

    @classmethod
    def of(
        cls, H: Tensor, G: Tensor, group: Tensor, g: Tensor, l: Tensor, u: Tensor, w: Tensor
    ) -> BatchedQPs:
        """From the tensors of `SoftQPs`."""
        size = _largest(H.flatten(1)) + 1e-6 * _largest(G.flatten(1)).square()
        eye = torch.eye(H.shape[-1], dtype=H.dtype, device=H.device)
        regularised = H + REGULARISATION * size.unsqueeze(-1) * eye
        penalty = PENALTY * size / G.square().sum(-1).clamp(min=1e-300)
        products = None
        if len(H) == 1:
            products = (G[0].unsqueeze(-1) * G[0].unsqueeze(-2)).flatten(1)
        else:
            H, G, regularised, penalty = (m[group] for m in (H, G, regularised, penalty))
        l, u, w = l.clamp(min=-HUGE), u.clamp(max=HUGE), w.clamp(max=HUGE)
        size = G.abs().amax(-1).clamp(min=1e-300)
        width = (u - l) / size
        known = (width > 0) & (width < HUGE / 1e10)
        mean = (width * known).sum(-1, keepdim=True) / known.sum(-1, keepdim=True)
        mean = mean.nan_to_num(1.0)
        width = torch.where(known, width, mean).maximum(1e-3 * mean)
        forces = _largest(g) + _largest(H.flatten(1)) * width.amin(-1, keepdim=True)
        forces = torch.where(forces > 0, forces, 1.0)
        width, force = width * size, TYPICAL * forces / size
        cost = (force * width).amin(-1)
        return cls(H, G, regularised, penalty, products, g, l, u, w, width, force, cost)

    def __len__(self) -> int:
        return len(self.g)

    def take(self, index: Tensor) -> BatchedQPs:
        """The QPs at ``index``."""
        shared = ("H", "G", "regularised", "penalty") if self.products is not None else ()
        parts = {field.name: getattr(self, field.name) for field in fields(self)}
        return BatchedQPs(
            **{
                name: part if name in (*shared, "products") else part[index]
                for name, part in parts.items()
            }
        )

    def bend(self, v: Tensor) -> Tensor:
        """H v, ``(B, d)``."""
        return self._multiply(self.H, v)

    def rows(self, v: Tensor) -> Tensor:
        """y = G v, ``(B, r)``."""
        return self._multiply(self.G, v)

    def pull(self, lam: Tensor) -> Tensor:
        """G' lam, ``(B, d)``."""
        return self._multiply(self.G.mT, lam)

    def factor(self, weight: Tensor) -> Tensor:
        """Cholesky factors of ``H + G' diag(weight) G``, ``(B, d, d)``; NaN or worse where none."""
        if self.products is not None:
            normal = torch.addmm(self.regularised.flatten(1), weight, self.products)
            normal = normal.unflatten(1, self.H.shape[1:])
        else:
            normal = torch.baddbmm(self.regularised, (self.G * weight.unsqueeze(-1)).mT, self.G)
        return torch.linalg.cholesky_ex(normal)[0]

    def residual(self, v: Tensor, lam: Tensor) -> Tensor:
        """The certificate's relative KKT residual, of the condensed problem, ``(B,)``."""
        Hv, y, pull = self.bend(v), self.rows(v), self.pull(lam)
        stationarity = _largest(Hv + self.g + pull)
        stationarity /= 1 + _largest(torch.cat((Hv, self.g, pull), dim=-1))
        hard = self.w == HUGE
        weight, outside = self.w.masked_fill(hard, 0), (y - y.clip(self.l, self.u)).abs()
        violation = _largest(outside * hard / (1 + y.abs()))
        excess = _largest((lam.abs() - self.w).clamp(min=0) / (1 + weight))
        charge = weight * outside
        gap = charge + lam.clamp(min=0) * (self.u - y) + lam.clamp(max=0) * (self.l - y)
        cost = (v * (Hv / 2 + self.g)).sum(-1, keepdim=True) + charge.sum(-1, keepdim=True)
        gap = gap.abs().sum(-1, keepdim=True) / (1 + cost.abs())
        parts = (stationarity, violation, excess, gap)
        return torch.cat(parts, dim=-1).amax(-1).nan_to_num(torch.inf, torch.inf)

    def _multiply(self, matrices: Tensor, vectors: Tensor) -> Tensor:
        if self.products is not None:
            return vectors @ matrices[0].mT
        return torch.bmm(matrices, vectors.unsqueeze(-1)).squeeze(-1)


def _largest(x: Tensor) -> Tensor:
    """Largest absolute entry along the last dimension, which stays; zero where it is empty."""
    return x.abs().amax(-1, keepdim=True) if x.shape[-1] else x.new_zeros(*x.shape[:-1], 1)
