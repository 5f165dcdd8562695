"""A dual active-set method for QPs in the multipliers of their rows, as loops that Numba compiles.

The rows' y = G v follows from their multipliers lam, in units that give K a unit diagonal,

    y = free - K lam,   K = G H^-1 G',

and a row is free, held at a bound, or saturated at |lam| = w. From any set of held rows, whose
multipliers may have the wrong sign, the method lets go of rows and adds violated ones, one at a
time. The multipliers stay feasible, and the dual cost never falls. ``policy.c`` does the same.

A warm start begins with the active set of a nearly equal QP: between two visits to a transition
theta changes little, and most active sets stay the same. The same Cholesky factor of the held rows
of K solves the linear KKT system of the derivatives.
"""

import math
from functools import partial

import numpy as np

from torch_qpmpc.qp.kernels.linalg import compiled, products, transposed_products
from torch_qpmpc.qp.kernels.sample import offsets, recover

#: Errors of a row that count as rounding, relative to its terms and to the sum of multipliers.
TOLERANCE, ROUNDING = 1e-13, 4e-15
#: A row with a smaller pivot depends on the held ones; smaller entries are rounding.
DEPENDENT, NOISE = 1e-11, 1e-9
#: A violation up to this fraction of a row's terms does not prove that no y is feasible.
FEASIBLE = 1e-8
#: Proximal steps, of a singular H; and slopes of the Lagrangian that one more pass reduces to this
#: fraction of the linear cost, if H is ill-conditioned.
PROXIMAL_STEPS, EXACT = 4, 1e-13
#: The most changes of the active set; and the QPs before, one of which is similar.
MAX_STEPS, NEAR = 2000, 256


@partial(compiled, nogil=True)
def recall(active, group, fixed, dual, qps):
    """Solve QPs from active sets ``(B, n_g)``, complete and certify them.

    Returns:
        What `torch_qpmpc.qp.kernels.sample.recover` does, with one more than the number of changes
        of the set as iterations.
    """
    _, condensed, reduced, _ = qps.parts
    B, (r, d), w = len(fixed), reduced.G.shape[1:], reduced.w
    g_l_u, spans = offsets(fixed, group, reduced.matrix, reduced.constant), condensed.spans[0][:0]
    g = g_l_u[:, :d].copy()
    slope, v, free, steps = g, np.zeros((B, d)), np.zeros((B, r)), np.ones(B, np.int64)
    lam, last, force = np.zeros((B, r)), np.zeros((B, r)), np.zeros((B, r))
    # Rows of one array take half as long again: LLVM cannot tell that they do not overlap.
    low, high, weight, y, x = np.empty(r), np.empty(r), np.empty(r), np.empty(r), np.empty(r)
    sides, held, factor = np.zeros((B, r), np.int64), np.empty(r, np.int64), np.empty((r, r))
    for step in range(PROXIMAL_STEPS if B and dual.shift.max() > 0 else 2):
        v -= products(dual.inverse, group, slope, spans)
        free -= products(dual.rows, group, slope, spans)
        for i in range(B):
            K, unit, i_w, side = dual.K[group[i]], dual.unit[group[i]], i % len(w), sides[i]
            passes = 2
            for j in range(r):
                low[j], high[j] = g_l_u[i, d + j] / unit[j], g_l_u[i, d + r + j] / unit[j]
                weight[j] = w[i_w, j] * unit[j]
                side[j] = side[j] if step else active[i, reduced.rows[j]]
            if r and step == 0 and np.abs(side).max() > 2:  # unknown
                side[:], nearest, passes = 0, np.inf, 1
                for k in range(max(0, i - NEAR), i):
                    distance = 0.0
                    for j in range(fixed.shape[1]):
                        distance += (fixed[i, j] - fixed[k, j]) ** 2
                    if distance < nearest and group[k] == group[i]:
                        side[:], nearest = sides[k], distance
            # Once more from the last set: of one set, the solution is that whatever led to it.
            for _ in range(passes):
                n = _begin(K, low, high, weight, lam[i], side, held, factor, x)
                n, _, changes = solve(
                    K, free[i], low, high, weight, lam[i], y, side, held, n, factor, x, np.inf
                )
                if changes == 1:
                    break
                steps[i] += changes - 1
            for j in range(r):
                last[i, j], force[i, j] = lam[i, j] - last[i, j], lam[i, j] / unit[j]
        v -= transposed_products(dual.rows, group, last, spans)
        last[:] = lam
        slope = g + products(reduced.H, group, v, spans)
        slope += transposed_products(reduced.G, group, force, spans)
        if not slope.size or np.abs(slope).max() <= EXACT * np.abs(g).max():
            break
    return recover(v, force, steps, group, fixed, qps, np.int64(0))


@compiled
def _begin(K, low, high, w, lam, side, held, factor, x):
    """Set multipliers and factor of the states ``side``; return the number of held rows."""
    n = 0
    for j in range(len(lam)):
        lam[j] = 0.0
        if not abs(high[j] if side[j] > 0 else low[j]) < np.inf:
            side[j] = 0
        if abs(side[j]) == 2 and w[j] < np.inf:
            lam[j] = math.copysign(w[j], side[j])
        elif side[j] != 0:
            side[j] = 1 if side[j] > 0 else -1
            if _append(K, j, held, n, factor, x):
                n += 1
            else:
                side[j] = 0
    return n


@compiled
def hold(K, group, rows, change):
    """Return the multipliers lam ``(B, r)`` of the mask ``rows`` for which K lam is ``change``.

    They are NaN where rows depend on each other.
    """
    lam, r = np.zeros(change.shape), change.shape[1]
    held, factor, x = np.empty(r, np.int64), np.empty((r, r)), np.empty(r)
    for i in range(len(lam)):
        n = 0
        for j in range(r):
            if rows[i, j]:
                if not _append(K[group[i]], j, held, n, factor, x):
                    lam[i, :] = np.nan
                    break
                n += 1
        for a in range(n):
            x[a] = change[i, held[a]]
        _forward(factor, x, n)
        _transposed(factor, x, n)
        for a in range(n):
            lam[i, held[a]] += x[a]
    return lam


@compiled
def _append(K, row, held, n, factor, x):
    """Append a row to the factor; return False if it depends on the held ones.

    x becomes L^-1 K[held, row] in either case.
    """
    pivot = K[row, row]
    for a in range(n):
        x[a] = K[row, held[a]]
    _forward(factor, x, n)
    for a in range(n):
        pivot -= x[a] * x[a]
    if pivot <= DEPENDENT:
        return False
    for a in range(n):
        factor[n, a] = x[a]
    factor[n, n] = math.sqrt(pivot)
    held[n] = row
    return True


@compiled
def _forward(factor, x, n):
    """Solve L x = x."""
    for a in range(n):
        total = x[a]
        for b in range(a):
            total -= factor[a, b] * x[b]
        x[a] = total / factor[a, a]


@compiled
def _transposed(factor, x, n):
    """Solve L'x = x."""
    for a in range(n - 1, -1, -1):
        total = x[a]
        for b in range(a + 1, n):
            total -= factor[b, a] * x[b]
        x[a] = total / factor[a, a]


@compiled
def _drop(K, at, lam, side, held, n, factor, x):
    """Drop the held row at a position; return the number of those left."""
    last, n = n, at
    for a in range(at + 1, last):
        row = held[a]
        if _append(K, row, held, n, factor, x):
            n += 1
        else:
            lam[row], side[row] = 0.0, 0
    return n


@compiled
def _longest(lam, side, w, low, high, held, x, n, noise, most):
    """Return the longest step along x, where it stops (-1 at its end), and the multiplier there."""
    stop, end = -1, 0.0
    for a in range(n):
        j = held[a]
        equal = low[j] == high[j]
        if x[a] > 0:
            to = w[j] if side[j] > 0 or equal else 0.0
        else:
            to = -w[j] if side[j] < 0 or equal else 0.0
        if abs(x[a]) > noise and abs(to) < np.inf and abs(most * x[a]) > abs(to - lam[j]):
            most = max(0.0, (to - lam[j]) / x[a])
            stop, end = a, to
    return most, stop, end


@compiled
def solve(K, free, low, high, w, lam, y, side, held, n, factor, x, cutoff):
    """Solve a QP from multipliers ``lam`` and the ``n`` rows ``held``, in place.

    The state ``side`` of a row is 1 or -1 if it is held at ``high`` or ``low``, 2 or -2 if its
    multiplier is w or -w there, and else 0; ``factor`` is that of the held rows.

    Returns:
        The number of held rows, the dual cost, and one more than the number of changes. The cost is
        inf if no y is feasible, and at least ``cutoff`` if that ended the search.
    """
    r, a, changes = len(free), 0, 1
    for j in range(r):
        side[j] = 0 if side[j] == 3 else side[j]
    while a < n:  # the levels may have changed
        j = held[a]
        side[j] = 1 if lam[j] > 0 else -1 if lam[j] < 0 else side[j]
        if not abs(high[j] if side[j] > 0 else low[j]) < np.inf:
            lam[j], side[j] = 0.0, 0
            n = _drop(K, a, lam, side, held, n, factor, x)
            continue
        a += 1
    _respond(K, free, lam, y)
    value, refined = -np.inf, 0
    for _ in range(MAX_STEPS):
        left, moved = 1.0, n > 0
        while n:  # the held multipliers to their optimum, letting go those that meet an end
            for a in range(n):
                j = held[a]
                x[a] = left * (y[j] - (high[j] if side[j] > 0 else low[j]))
            _forward(factor, x, n)
            _transposed(factor, x, n)
            step, stop, end = _longest(lam, side, w, low, high, held, x, n, 0.0, 1.0)
            for a in range(n):
                lam[held[a]] += step * x[a]
            if stop < 0:
                break
            changes += 1
            j = held[stop]
            lam[j], side[j] = end, (2 if end > 0 else -2 if end < 0 else 0)
            n = _drop(K, stop, lam, side, held, n, factor, x)
            left *= 1.0 - step
        if moved:
            _respond(K, free, lam, y)
        value, total = 0.0, 0.0
        for j in range(r):
            total += abs(lam[j])
            if lam[j] != 0:
                value += lam[j] * (0.5 * (free[j] + y[j]) - (high[j] if lam[j] > 0 else low[j]))
        if value >= cutoff:
            return n, value, changes
        row, gain, excess, to, settled = -1, 0.0, 0.0, 0, True
        for j in range(r):
            above, below, off = y[j] - high[j], y[j] - low[j], 0.0
            if side[j] == 0:
                off = above if above > 0 else below if below < 0 else 0.0
            elif side[j] == 2:
                off = min(above, 0.0)
            elif side[j] == -2:
                off = max(below, 0.0)
            elif abs(side[j]) == 1:
                off = above if side[j] > 0 else below
            near = min(abs(high[j]), abs(low[j]))
            if not abs(off) > TOLERANCE * (abs(free[j]) + near) + ROUNDING * total:
                continue
            if abs(side[j]) == 1:
                settled = False
                continue
            length = min(abs(off), w[j])
            if length * (abs(off) - length / 2) > gain:
                gain = length * (abs(off) - length / 2)
                row, excess = j, off
                to = (1 if off > 0 else -1) if side[j] == 0 else side[j] // 2
        if row < 0:
            if settled or refined == 3:
                return n, value, changes
            refined += 1
            continue
        sign, changes = 1.0 if excess > 0 else -1.0, changes + 1
        while True:
            if _append(K, row, held, n, factor, x):
                n += 1
                side[row] = to
                break
            _transposed(factor, x, n)
            for a in range(n):
                x[a] *= -sign
            equal = low[row] == high[row]
            if sign > 0:
                own = w[row] if to > 0 or equal else 0.0
            else:
                own = -w[row] if to < 0 or equal else 0.0
            most = abs(own - lam[row])
            step, stop, end = _longest(lam, side, w, low, high, held, x, n, NOISE, most)
            if step == np.inf:
                near = min(abs(high[row]), abs(low[row]))
                if abs(excess) > FEASIBLE * (abs(free[row]) + near):
                    return n, np.inf, changes
                side[row] = 3  # rounding of rows that depend on each other
                break
            for a in range(n):
                lam[held[a]] += step * x[a]
            lam[row] += sign * step
            if stop < 0:
                lam[row], side[row] = own, (2 if own > 0 else -2 if own < 0 else 0)
                break
            j = held[stop]
            lam[j], side[j] = end, (2 if end > 0 else -2 if end < 0 else 0)
            n = _drop(K, stop, lam, side, held, n, factor, x)
    return n, value, changes


@compiled
def _respond(K, free, lam, y):
    """y = free - K lam."""
    for j in range(len(y)):
        y[j] = free[j]
    for i in range(len(lam)):
        if lam[i] != 0:
            for j in range(len(y)):
                y[j] -= lam[i] * K[i, j]
