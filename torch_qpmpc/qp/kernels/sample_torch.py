"""Computations for each QP of a batch, in torch for devices other than the CPU.

The functions and their arguments are those of `torch_qpmpc.qp.kernels.sample`, with tensors on one
device in place of arrays.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from torch_qpmpc.qp.batching import largest, multiply
from torch_qpmpc.qp.kernels.sample import MAX_PASSES, MAX_STEPS, SLIP, VIOLATED
from torch_qpmpc.qp.solution import active_codes


def offsets(fixed, group, matrix, constant) -> Tensor:
    return multiply(matrix.mT, group, fixed) + constant


def recover(v, lam, group, fixed, theta, reduced, diagonal, passes=0) -> tuple[Tensor, ...]:
    Y_neg, C = reduced.Y_neg, theta.C
    z = multiply(reduced.T, group, torch.cat((fixed, v), dim=-1)) + reduced.z_0
    for _ in range(passes):
        z = z + multiply(Y_neg, group, multiply(C, group, z) - theta.b)
    Hz, y = multiply(theta.H, group, z), multiply(theta.G, group, z)
    # A violated row without free variables has lam = w or -w; a hard one stays violated.
    beyond = F.hardshrink(y - y.clamp(theta.lb, theta.ub), VIOLATED)
    all_lam = beyond.sign() * theta.w.masked_fill(theta.w.isinf(), 0.0)
    all_lam[:, reduced.rows] = lam.clamp(-reduced.w, reduced.w)
    G_lam = multiply(theta.G.mT, group, all_lam)
    left = Hz + theta.q + G_lam
    chi = multiply(Y_neg.mT, group, left)
    C_chi = multiply(C.mT, group, chi)
    for _ in range(passes):
        chi = chi + multiply(Y_neg.mT, group, left + C_chi)
        C_chi = multiply(C.mT, group, chi)
    left = left + C_chi
    xi = -left[:, : fixed.shape[-1]]
    left[:, : fixed.shape[-1]] += xi
    value, residual = _judge(z, all_lam, chi, group, fixed, theta, Hz, G_lam, C_chi, left, y)
    codes = active_codes(y, all_lam, theta.lb, theta.ub, theta.w)
    return value, z, chi, all_lam, xi, codes, residual


def certify(z, lam, chi, xi, group, fixed, theta, diagonal) -> tuple[Tensor, Tensor]:
    Hz, y = multiply(theta.H, group, z), multiply(theta.G, group, z)
    G_lam, C_chi = multiply(theta.G.mT, group, lam), multiply(theta.C.mT, group, chi)
    left = Hz + theta.q + G_lam + C_chi
    left[:, : xi.shape[-1]] += xi
    return _judge(z, lam, chi, group, fixed, theta, Hz, G_lam, C_chi, left, y)


def _judge(z, lam, chi, group, fixed, theta, Hz, G_lam, C_chi, left, y) -> tuple[Tensor, Tensor]:
    lb, ub, w = theta.lb, theta.ub, theta.w
    hard, no_lb, no_ub = w.isinf(), lb.isinf(), ub.isinf()
    up, down = lam.clamp(min=0.0), lam.clamp(max=0.0)
    outside = (y - y.clamp(lb, ub)).abs()
    charge = outside * w.masked_fill(hard, 0.0)
    # h(y) + h*(lam) - lam y for each row, see `torch_qpmpc.qp.pipeline.certificate`.
    gap = charge + (ub.masked_fill(no_ub, 0.0) - y) * up + (lb.masked_fill(no_lb, 0.0) - y) * down
    cost = torch.linalg.vecdot(theta.q + 0.5 * Hz, z) + charge.sum(-1)
    short = multiply(theta.C, group, z) - theta.b
    # With a huge z or chi, relative errors can be small but matter to the cost.
    slip = torch.linalg.vecdot(left.abs(), z.abs())
    slip = slip + torch.linalg.vecdot(short.abs(), chi.abs()) + gap.abs().sum(-1)
    forces = torch.cat((Hz, G_lam, C_chi, theta.q.expand_as(z)), dim=-1)
    errors = (
        left / (1.0 + largest(forces, keepdim=True)),
        short / (1.0 + largest(theta.b, keepdim=True) + largest(z, keepdim=True)),
        z[:, : fixed.shape[-1]] - fixed,
        # A hard row's violation, and a soft row's multiplier beyond w.
        torch.where(hard, outside / (1.0 + y.abs()), (lam.abs() - w) / (1.0 + w)).clamp(min=0),
        up * no_ub,
        down * no_lb,
        (slip / (1.0 + cost.abs())).unsqueeze(-1),
    )
    residual = largest(torch.cat(errors, dim=-1)).nan_to_num_(torch.inf, torch.inf)
    return cost + theta.c, residual


def try_active_sets(qps, forces, active) -> tuple[Tensor, ...]:
    known = ((active >= -2) & (active <= 2)).all(-1)
    active = torch.where(known.unsqueeze(-1), active, 0)
    v, lam, y = _solve(qps, forces, active)
    steps, done = torch.ones_like(qps.group), torch.ones_like(known)
    todo = _contradicted(qps, active, lam, y).nonzero().squeeze(-1)
    for _ in range(MAX_STEPS - 1):
        if not len(todo):
            break
        rest = qps.take(todo)
        active[todo] = _corrected(rest, active[todo], lam[todo], y[todo])
        v[todo], lam[todo], y[todo] = new = _solve(rest, forces, active[todo])
        steps[todo] += 1
        todo = todo[_contradicted(rest, active[todo], *new[1:])]
    done[todo] = False
    return v, lam, steps, done


def _contradicted(qps, active: Tensor, lam: Tensor, y: Tensor) -> Tensor:
    """Return the mask of QPs whose lam or y contradicts the active set, ``(B,)``.

    A saturated row that is back within its bounds is left to the certificate.
    """
    outside = (y - y.clamp(qps.l, qps.u)).abs_() > SLIP * (1 + y.abs())
    outside &= active.abs() < 2
    inwards = lam * active < -SLIP * (1 + lam.abs())
    return (outside | inwards | (lam.abs() > (1 + SLIP) * qps.w)).any(-1)


def _corrected(qps, active: Tensor, lam: Tensor, y: Tensor) -> Tensor:
    """Return the semi-smooth Newton method's next active set."""
    slip = SLIP * (1 + y.abs())
    above, below = y > qps.u + slip, y < qps.l - slip
    held = active.abs() == 1
    over = held & (lam.abs() > (1 + SLIP) * qps.w)
    # A held row whose multiplier points inwards is released, unless its bounds are equal.
    loose = held & (lam * active < -SLIP * (1 + lam.abs())) & (qps.l < qps.u)
    # A saturated row that is back within its bounds is held, like an inactive one outside them.
    back = ((active == 2) & (y < qps.u - slip)) | ((active == -2) & (y > qps.l + slip))
    corrected = torch.where(over, 2 * lam.sign().to(torch.int8), active)
    corrected = torch.where(back, active.sign(), corrected).masked_fill_(loose & ~over, 0)
    return torch.where(active == 0, above.to(torch.int8) - below.to(torch.int8), corrected)


def _solve(qps, forces, active: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return v, lam and y with held rows at their bounds, and saturated ones at lam = w or -w."""
    d, size = qps.g.shape[-1], active.abs()
    vy = -multiply(forces.rise.mT, qps.group, qps.g)
    lam, saturated = torch.zeros_like(qps.l), size == 2
    if saturated.any():
        lam = torch.where(saturated, active.sign() * qps.w, 0)
        vy = vy - multiply(forces.push.mT, qps.group, lam)
    order, real = _order(size == 1)
    factor = _factor_held(forces.push[:, :, d:], qps.group, order, real)
    order = order * real
    level = torch.where(active > 0, qps.u, qps.l).gather(1, order)
    for _ in range(MAX_PASSES):
        short = (vy[:, d:].gather(1, order) - level).masked_fill_(~real, 0)
        if not (short.abs() > SLIP * (1 + level.abs())).any():
            break
        push = torch.cholesky_solve(short.unsqueeze(-1), factor).squeeze(-1)
        pull = torch.zeros_like(lam).scatter_add_(1, order, push)
        lam = lam + pull
        vy = vy - multiply(forces.push.mT, qps.group, pull)
    return vy[:, :d], lam, vy[:, d:]


def _order(held: Tensor) -> tuple[Tensor, Tensor]:
    """Return the indices of the held rows, padded with r, and the mask of real ones, ``(B, k)``.

    k is the largest number of held rows in a QP.
    """
    n_qps, r = held.shape
    position = held.cumsum(-1)
    k = int(position[:, -1].max()) if n_qps else 0
    order = torch.full((n_qps, k + 1), r, device=held.device)
    # Rows that are not held are written to an extra last column.
    index = torch.arange(r, device=held.device).expand(n_qps, r)
    order.scatter_(1, torch.where(held, position - 1, k), index)
    return order[:, :k], torch.arange(k, device=held.device) < position[:, -1:]


def _factor_held(K: Tensor, group: Tensor, order: Tensor, real: Tensor) -> Tensor:
    """Return the factor of K's rows and columns ``order`` ``(B, k)``; padding is an identity."""
    K = F.pad(K, (0, 1, 0, 1))  # for the padding
    n = K.shape[-1]
    index = order.unsqueeze(-1) * n + order.unsqueeze(-2)
    if len(K) > 1:
        index += (group * n * n)[:, None, None]
    K = torch.take(K, index)
    K.diagonal(dim1=-2, dim2=-1).add_(~real)
    return torch.linalg.cholesky_ex(K).L
