"""Computations for each QP of a batch, in torch for devices other than the CPU.

The functions and their arguments are those of `torch_qpmpc.qp.kernels.sample`, with tensors on one
device in place of arrays.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from torch_qpmpc.qp.kernels.sample import (
    CANCELLED,
    COSTLY,
    DEPENDENT,
    DOUBTFUL,
    FLOOR,
    MAX_PASSES,
    MAX_STEPS,
    NEARLY_ACTIVE,
    RANGE,
    ROUNDING,
    SHARE,
    SLIP,
    SPLITS,
    VIOLATED,
    Terms,
)
from torch_qpmpc.qp.pipeline.arrays import SoftQPs
from torch_qpmpc.qp.solution import active_codes


def multiply(matrices: Tensor, group: Tensor, vectors: Tensor) -> Tensor:
    """Multiply each of ``(B or 1, j)`` by its group's matrix of ``(M, i, j)``, to ``(B, i)``."""
    if matrices.shape[0] == 1:
        return F.linear(vectors, matrices[0])
    vectors = vectors.expand(len(group), -1)
    return torch.bmm(matrices[group], vectors.unsqueeze(-1)).squeeze(-1)


def largest(x: Tensor, *, keepdim: bool = False) -> Tensor:
    """Return the largest absolute entry along the last dimension; zero if that is empty."""
    if x.shape[-1]:
        # vector_norm is one operation, but several times slower for a large batch.
        return x.abs().amax(-1, keepdim=keepdim)
    return x.new_zeros((*x.shape[:-1], 1) if keepdim else x.shape[:-1])


def offsets(fixed, group, matrix, constant) -> Tensor:
    return multiply(matrix.mT, group, fixed) + constant


def recover(v, lam, group, fixed, theta, reduced, sizes, passes) -> tuple[Tensor, ...]:
    Y_neg, C = reduced.Y_neg, theta.C
    z = multiply(reduced.T, group, torch.cat((fixed, v), dim=-1)) + reduced.z_0
    for _ in range(passes):
        z = z + multiply(Y_neg, group, multiply(C, group, z) - theta.b)
    Hz, y = multiply(theta.H, group, z), multiply(theta.G, group, z)
    # A violated row without free variables has lam = w or -w; a hard one stays violated.
    beyond = y - y.clamp(theta.lb, theta.ub)
    beyond = beyond * (beyond.abs() > (COSTLY / theta.w).clamp(max=VIOLATED))
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
    terms = Terms(Hz, G_lam, C_chi, left, y, multiply(C, group, z))
    value, *errors = _judge(z, all_lam, chi, group, fixed, theta, reduced, sizes, terms)
    codes = active_codes(y, all_lam, theta.lb, theta.ub, theta.w)
    return value, z, chi, all_lam, xi, codes, *errors


def certify(z, lam, chi, xi, group, fixed, theta, reduced, sizes) -> tuple[Tensor, ...]:
    Hz, y = multiply(theta.H, group, z), multiply(theta.G, group, z)
    G_lam, C_chi = multiply(theta.G.mT, group, lam), multiply(theta.C.mT, group, chi)
    left = Hz + theta.q + G_lam + C_chi
    left[:, : xi.shape[-1]] += xi
    terms = Terms(Hz, G_lam, C_chi, left, y, multiply(theta.C, group, z))
    return _judge(z, lam, chi, group, fixed, theta, reduced, sizes, terms)


def _judge(
    z, lam, chi, group, fixed, theta, reduced, sizes, terms
) -> tuple[Tensor, Tensor, Tensor]:
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
    short = Cz - theta.b
    gap = _shortage(short, chi) + gap.abs().sum(-1)
    forces = torch.cat((Hz, G_lam, C_chi, theta.q.expand_as(z)), dim=-1)
    errors = (
        left / (1.0 + largest(forces, keepdim=True)),
        short / (1.0 + largest(theta.b, keepdim=True) + largest(z, keepdim=True)),
        z[:, : fixed.shape[-1]] - fixed,
        # A hard row's violation, and a soft row's multiplier beyond w.
        torch.where(hard, outside / (1.0 + y.abs()), (lam.abs() - w) / (1.0 + w)).clamp(min=0),
        up * no_ub,
        down * no_lb,
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
    parts = (z, theta.H, sizes.costs), (lam, theta.G, sizes.rows), (chi, theta.C, sizes.equalities)
    of_rows = [multiply(matrix.abs(), group, z.abs()) for _, matrix, _ in parts]
    size = sum(torch.linalg.vecdot(sums[group], x.abs()) for x, _, sums in parts) * length
    close = sum(torch.linalg.vecdot(t, x.abs()) for (x, *_), t in zip(parts, of_rows, strict=True))
    size = torch.where(ROUNDING * size < DOUBTFUL * scale, size, close)
    size = size + torch.linalg.vecdot(theta.q.abs(), z.abs())
    step = _repair(y, lam, theta, of_rows[1], sizes, group)
    n_f, free = fixed.shape[-1], Hz + theta.q
    reach = _reach(slopes[:, n_f:], theta, RANGE * length, sizes, group)
    fall, steep = _fall(slopes[:, n_f:], reach, sizes, group)
    doubtful = (sizes.shift[group] > 0) & ~(fall < DOUBTFUL * scale)
    other = multiply(reduced.T.mT, group, free)[:, n_f:]
    split = gap + _split_fall(slopes[:, n_f:], reach, reduced.H, sizes, group)
    other = charge + _split_fall(other, reach, reduced.H, sizes, group)
    other = other + _shortage(short, multiply(reduced.Y_neg.mT, group, free))
    off = gap + fall
    for bound in (split, other):
        off = torch.where(doubtful & (bound < off), bound, off)
    off = off + ROUNDING * size + (steep + 0.5 * sizes.stiffness[group] * step) * step
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


def _split_fall(slope, reach, H, sizes, group) -> Tensor:
    u, rest = torch.zeros_like(slope), slope
    for _ in range(SPLITS):
        u = u + multiply(sizes.inverse.mT, group, multiply(sizes.inverse, group, rest))
        rest = slope - multiply(H, group, u)
    size = rest.abs() + ROUNDING * multiply(H.abs(), group, u.abs())
    return 0.5 * torch.linalg.vecdot(u, slope - rest) + (size * reach).sum(-1)


def _repair(y, lam, theta, size, sizes, group) -> Tensor:
    y, lam, size = y[:, sizes.hard], lam[:, sizes.hard], size[:, sizes.hard]
    lb, ub, w = (x[:, sizes.hard] for x in (theta.lb, theta.ub, theta.w))
    norm = sizes.steps[group][:, sizes.hard]
    over = torch.maximum(y - ub, lb - y)
    part = (over.clamp(min=0) + ROUNDING * size) / norm
    present = w.isinf() & (norm > 0)
    if sizes.apart:
        counts = present & ((over > 0) | (lam != 0))
        return torch.linalg.vector_norm(torch.where(counts, part, 0), dim=-1)
    near = present & (over > -NEARLY_ACTIVE * size)
    part = torch.where(y - ub > lb - y, part, -part)
    slack, units = DEPENDENT * size / norm, sizes.units[group]
    basis, ends, slacks = torch.zeros_like(units), torch.zeros_like(part), slack.clone()
    total, failed = torch.zeros_like(part[:, 0]), torch.zeros_like(near[:, 0])
    for a in range(near.shape[1]):
        row, end, own = units[:, a], part[:, a], slack[:, a]
        for _ in range(2):
            for e in range(a):
                along = torch.linalg.vecdot(basis[:, e], row)
                row, end = row - along.unsqueeze(-1) * basis[:, e], end - along * ends[:, e]
                own = own + along.abs() * slacks[:, e]
        length = torch.linalg.vector_norm(row, dim=-1)
        new = near[:, a] & (length > DEPENDENT)
        basis[:, a] = torch.where(new.unsqueeze(-1), row / length.unsqueeze(-1), 0)
        ends[:, a], slacks[:, a] = torch.where(new, end / length, 0), own
        apart = end.abs() > own + DEPENDENT * total.sqrt()
        failed |= near[:, a] & ~new & apart
        total = total + ends[:, a].square()
    return torch.where(failed, torch.inf, total.sqrt())


def _kinks(y, theta, steps, step) -> Tensor:
    move = steps * step.unsqueeze(-1)
    away = torch.minimum((y - theta.lb).abs(), (y - theta.ub).abs())
    return torch.where((away < move) & theta.w.isfinite(), 2 * theta.w * move, 0).sum(-1)


def recall(active, sensitivities, group, fixed, theta, reduced, sizes) -> tuple[Tensor, ...]:
    d, r = reduced.G.shape[:0:-1]
    g_l_u = offsets(fixed, group, reduced.matrix, reduced.constant)
    g, lower, upper = g_l_u.split((d, r, r), -1)
    w = reduced.w.expand(len(group), -1)
    qps = SoftQPs(reduced.H, reduced.G, group, g, lower, upper, w)
    v, lam, steps, done = _try_active_sets(qps, sensitivities, active[:, reduced.rows])
    *solution, codes, residual, error = recover(v, lam, group, fixed, theta, reduced, sizes, 0)
    return *solution, 0 * steps, residual.where(done, torch.inf), error, steps, codes


def _try_active_sets(qps, sensitivities, active) -> tuple[Tensor, ...]:
    known = ((active >= -2) & (active <= 2)).all(-1)
    active = torch.where(known.unsqueeze(-1), active, 0)
    v, lam, y = _solve(qps, sensitivities, active)
    steps, done = torch.ones_like(qps.group), torch.ones_like(known)
    corrected, contradicted = _correct(qps, active, lam, y)
    at = todo = contradicted.nonzero().squeeze(-1)
    for _ in range(MAX_STEPS - 1):
        if not len(todo):
            break
        rest, active = qps.take(todo), corrected[at]
        v[todo], lam[todo], y[todo] = new = _solve(rest, sensitivities, active)
        steps[todo] += 1
        corrected, contradicted = _correct(rest, active, *new[1:])
        at = contradicted.nonzero().squeeze(-1)
        todo = todo[at]
    done[todo] = False
    return v, lam, steps, done


def _correct(qps, active: Tensor, lam: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """Return the semi-smooth Newton method's next active sets, and the mask of QPs that need them.

    A saturated row that is back within its bounds is held, but is no reason for another step: it is
    left to the certificate.
    """
    slip, size = SLIP * (1 + y.abs()), active.abs()
    above, below = y > qps.u + slip, y < qps.l - slip
    over = lam.abs() > (1 + SLIP) * qps.w
    inwards = lam * active < -SLIP * (1 + lam.abs())
    contradicted = (over | inwards | ((above | below) & (size < 2))).any(-1)
    # A held row whose multiplier points inwards is released, unless its bounds are equal.
    loose = (size == 1) & inwards & ~over & (qps.l < qps.u)
    back = ((active == 2) & (y < qps.u - slip)) | ((active == -2) & (y > qps.l + slip))
    corrected = torch.where((size == 1) & over, 2 * lam.sign().to(torch.int8), active)
    corrected = torch.where(back, active.sign(), corrected).masked_fill_(loose, 0)
    inactive = above.to(torch.int8) - below.to(torch.int8)
    return torch.where(active == 0, inactive, corrected), contradicted


def _solve(qps, sensitivities, active: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return v, lam and y with held rows at their bounds, and saturated ones at lam = w or -w."""
    d, size = qps.g.shape[-1], active.abs()
    vy = -multiply(sensitivities.to_g.mT, qps.group, qps.g)
    lam, saturated = torch.zeros_like(qps.l), size == 2
    if saturated.any():
        lam = torch.where(saturated, active.sign() * qps.w, 0)
        vy = vy - multiply(sensitivities.to_lam.mT, qps.group, lam)
    level = torch.where(active > 0, qps.u, qps.l)
    vy, change = hold(sensitivities.to_lam, qps.group, vy, size == 1, level, SLIP)
    return vy[:, :d], lam + change, vy[:, d:]


def hold(
    to_lam, group, vy, held, level, slip: float = 0.0, passes: int = MAX_PASSES
) -> tuple[Tensor, Tensor]:
    """Return v and y with the ``held`` rows at their levels, and their multipliers.

    Each pass refines the last one, until y is within ``slip`` of the levels.
    """
    d, t = vy.shape[-1] - held.shape[-1], torch.zeros_like(level)
    order, real = _order(held)
    factor = _factor_held(to_lam[:, :, d:], group, order, real)
    order = order * real
    level = level.gather(1, order)
    for _ in range(passes):
        short = (vy[:, d:].gather(1, order) - level).masked_fill_(~real, 0)
        if not (short.abs() > slip * (1 + level.abs())).any():
            break
        change = torch.cholesky_solve(short.unsqueeze(-1), factor).squeeze(-1)
        change = torch.zeros_like(t).scatter_add_(1, order, change)
        t = t + change
        vy = vy - multiply(to_lam.mT, group, change)
    return vy, t


def _order(held: Tensor) -> tuple[Tensor, Tensor]:
    """Return the indices of the held rows, padded with r, and the mask of real ones, ``(B, k)``.

    k is the largest number of held rows in a QP.
    """
    n_qps, r = held.shape
    position = held.cumsum(-1)
    k = int(position[:, -1].max()) if held.numel() else 0
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
