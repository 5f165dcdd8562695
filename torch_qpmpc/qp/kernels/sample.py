"""Computations for each QP of a batch, as loops that Numba compiles for the CPU.

Arrays are float64 and contiguous; a vector that the whole batch shares has one row.

The certificate judges the results of all backends, by a relative KKT residual and a bound of the
value's error. For multipliers ``lam = eta - upsilon`` of the softened
rows, optimality of ``h(y) = w dist(y, [lb, ub])`` in y = Gz is ``h(y) + h*(lam) = lam y`` with
conjugate ``h*(lam) = ub max(lam, 0) - lb max(-lam, 0)`` on ``|lam| <= w`` (Fenchel and Young). Each
row's gap is non-negative on its own, so errors of opposite sign cannot cancel as they do in a
summed duality gap.

A residual is relative to terms that one large weight or multiplier can dominate. The optimal value
lies between two others, in v, the variables that C z = b leaves free:

* Below, the dual function. The Lagrangian at v is the cost less the rows' gaps, and its slope
  ``r = Hv + g + G'lam`` is at most ``1/2 r'H^-1 r`` above its minimum. For a singular H it is
  ``1/2 r'(H + shift)^-1 r + shift / 2 |reach|^2``, or ``|r|'reach``, or, for any u,
  ``1/2 u'Hu + |r - Hu|'reach``, if some optimum is within ``reach``: within the hard bounds of v,
  or within `RANGE` times the largest entry of z. Where these are large, the bound of zero
  multipliers counts, too: a cost of zero has multipliers that are rounding errors alone.
* Above, the cost of a feasible point. The least step that ends all violations of hard rows, and
  holds those nearly active, is long where rows are nearly parallel. Rounding errors count as
  violations.

``value_error`` is the distance of the two and the rounding errors of the value, relative to the
largest of 1/2 z'Hz, q'z, w'sigma and their sum, or to a millionth of the *swing* if that is larger:
the sum of ``|Hz + q| (ub - lb)`` over the entries with hard bounds, by which the cost changes, to
first order, between these bounds. Where the cost is zero, its errors are small beside the swing.
"""

import math
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from torch_qpmpc.qp.kernels.linalg import (
    add,
    add_product,
    compiled,
    copy,
    dot,
    multipliers,
    particular,
    products,
    summing,
    transposed_products,
)
from torch_qpmpc.qp.program import TOLERANCE, Status

SOLVED, NOT_CONVERGED = int(Status.SOLVED), int(Status.NOT_CONVERGED)
#: A row without free variables that is violated by more, or whose violation costs more than the
#: second, has its weight as multiplier.
VIOLATED, COSTLY = 1e-9, 1e-7
#: Errors of the value are relative to its largest term, but to no more than this many times the
#: value (where z is far along a flat direction, huge terms cancel), and to no less than the floor
#: and this share of the swing: a cost of zero has no digits of its own.
CANCELLED, FLOOR, SHARE = 1e3, 1e-12, 1e-6
#: Some optimum is no further from z than this many times its largest entry, where H is singular.
RANGE = 1e3
#: Passes that split a slope into what a singular H explains and the rest.
SPLITS = 2
#: The terms of a row are summed from this error on; |y|, or |b|, bounds them from below.
CLOSE = 1e-7
#: No bound is so small that its row's violation is relative to less.
LEAST = 2.0**-30
#: A few rounding errors, relative to the terms of a sum.
ROUNDING = 1e-15
#: Rounding errors of the value are looked at closely from this size on.
DOUBTFUL = 1e-8
#: A hard row is nearly active if its slack is this small, relatively.
NEARLY_ACTIVE = 1e-6
#: Rows whose angle has a smaller sine, as rounding leaves, are dependent, and agree within this.
DEPENDENT = 1e-13


class Terms(NamedTuple):
    """Terms of the KKT conditions of B QPs; ``left`` is the residual of stationarity."""

    Hz: Any
    G_lam: Any
    C_chi: Any
    left: Any
    y: Any
    Cz: Any


@compiled
def offsets(fixed, group, matrix, constant):
    """Return the linear costs and bounds of the reduced QPs, ``constant + matrix' fixed``."""
    # Not by BLAS, which rounds a single sample differently from one in a batch.
    out = np.empty((len(fixed), constant.shape[1]))
    for i in range(len(fixed)):
        copy(out[i], constant[i % len(constant)])
        add_product(out[i], fixed[i], matrix[group[i]])
    return out


@partial(compiled, nogil=True)
def recover(v, lam_v, iterations, group, fixed, qps, passes):
    """Complete and certify solutions of reduced QPs.

    The multipliers of C z = b and of the fixed entries follow from the stationarity of the
    Lagrangian: chi by the transposed elimination, xi from the residual in the fixed entries.

    Args:
        v, lam_v: solutions ``(B, d)`` and signed multipliers ``(B, r)`` of the reduced QPs.
        iterations: returned as they are, ``(B,)``.
        group, fixed, qps: the QPs, see `torch_qpmpc.qp.pipeline.batch`.
        passes: the number of iterative refinements of z and chi after the elimination.

    Returns:
        The parts of `BatchSolution`, SOLVED or NOT_CONVERGED.
    """
    theta, condensed, reduced, _ = qps.parts
    n_qps, n_f = fixed.shape
    H, C, G, q = theta.H, theta.C, theta.G, theta.q
    factors, pivots = condensed.factors, condensed.pivots
    of_H, of_C, of_G, of_T, of_factors = condensed.spans
    kept = np.empty((n_qps, n_f + v.shape[1]))
    for i in range(n_qps):
        copy(kept[i, :n_f], fixed[i])
        copy(kept[i, n_f:], v[i])
    z = products(condensed.T, group, kept, of_T)
    for i in range(n_qps):
        add(z[i], 1.0, reduced.z_0[i % len(reduced.z_0)])
    Cz = products(C, group, z, of_C)
    for _ in range(passes):
        for i in range(n_qps):
            add(Cz[i], -1.0, theta.b[i % len(theta.b)])
        z -= particular(factors, pivots, of_factors, group, Cz, z.shape[1])
        Cz = products(C, group, z, of_C)
    Hz, y = products(H, group, z, of_H), products(G, group, z, of_G)
    lam, codes = _all_multipliers(lam_v, y, theta, reduced.rows, reduced.others)
    G_lam = transposed_products(G, group, lam, of_G)
    left = Hz + G_lam
    for i in range(n_qps):
        add(left[i], 1.0, q[i % len(q)])
    chi = multipliers(factors, pivots, of_factors, group, left)
    C_chi = transposed_products(C, group, chi, of_C)
    for _ in range(passes):
        chi += multipliers(factors, pivots, of_factors, group, left + C_chi)
        C_chi = transposed_products(C, group, chi, of_C)
    left += C_chi
    xi = -left[:, :n_f]
    for i in range(n_qps):
        add(left[i, :n_f], 1.0, xi[i])
    terms = Terms(Hz, G_lam, C_chi, left, y, Cz)
    value, residual, error = judge(z, lam, chi, group, fixed, qps, terms)
    status = np.full(n_qps, NOT_CONVERGED)
    for i in range(n_qps):
        if residual[i] <= TOLERANCE and error[i] <= TOLERANCE:
            status[i] = SOLVED
    return value, z, chi, lam, xi, status, residual, error, iterations, codes


@compiled
def _all_multipliers(lam_v, y, theta, rows, others):
    """Return the multipliers of all rows ``(B, n_g)`` and the codes of the active set."""
    lb, ub, w = theta.lb, theta.ub, theta.w
    lam, codes = np.zeros_like(y), np.empty_like(y, np.int8)
    for i in range(len(y)):
        i_lb, i_ub, i_w = i % len(lb), i % len(ub), i % len(w)
        for k in range(len(rows)):
            lam[i, rows[k]] = lam_v[i, k]
        # A separate loop, which LLVM vectorises.
        for j in range(lam.shape[1]):
            force, weight = lam[i, j], w[i_w, j]
            most = weight if ub[i_ub, j] < np.inf else 0.0
            least = -weight if lb[i_lb, j] > -np.inf else 0.0
            lam[i, j] = most if force > most else least if force < least else force
        for j in others:
            weight = w[i_w, j]
            if weight < np.inf:  # a violated hard row stays violated: the residual shows it
                least = VIOLATED if VIOLATED * weight < COSTLY else COSTLY / weight
                if y[i, j] - ub[i_ub, j] > least:
                    lam[i, j] = weight
                elif lb[i_lb, j] - y[i, j] > least:
                    lam[i, j] = -weight
        for j in range(lam.shape[1]):
            below, above, weight = lb[i_lb, j], ub[i_ub, j], w[i_w, j]
            at = y[i, j] + lam[i, j]
            excess = at - min(max(at, below), above)
            held = min(max(excess, -weight), weight)
            if held == excess and (excess != 0 or below == above):
                codes[i, j] = np.sign(lam[i, j])
            else:
                codes[i, j] = 2 * np.sign(held)
    return lam, codes


@compiled
def judge(z, lam, chi, group, fixed, qps, terms):
    """Certify z, lam and chi with their KKT `Terms`.

    Returns:
        The value, the residual and the error of the value, ``(B,)``. The residual is the largest
        error in stationarity, C z = b, the fixed entries and hard rows, each relative to the size
        of its terms; or, if larger, the sum of the errors in C z = b, weighted by |chi|, and of the
        rows' complementarity gaps, relative to the cost.
    """
    theta, condensed, reduced, sizes = qps.parts
    Hz, G_lam, C_chi, left, y, Cz = terms
    H, C, G, q, c, b, lb, ub, w = theta
    T, of_T, (of_H, of_G, of_C) = condensed.T, condensed.spans[3], condensed.sums
    n_f, slopes = fixed.shape[1], transposed_products(T, group, left, of_T)
    value, residual, error = np.empty(len(z)), np.empty(len(z)), np.empty(len(z))
    d = reduced.H.shape[1]
    basis, ends, slacks = np.empty((d + 1, d)), np.empty(d + 1), np.empty(d + 1)
    inverse, shift, box, hard = sizes.inverse, sizes.shift, sizes.box, sizes.hard
    for i in range(len(z)):
        q_i, b_i, m = q[i % len(q)], b[i % len(b)], group[i]
        H_m, C_m, G_m = H[m % len(H)], C[m % len(C)], G[m % len(G)]
        lb_i, ub_i, w_i = lb[i % len(lb)], ub[i % len(ub)], w[i % len(w)]
        linear, quadratic = _cost(z[i], Hz[i], q_i)
        charge, gap = _charge(y[i], lam[i], lb_i, ub_i, w_i)
        gap += _shortage(Cz[i], b_i, chi[i])
        cost = linear + quadratic + charge
        value[i] = cost + c[i % len(c)]
        force, steep, length = _forces(z[i], Hz[i], G_lam[i], C_chi[i], left[i], q_i)
        worst = max(steep / (1.0 + force), _short(Cz[i], b_i, C_m, z[i]))
        for j in range(n_f):
            worst = max(worst, abs(z[i, j] - fixed[i, j]))
        worst = max(worst, _violation(y[i], lb_i, ub_i, w_i, G_m, z[i]))
        worst = max(worst, gap / (1.0 + abs(cost)))

        scale = max(abs(cost), abs(linear), abs(quadratic), charge)
        scale = max(min(scale, CANCELLED * abs(cost)), FLOOR)
        scale = max(scale, SHARE * _swing(Hz[i], q_i, lb_i, ub_i, w_i, G_m, sizes.bounds, length))
        noise = _weighted(z[i], of_H[m]) + _weighted(lam[i], of_G[m])
        noise = length * (noise + _weighted(chi[i], of_C[m]))
        if not ROUNDING * noise < DOUBTFUL * scale:  # the same without the largest entry of z
            noise = _terms(z[i], H_m, z[i]) + _terms(lam[i], G_m, z[i])
            noise += _terms(chi[i], C_m, z[i])
        noise += _weighted(z[i], q_i)
        slope, steps = slopes[i, n_f:], sizes.steps[m]
        far = RANGE * length if shift[m] > 0 else np.inf
        of_slope, steep = _fall(slope, lb_i, ub_i, w_i, far, inverse[m], shift[m], steps, box)
        if shift[m] > 0 and not of_slope < DOUBTFUL * scale:
            curved = (inverse[m], reduced.H[m])
            split = _split_fall(slope, lb_i, ub_i, w_i, far, *curved, steps, box)
            of_slope = split if split < of_slope else of_slope
            own, cost_slope = group[i : i + 1], (Hz[i] + q_i).reshape(1, -1)
            slope = transposed_products(T, own, cost_slope, of_T)[0, n_f:]
            split = _split_fall(slope, lb_i, ub_i, w_i, far, *curved, steps, box)
            factors = (condensed.factors, condensed.pivots, condensed.spans[4])
            free_chi = multipliers(*factors, own, cost_slope)[0]
            split += charge + _shortage(Cz[i], b_i, free_chi)
            if split < gap + of_slope:
                gap, of_slope = 0.0, split
        rows = (y[i], lam[i], lb_i, ub_i, w_i, steps)
        step = _repair(rows, hard, z[i], G_m, sizes.units[m], basis, ends, slacks)
        off = gap + of_slope + ROUNDING * noise + (steep + 0.5 * sizes.stiffness[m] * step) * step
        off += _kinks(y[i], lb_i, ub_i, w_i, steps, step)
        # Sums propagate a NaN in any entry; maxima ignore it.
        sound = gap + abs(cost) + _weighted(slopes[i], slopes[i])
        finite = sound < np.inf and worst < np.inf
        residual[i] = worst if finite else np.inf
        error[i] = off / scale if finite and off < np.inf else np.inf
    return value, residual, error


@summing
def _cost(z, Hz, q):
    """Return q'z and z'Hz / 2."""
    linear = quadratic = 0.0
    for j in range(len(z)):
        of_q, of_H = q[j] * z[j], 0.5 * Hz[j] * z[j]
        linear += of_q
        quadratic += of_H
    return linear, quadratic


@summing
def _weighted(x, sizes):
    """Return |x|'|sizes|."""
    total = 0.0
    for j in range(len(x)):
        total += abs(x[j] * sizes[j])
    return total


@summing
def _square(matrix, x):
    """Return |matrix x|^2."""
    total = 0.0
    for a in range(len(x)):
        part = 0.0
        for b in range(len(x)):
            part += matrix[a, b] * x[b]
        total += part * part
    return total


@compiled
def _terms(x, matrix, z):
    """Return |x|'|matrix||z|."""
    total = 0.0
    for i in range(len(x)):
        if x[i] != 0:
            total += abs(x[i]) * _weighted(z, matrix[i])
    return total


@compiled
def _swing(Hz, q, lb, ub, w, G, bounds, length):
    total = 0.0
    for k in range(len(q)):
        row = bounds[k]
        if row >= 0 and w[row] == np.inf:
            width = (ub[row] - lb[row]) / abs(G[row, k])
            if width < np.inf:
                total += abs(Hz[k] + q[k]) * min(width, RANGE * length)
    return total


@compiled
def _fall(slope, lb, ub, w, far, inverse, shift, steps, box):
    """Return the most by which the Lagrangian is above its minimum in v, and the slope's length.

    It is no more than ``(slope'(H + shift)^-1 slope + shift |reach|^2) / 2``, nor than
    ``|slope|'reach``, where v_k is no further than ``reach_k`` from an optimum: by a hard row that
    contains only v_k, or, if H is singular, ``far``.
    """
    square = linear = length = 0.0
    for a in range(len(slope)):
        square += slope[a] * slope[a]
        reach, row = far, box[a]
        if row >= 0 and w[row] == np.inf:
            reach = min(reach, (ub[row] - lb[row]) / steps[row])
        length += reach * reach
        linear += abs(slope[a]) * reach if slope[a] != 0 else 0.0
    fall = 0.5 * (_square(inverse, slope) + (shift * length if shift > 0 else 0.0))
    # A NaN in fall stays.
    return (linear if linear < fall else fall), math.sqrt(square)


@compiled
def _split_fall(slope, lb, ub, w, far, inverse, H, steps, box):
    """Return the first of `_fall` for a singular H, ``1/2 u'Hu + |slope - Hu|'reach``.

    It holds for each u. This one leaves what has no curvature, and rounding, to the second term.
    """
    d = len(slope)
    u, rest, part = np.zeros(d), slope.copy(), np.empty(d)
    for _ in range(SPLITS):
        for a in range(d):
            part[a] = dot(inverse[a], rest)
        add_product(u, part, inverse)
        for a in range(d):
            rest[a] = slope[a] - dot(H[a], u)
    total = 0.0
    for a in range(d):
        reach, row = far, box[a]
        if row >= 0 and w[row] == np.inf:
            reach = min(reach, (ub[row] - lb[row]) / steps[row])
        total += 0.5 * u[a] * (slope[a] - rest[a])
        total += (abs(rest[a]) + ROUNDING * _weighted(u, H[a])) * reach
    return total


@compiled
def _repair(rows, hard, z, G, units, basis, ends, slacks):
    """Return the length of a step in v that ends all violations of hard rows, with rounding.

    The step holds all nearly active rows. By Gram and Schmidt, they become an orthonormal ``basis``
    along which it goes to ``ends``, each up to the rounding ``slacks`` of its row; the three are
    scratch. It is infinite if rows that are dependent up to rounding disagree by more than that of
    all of them.
    """
    y, _, lb, ub, w, steps = rows
    total, k = 0.0, 0
    for a in range(len(hard)):
        j = hard[a]
        if w[j] < np.inf or not steps[j] > 0:
            continue
        over, size = max(y[j] - ub[j], lb[j] - y[j]), _weighted(z, G[j])
        if over <= -NEARLY_ACTIVE * size:  # also with a multiplier, which the gap charges
            continue
        sign = 1.0 if y[j] - ub[j] > lb[j] - y[j] else -1.0
        part = sign * (max(over, 0.0) + ROUNDING * size) / steps[j]
        slack = DEPENDENT * size / steps[j]
        copy(basis[k], units[a])
        norm = 0.0
        for _ in range(2):
            for e in range(k):
                along = dot(basis[e], basis[k])
                add(basis[k], -along, basis[e])
                part -= along * ends[e]
                slack += abs(along) * slacks[e]
            norm = math.sqrt(dot(basis[k], basis[k]))
            if norm > 0.5:  # else again, for the rounding errors of the first time
                break
        if norm > DEPENDENT and k < len(basis) - 1:  # no more than d rows are independent
            for e in range(len(basis[k])):
                basis[k, e] /= norm
            ends[k], slacks[k] = part / norm, slack / norm
            total += ends[k] ** 2
            k += 1
        elif abs(part) > slack + DEPENDENT * math.sqrt(total):
            return np.inf
    return math.sqrt(total)


@summing
def _kinks(y, lb, ub, w, steps, step):
    """Return the most by which the charges of soft rows exceed their tangents after a step in v."""
    total = 0.0
    for j in range(len(y)):
        move = steps[j] * step
        away = min(abs(y[j] - lb[j]), abs(y[j] - ub[j]))
        total += 2.0 * w[j] * move if away < move and w[j] < np.inf else 0.0
    return total


@summing
def _charge(y, lam, lb, ub, w):
    """Return w'sigma and the sum of the rows' complementarity gaps."""
    total = slip = 0.0
    for j in range(len(y)):
        at, force, weight, above, below = y[j], lam[j], w[j], ub[j], lb[j]
        outside = at - above if at > above else below - at if at < below else 0.0
        charge = outside * (0.0 if weight == np.inf else weight)
        # NaN fails both comparisons, and stays.
        up, down = 0.0 if force < 0 else force, 0.0 if force > 0 else force
        above, below = 0.0 if above == np.inf else above, 0.0 if below == -np.inf else below
        total += charge
        slip += abs(charge + (above - at) * up + (below - at) * down)
    return total, slip


@summing
def _shortage(Cz, b, chi):
    """Return the sum of |C z - b| weighted by |chi|."""
    slip = 0.0
    for j in range(len(b)):
        slip += abs((Cz[j] - b[j]) * chi[j])
    return slip


@compiled
def _forces(z, Hz, G_lam, C_chi, left, q):
    """Return the largest absolute terms of stationarity, its residual, and z."""
    force = slope = length = 0.0
    for j in range(len(z)):
        force = max(force, max(abs(q[j]), abs(Hz[j])))
        force = max(force, max(abs(G_lam[j]), abs(C_chi[j])))
        slope, length = max(slope, abs(left[j])), max(length, abs(z[j]))
    return force, slope, length


@compiled
def _short(Cz, b, C, z):
    """Return the largest error of C z = b, relative to the terms of its row."""
    error = 0.0
    for j in range(len(b)):
        error = max(error, abs(Cz[j] - b[j]) / (1.0 + abs(b[j])))
    if error > CLOSE:
        error = 0.0
        for j in range(len(b)):
            terms = 1.0 + abs(b[j]) + _weighted(z, C[j])
            error = max(error, abs(Cz[j] - b[j]) / terms)
    return error


@compiled
def _violation(y, lb, ub, w, G, z):
    """Return the largest violation of a hard row, relative to the terms of its row."""
    violation = 0.0
    for j in range(len(y)):
        over = max(y[j] - ub[j], lb[j] - y[j])
        if w[j] == np.inf and over > 0:
            violation = max(violation, over / (_floor(lb[j], ub[j]) + abs(y[j])))
    if violation > CLOSE:
        violation = 0.0
        for j in range(len(y)):
            if w[j] == np.inf:
                over, floor = max(y[j] - ub[j], lb[j] - y[j]), _floor(lb[j], ub[j])
                violation = max(violation, over / (floor + _weighted(z, G[j])))
    return violation


@compiled
def _floor(below, above):
    """Return the smaller nonzero bound of a row, between `LEAST` and one."""
    near = min(abs(below) if below != 0 else np.inf, abs(above) if above != 0 else np.inf)
    return min(max(near, LEAST), 1.0)
