"""The warm start of every solver: the active set of a nearly equal QP, tried for a whole batch.

Between two visits to a transition theta has moved a little, and most active sets have not changed.
With the set held, the KKT conditions are linear in its multipliers: with K = G H^-1 G', one
Cholesky factor of K's active part a QP, and no loop over the batch. Where the signs of the solution
contradict the set, the rows concerned change their state, and it is tried again. What comes to no
end in this way is for a solver; whether an end is a solution is for the certificate to say. A QP of
which no set is known starts from the empty one, and mostly comes to its end from there.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from torch_qpmpc.qp.kernels import per_sample, per_theta
from torch_qpmpc.qp.pipeline.batch import SoftQPs, multiply
from torch_qpmpc.qp.pipeline.condensing import SMALL
from torch_qpmpc.qp.solvers.base import Answer

#: How often an active set is tried, corrected in between, before a solver is asked instead.
MAX_STEPS = 10
#: Solves of the equations of one set: the first, and against what rounding left of it.
MAX_PASSES = 3
#: Relative errors up to which bounds are kept, and up to which signs are right.
SLIP = 1e-9


def recall(qps: SoftQPs, active: Tensor) -> tuple[Answer, Tensor]:
    """v and lam of the active sets ``(B, r)``, or of sets near to them, and where there are some.

    The codes are those of `QPSolution.active`; a set with any other code begins as the empty one.
    """
    if qps.device.type == "cpu":
        return _recall_compiled(qps, active)
    return _recall(_Forces(qps), qps, active)


def _recall_compiled(qps: SoftQPs, active: Tensor) -> tuple[Answer, Tensor]:
    """`recall` by kernels."""
    H, G, group, g, lower, upper, w = map(np.ascontiguousarray, qps.arrays)
    if max(math.prod(H.shape[1:]), math.prod(G.shape[1:])) <= SMALL:
        rise, push = per_theta.forces(H, G)
        free = -per_sample.products(g, rise, group, False)
    else:  # for BLAS, and all cores
        forces = _Forces(qps)
        free = -multiply(forces.rise, qps.group, qps.g)
        free, push = per_sample.arrays(free, forces.push.mT)
    codes, limits = per_sample.arrays(active)[0], (SLIP, MAX_STEPS, MAX_PASSES)
    found = per_sample.recall(free, push, group, codes, lower, upper, w, *limits)
    *answer, done = found
    return Answer.on(qps.device, *answer), torch.from_numpy(done)


def _recall(forces: _Forces, qps: SoftQPs, active: Tensor) -> tuple[Answer, Tensor]:
    """`recall` in torch, for any device."""
    known = ((active >= -2) & (active <= 2)).all(-1)
    active = torch.where(known.unsqueeze(-1), active, 0)
    v, lam, y = forces.solve(qps, active)
    steps, done = torch.ones_like(qps.group), torch.ones_like(known)
    todo = _contradicted(qps, active, lam, y).nonzero().squeeze(-1)
    for _ in range(MAX_STEPS - 1):
        if not len(todo):
            break
        part = qps.take(todo)
        active[todo] = _corrected(part, active[todo], lam[todo], y[todo])
        v[todo], lam[todo], y[todo] = found = forces.solve(part, active[todo])
        steps[todo] += 1
        todo = todo[_contradicted(part, active[todo], *found[1:])]
    done[todo] = False
    return Answer(v, lam, steps), done


def _contradicted(qps: SoftQPs, active: Tensor, lam: Tensor, y: Tensor) -> Tensor:
    """Whether lam or y shows that the active set is another one, ``(B,)``.

    A saturated row that is back within its bounds is left to the certificate.
    """
    outside = (y - y.clamp(qps.l, qps.u)).abs_() > SLIP * (1 + y.abs())
    outside &= active.abs() < 2
    inwards = lam * active < -SLIP * (1 + lam.abs())
    return (outside | inwards | (lam.abs() > (1 + SLIP) * qps.w)).any(-1)


def _corrected(qps: SoftQPs, active: Tensor, lam: Tensor, y: Tensor) -> Tensor:
    """The codes that lam and y ask for: the semi-smooth Newton method's next active set."""
    slip = SLIP * (1 + y.abs())
    above, below = y > qps.u + slip, y < qps.l - slip
    held = active.abs() == 1
    over = held & (lam.abs() > (1 + SLIP) * qps.w)
    # A held row whose multiplier pulls inwards is let go, unless both its bounds are one.
    loose = held & (lam * active < -SLIP * (1 + lam.abs())) & (qps.l < qps.u)
    # A saturated row that is back within its bounds is held; an idle one that is outside, too.
    back = ((active == 2) & (y < qps.u - slip)) | ((active == -2) & (y > qps.l + slip))
    corrected = torch.where(over, 2 * lam.sign().to(torch.int8), active)
    corrected = torch.where(back, active.sign(), corrected).masked_fill_(loose & ~over, 0)
    return torch.where(active == 0, above.to(torch.int8) - below.to(torch.int8), corrected)


class _Forces:
    """What g and multipliers do to (v, y): ``rise`` g and ``push`` lam, by H^-1 and G H^-1."""

    def __init__(self, qps: SoftQPs) -> None:
        self.d, G = qps.g.shape[1], qps.G
        unit = torch.eye(self.d, dtype=G.dtype, device=G.device)
        inverse = torch.cholesky_solve(unit, torch.linalg.cholesky_ex(qps.H).L)
        self.rise = torch.cat((inverse, G @ inverse), dim=-2)
        self.push = self.rise @ G.mT

    def solve(self, qps: SoftQPs, active: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """v, lam and y with held rows at their bounds, and saturated ones at lam = +w or -w."""
        d = self.d
        size = active.abs()
        vy = -multiply(self.rise, qps.group, qps.g)
        lam, saturated = torch.zeros_like(qps.l), size == 2
        if saturated.any():
            lam = torch.where(saturated, active.sign() * qps.w, 0)
            vy -= multiply(self.push, qps.group, lam)
        order, real = _order(size == 1)
        factor = self._factor_among(qps, order, real)
        order = order * real
        level = torch.where(active > 0, qps.u, qps.l).gather(1, order)
        for _ in range(MAX_PASSES):
            short = (vy[:, d:].gather(1, order) - level).masked_fill_(~real, 0)
            if not (short.abs() > SLIP * (1 + level.abs())).any():
                break
            push = torch.cholesky_solve(short.unsqueeze(-1), factor).squeeze(-1)
            pull = torch.zeros_like(lam).scatter_add_(1, order, push)
            lam += pull
            vy -= multiply(self.push, qps.group, pull)
        return vy[:, :d], lam, vy[:, d:]

    def _factor_among(self, qps: SoftQPs, order: Tensor, real: Tensor) -> Tensor:
        """The factor of K's rows and columns ``order`` ``(B, k)``, of the unit where not real."""
        K = torch.nn.functional.pad(self.push[:, self.d :], (0, 1, 0, 1))  # for what is not real
        n = K.shape[-1]
        index = order.unsqueeze(-1) * n + order.unsqueeze(-2)
        if len(K) > 1:
            index += (qps.group * n * n)[:, None, None]
        K = torch.take(K, index)
        K.diagonal(dim1=-2, dim2=-1).add_(~real)
        return torch.linalg.cholesky_ex(K).L


def _order(held: Tensor) -> tuple[Tensor, Tensor]:
    """The indices of the held rows ``(B, k)``, k the most in any QP, and which are real.

    The others are r, which is no row.
    """
    n_qps, r = held.shape
    position = held.cumsum(-1)
    k = int(position[:, -1].max()) if n_qps else 0
    order = torch.full((n_qps, k + 1), r, device=held.device)
    # What is not held goes to a last column, which is cut off.
    index = torch.arange(r, device=held.device).expand(n_qps, r)
    order.scatter_(1, torch.where(held, position - 1, k), index)
    return order[:, :k], torch.arange(k, device=held.device) < position[:, -1:]
