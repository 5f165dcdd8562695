"""Completes and certifies solutions as `torch_qpmpc.qp.kernels.sample`, in torch, on a device.

`torch_qpmpc.qp.pipeline.device` solves QPs there. The functions and their arguments are those of
the compiled loops, with tensors in place of arrays. The bound of a value's error is no smaller: for
a singular H and for hard rows that are nearly dependent it lacks the close look, which the CPU has.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torch_qpmpc.qp.kernels.batched import largest, multiply
from torch_qpmpc.qp.kernels.sample import (
    CANCELLED,
    COSTLY,
    DOUBTFUL,
    FLOOR,
    LEAST,
    NEARLY_ACTIVE,
    NOT_CONVERGED,
    RANGE,
    ROUNDING,
    SHARE,
    SOLVED,
    VIOLATED,
    Terms,
)
from torch_qpmpc.qp.program import TOLERANCE
from torch_qpmpc.qp.solution import active_codes


def recover(v, lam, iterations, group, fixed, theta, reduced, sizes) -> tuple[Tensor, ...]:
    Y_neg, C = reduced.Y_neg, theta.C
    z = multiply(reduced.T, group, torch.cat((fixed, v), dim=-1)) + reduced.z_0
    Hz, y = multiply(theta.H, group, z), multiply(theta.G, group, z)
    # A violated row without free variables has lam = w or -w; a hard one stays violated.
    beyond = y - y.clamp(theta.lb, theta.ub)
    beyond = beyond * (beyond.abs() > (COSTLY / theta.w).clamp(max=VIOLATED))
    all_lam = beyond.sign() * theta.w.masked_fill(theta.w.isinf(), 0.0)
    all_lam[:, reduced.rows] = lam.clamp(-reduced.w, reduced.w)
    all_lam = torch.where(all_lam > 0, theta.ub, -theta.lb).isinf().logical_not() * all_lam
    G_lam = multiply(theta.G.mT, group, all_lam)
    left = Hz + theta.q + G_lam
    chi = multiply(Y_neg.mT, group, left)
    C_chi = multiply(C.mT, group, chi)
    left = left + C_chi
    xi = -left[:, : fixed.shape[-1]]
    left[:, : fixed.shape[-1]] += xi
    terms = Terms(Hz, G_lam, C_chi, left, y, multiply(C, group, z))
    value, *errors = judge(z, all_lam, chi, group, fixed, theta, reduced, sizes, terms)
    solved = (errors[0] <= TOLERANCE) & (errors[1] <= TOLERANCE)
    status = torch.where(solved, SOLVED, NOT_CONVERGED)
    codes = active_codes(y, all_lam, theta.lb, theta.ub, theta.w)
    return value, z, chi, all_lam, xi, status, *errors, iterations, codes


def judge(z, lam, chi, group, fixed, theta, reduced, sizes, terms) -> tuple[Tensor, Tensor, Tensor]:
    Hz, G_lam, C_chi, left, y, Cz = terms
    lb, ub, w = theta.lb, theta.ub, theta.w
    hard, no_lb, no_ub = w.isinf(), lb.isinf(), ub.isinf()
    up, down = lam.clamp(min=0.0), lam.clamp(max=0.0)
    outside = (y - y.clamp(lb, ub)).abs()
    charge = outside * w.masked_fill(hard, 0.0)
    # h(y) + h*(lam) - lam y for each row, see `torch_qpmpc.qp.kernels.sample`.
    gap = charge + (ub.masked_fill(no_ub, 0.0) - y) * up + (lb.masked_fill(no_lb, 0.0) - y) * down
    charge = charge.sum(-1)
    linear, quadratic = torch.linalg.vecdot(theta.q, z), torch.linalg.vecdot(0.5 * Hz, z)
    cost = linear + quadratic + charge
    short, near = Cz - theta.b, torch.minimum(*(x.abs() + (x == 0) for x in (theta.lb, theta.ub)))
    near = near.clamp(LEAST, 1.0)
    gap = _shortage(short, chi) + gap.abs().sum(-1)
    forces = torch.cat((Hz, G_lam, C_chi, theta.q.expand_as(z)), dim=-1)
    parts = (z, theta.H, sizes.costs), (lam, theta.G, sizes.rows), (chi, theta.C, sizes.equalities)
    of_rows = [multiply(matrix.abs(), group, z.abs()) for _, matrix, _ in parts]
    errors = (
        left / (1.0 + largest(forces, keepdim=True)),
        short / (1.0 + theta.b.abs() + of_rows[2]),
        z[:, : fixed.shape[-1]] - fixed,
        torch.where(hard, outside / (near + of_rows[1]), 0.0),
        (gap / (1.0 + cost.abs())).unsqueeze(-1),
    )
    slopes = multiply(reduced.T.mT, group, left)
    sound = gap + cost.abs() + torch.linalg.vecdot(slopes, slopes)
    residual = largest(torch.cat(errors, dim=-1)).nan_to_num_(torch.inf, torch.inf)
    residual = torch.where(sound < torch.inf, residual, torch.inf)

    value, length = cost + theta.c, largest(z)
    scale = torch.stack((cost, linear, quadratic, charge)).abs().amax(0)
    scale = scale.minimum(CANCELLED * cost.abs()).clamp(min=FLOOR)
    scale = scale.maximum(SHARE * _swing(Hz + theta.q, theta, sizes, group, RANGE * length))
    size = sum(torch.linalg.vecdot(sums[group], x.abs()) for x, _, sums in parts) * length
    close = sum(torch.linalg.vecdot(t, x.abs()) for (x, *_), t in zip(parts, of_rows, strict=True))
    size = torch.where(ROUNDING * size < DOUBTFUL * scale, size, close)
    size = size + torch.linalg.vecdot(theta.q.abs(), z.abs())
    step = _repair(y, lam, theta, of_rows[1], sizes, group)
    slope = slopes[:, fixed.shape[-1] :]
    reach = _reach(slope, theta, RANGE * length, sizes, group)
    fall, steep = _fall(slope, reach, sizes, group)
    off = gap + fall + ROUNDING * size + (steep + 0.5 * sizes.stiffness[group] * step) * step
    off = off + _kinks(y, theta, sizes.steps[group], step)
    error = (off / scale).nan_to_num(torch.inf, torch.inf).masked_fill_(residual.isinf(), torch.inf)
    return value, residual, error


def _swing(slope, theta, sizes, group, far) -> Tensor:
    if not theta.lb.shape[-1]:
        return torch.zeros_like(far)
    rows, entries = sizes.bounds.clamp(min=0), torch.arange(len(sizes.bounds), device=far.device)
    width = (theta.ub - theta.lb)[:, rows] / theta.G[:, rows, entries].abs()[group]
    counts = (sizes.bounds >= 0) & theta.w[:, rows].isinf() & width.isfinite()
    return torch.where(counts, slope.abs() * width.minimum(far.unsqueeze(-1)), 0.0).sum(-1)


def _shortage(short, chi) -> Tensor:
    return torch.linalg.vecdot(short.abs(), chi.abs())


def _reach(slope, theta, far, sizes, group) -> Tensor:
    reach = torch.where(sizes.shift[group] > 0, far, torch.inf).unsqueeze(-1).expand_as(slope)
    if theta.lb.shape[-1]:
        boxed, rows = sizes.box >= 0, sizes.box.clamp(min=0)
        width = ((theta.ub - theta.lb)[:, rows]) / sizes.steps[group][:, rows]
        reach = torch.where(boxed & theta.w[:, rows].isinf(), reach.minimum(width), reach)
    return reach


def _fall(slope, reach, sizes, group) -> tuple[Tensor, Tensor]:
    part, shift = multiply(sizes.inverse, group, slope), sizes.shift[group]
    fall = part.square().sum(-1) + (shift * reach.square().sum(-1)).nan_to_num(nan=0.0)
    linear = torch.where(slope != 0, slope.abs() * reach, 0).sum(-1)
    return (0.5 * fall).minimum(linear), torch.linalg.vector_norm(slope, dim=-1)


def _repair(y, lam, theta, size, sizes, group) -> Tensor:
    """Return the step's length; infinite for several rows that are not nearly orthogonal."""
    y, lam, size = y[:, sizes.hard], lam[:, sizes.hard], size[:, sizes.hard]
    lb, ub, w = (x[:, sizes.hard] for x in (theta.lb, theta.ub, theta.w))
    norm = sizes.steps[group][:, sizes.hard]
    over = torch.maximum(y - ub, lb - y)
    part = (over.clamp(min=0) + ROUNDING * size) / norm
    counts = (over > 0) | (lam != 0) if sizes.apart else over > -NEARLY_ACTIVE * size
    counts = counts & w.isinf() & (norm > 0)
    step = torch.linalg.vector_norm(torch.where(counts, part, 0), dim=-1)
    return step if sizes.apart else torch.where(counts.sum(-1) > 1, torch.inf, step)


def _kinks(y, theta, steps, step) -> Tensor:
    move = steps * step.unsqueeze(-1)
    away = torch.minimum((y - theta.lb).abs(), (y - theta.ub).abs())
    return torch.where((away < move) & theta.w.isfinite(), 2 * theta.w * move, 0).sum(-1)
