"""Branch and bound over actions on levels, as loops that Numba compiles for the CPU.

A *decision* is the level of one action in one stage; its row of G is held between the lowest and
the highest level that are left to it. A node of the tree is a QP in the multipliers lam of the
rows, scaled to ``K_ii = 1``,

    y = free - K lam,   K = G H^-1 G',

which a dual active-set method solves as ``policy.c`` does. Multipliers stay feasible whatever the
levels, so each node starts from the last one's, and the dual cost, which never falls, ends a node
as soon as it exceeds the best plan's. The search goes deep first, into the nearer levels: it soon
has a plan, and its memory is one branch.

Minimum times and start costs are no rows: an automaton of each action, on or off (its lowest
level) for so many steps, leaves each decision only levels that some sequence allows, and adds the
least cost of starts to the node's bound.
"""

from __future__ import annotations

import math

import numpy as np

from torch_qpmpc.qp.kernels.linalg import compiled

#: Errors of a row that count as rounding, relative to its terms and to the sum of multipliers.
TOLERANCE, ROUNDING = 1e-10, 4e-15
#: A row with a smaller pivot depends on the held ones; smaller entries are rounding.
DEPENDENT, NOISE = 1e-11, 1e-9
#: A plan replaces the best one if it costs less by this fraction.
GAIN = 1e-9
#: A violation up to this fraction of a row's terms does not prove that there is no plan.
FEASIBLE = 1e-8
#: A row is on a level within this fraction of the levels' distance.
ON_LEVEL = 1e-9
#: The most changes of the active set in one node.
MAX_STEPS = 2000
#: Outcomes of a search: the best plan, the best of as many nodes as may be, no plan, none found.
BEST, CAPPED, NONE, UNKNOWN = 0, 1, 2, 3


@compiled
def search(
    K,
    unit,
    group,
    free,
    lower,
    upper,
    w,
    rows,
    values,
    counts,
    rules,
    starts,
    runs,
    fixed,
    hint,
    cap,
):
    """Return the best plans on levels of B QPs.

    Args:
        K: ``(M, r, r)``, with a unit diagonal.
        unit: the units of the rows, ``(M, r)``.
        group: the index of each QP's K, ``(B,)``.
        free, lower, upper, w: ``(B, r)``.
        rows: the row of each decision ``(m, S)``, -1 for one that is ``fixed``.
        values: ascending levels, ``(m, L)``.
        counts: the number of levels of each action, ``(m,)``.
        rules: the fewest steps off and on, ``(m, 2)``.
        starts: the costs of starts, ``(m, S)``.
        runs: steps on, or minus steps off, before the plan; 0 if unknown, ``(B, m)``.
        fixed: the levels of decisions without a row, ``(B, m)``, -1 for none.
        hint: levels that may be good ``(B, m, S)``, -1 for none.
        cap: the most nodes.

    Returns:
        The places of the levels ``(B, m, S)``, -1 without a plan, multipliers ``(B, r)``, and
        ``(B,)`` costs of starts, outcomes, numbers of nodes, and costs above the lower bound.
    """
    B, r = free.shape
    m, S = rows.shape
    plans, lams = np.full((B, m, S), -1), np.zeros((B, r))
    outcomes, nodes = np.zeros(B, np.int64), np.zeros(B, np.int64)
    gaps, costs = np.zeros(B), np.zeros(B)
    low, high, lam, y, x = np.empty(r), np.empty(r), np.empty(r), np.empty(r), np.empty(r)
    side, held, factor = np.zeros(r, np.int64), np.empty(r + 1, np.int64), np.empty((r + 1, r + 1))
    masks, pattern = np.empty((m, S), np.int64), np.empty((m, S), np.int64)
    n = rules.sum(1).max()
    ahead, ends = np.empty((S + 1, n)), np.empty((2, n), np.bool_)
    most = S * (counts - 1).sum() + 1
    at, kept, rest = np.empty(most, np.int64), np.empty(most, np.int64), np.empty(most, np.int64)
    bounds = np.empty(most)
    levels, base = np.empty((m, S, values.shape[1])), np.empty((m, S), np.int64)
    for i in range(B):
        for a in range(m):
            for k in range(S):
                j, base[a, k] = rows[a, k], 0
                if j < 0 and fixed[i, a] >= 0:
                    base[a, k] = 1 << fixed[i, a]
                for e in range(counts[a] if j >= 0 else 0):
                    levels[a, k, e] = values[a, e] / unit[group[i], j]
                    room = TOLERANCE * abs(levels[a, k, e])
                    if lower[i, j] - room <= levels[a, k, e] <= upper[i, j] + room:
                        base[a, k] |= 1 << e
        for j in range(r):
            low[j], high[j], lam[j], side[j] = lower[i, j], upper[i, j], 0.0, 0
        n, depth, best, limit, hinted = 0, 0, np.inf, np.inf, hint[i, 0, 0] >= 0
        while True:
            nodes[i] += 1
            for a in range(m):
                for k in range(S):
                    masks[a, k] = base[a, k]
                    if hinted:
                        masks[a, k] &= 1 << hint[i, a, k]
            for e in range(depth):
                masks[at[e] // S, at[e] % S] &= kept[e]
            cost, of_starts, least, branch = 0.0, 0.0, np.inf, -1
            for a in range(m):
                cost += _allowed(masks, a, rules, starts, runs[i, a], ahead, ends)
            if cost < limit:
                for a in range(m):
                    for k in range(S):
                        j = rows[a, k]
                        if j >= 0:
                            low[j], high[j] = _ends(masks[a, k], levels, a, k, counts[a])
                n, least = _solve(
                    K[group[i]],
                    free[i],
                    low,
                    high,
                    w[i],
                    lam,
                    y,
                    side,
                    held,
                    n,
                    factor,
                    x,
                    limit - cost,
                )
            if least + cost < limit:
                for k in range(S):
                    for a in range(m):
                        if branch < 0:
                            at_y = y[rows[a, k]] if rows[a, k] >= 0 else np.nan
                            pattern[a, k], on = _nearest(masks[a, k], levels, a, k, counts[a], at_y)
                            branch = -1 if on else a * S + k
                if branch < 0:
                    for a in range(m):
                        of_starts += _allowed(pattern, a, rules, starts, runs[i, a], ahead, ends)
                    if least + of_starts < limit:
                        best, costs[i] = least + of_starts, of_starts
                        limit = best - GAIN * abs(best)
                        lams[i] = lam
                        for a in range(m):
                            for k in range(S):
                                plans[i, a, k] = _place(pattern[a, k])
                    for k in range(S if of_starts > cost else 0):
                        for a in range(m):
                            if branch < 0 and masks[a, k] & (masks[a, k] - 1):
                                branch = a * S + k
            if hinted:
                hinted = False
                continue
            if branch >= 0:
                a, k = branch // S, branch % S
                first, second = _split(masks[a, k], levels, a, k, counts[a], y[rows[a, k]])
                at[depth], kept[depth], rest[depth] = branch, first, second
                bounds[depth] = least + cost
                depth += 1
            if nodes[i] >= cap:
                break
            if branch < 0:
                while depth and (rest[depth - 1] == 0 or bounds[depth - 1] >= limit):
                    depth -= 1
                if not depth:
                    break
                kept[depth - 1], rest[depth - 1] = rest[depth - 1], 0
        for e in range(depth):
            if rest[e] or e == depth - 1:
                gaps[i] = max(gaps[i], best - bounds[e])
        found, open_ = best < np.inf, depth > 0
        outcomes[i] = (CAPPED if open_ else BEST) if found else (UNKNOWN if open_ else NONE)
    return plans, lams, costs, outcomes, nodes, gaps


@compiled
def _place(mask):
    """Return the lowest level of a mask."""
    place = 0
    while not mask >> place & 1:
        place += 1
    return place


@compiled
def _ends(mask, levels, a, k, count):
    """Return the lowest and the highest level of a mask."""
    first, last = _place(mask), count - 1
    while not mask >> last & 1:
        last -= 1
    return levels[a, k, first], levels[a, k, last]


@compiled
def _nearest(mask, levels, a, k, count, y):
    """Return the level of a mask that is nearest to y, as a mask, and True if y is on it.

    A y of NaN is that of a fixed decision. A level alone is held, to the tolerance of a row.
    """
    best, off = 0, np.inf
    for e in range(count):
        if mask >> e & 1 and (best == 0 or abs(levels[a, k, e] - y) < off):
            best, off = 1 << e, abs(levels[a, k, e] - y)
    alone = mask & (mask - 1) == 0
    return best, alone or not off > ON_LEVEL * (levels[a, k, count - 1] - levels[a, k, 0])


@compiled
def _split(mask, levels, a, k, count, y):
    """Return the levels of a mask on y's side of the gap that it is in, and the others."""
    below = mask & -mask
    for e in range(count):
        if mask >> (e + 1) and levels[a, k, e] <= y:
            below |= mask & (1 << e)
    above = mask & ~below
    _, top = _ends(below, levels, a, k, count)
    bottom, _ = _ends(above, levels, a, k, count)
    return (below, above) if y - top <= bottom - y else (above, below)


@compiled
def _next(state, on, rule):
    """Return the state after a step on or off, -1 if a minimum time forbids it.

    The states are 1, .., rule[0] steps off, then 1, .., rule[1] steps on, the last of each or more.
    """
    off, last = rule[0], rule[0] + rule[1] - 1
    if on:
        return min(state + 1, last) if state >= off else off if state == off - 1 else -1
    return min(state + 1, off - 1) if state < off else 0 if state == last else -1


@compiled
def _allowed(masks, a, rules, starts, run, ahead, ends):
    """Take from the masks of an action what no sequence allows; return the least cost of starts.

    ``ahead`` ``(S + 1, n)`` and ``ends`` ``(2, n)`` are scratch.
    """
    S, off, n, rule = masks.shape[1], rules[a, 0], rules[a, 0] + rules[a, 1], rules[a]
    if n == 2 and not starts[a].any():
        return 0.0 if masks[a].all() else np.inf
    ahead[:, :] = np.inf  # the least cost of a sequence to each state
    if run <= 0:
        ahead[0, off - 1 if run == 0 else min(-run, off) - 1] = 0.0
    if run >= 0:
        ahead[0, n - 1 if run == 0 else off + min(run, rule[1]) - 1] = 0.0
    for k in range(S):
        for s in range(n):
            for on in range(2 if ahead[k, s] < np.inf else 0):
                to = _next(s, on, rule) if masks[a, k] & (~1 if on else 1) else -1
                if to >= 0:
                    cost = ahead[k, s] + (starts[a, k] if on and s < off else 0.0)
                    ahead[k + 1, to] = min(ahead[k + 1, to], cost)
    least = np.inf
    for s in range(n):
        least = min(least, ahead[S, s])
        ends[S & 1, s] = ahead[S, s] < np.inf  # the end may be reached from the state
    for k in range(S - 1 if least < np.inf else -1, -1, -1):
        may = 0
        for s in range(n):
            ends[k & 1, s] = False
            for on in range(2 if ahead[k, s] < np.inf else 0):
                to = _next(s, on, rule) if masks[a, k] & (~1 if on else 1) else -1
                if to >= 0 and ends[(k + 1) & 1, to]:
                    ends[k & 1, s] = True
                    may |= ~1 if on else 1
        masks[a, k] &= may
    return least


@compiled
def _append(K, row, held, n, factor, x):
    """Append a row to the factor; return False if it depends on the held ones.

    x becomes L^-1 K[held, row] in either case.
    """
    pivot = K[row, row]
    for a in range(n):
        total = K[row, held[a]]
        for b in range(a):
            total -= factor[a, b] * x[b]
        x[a] = total / factor[a, a]
        pivot -= x[a] * x[a]
    if pivot <= DEPENDENT:
        return False
    for a in range(n):
        factor[n, a] = x[a]
    factor[n, n] = math.sqrt(pivot)
    held[n] = row
    return True


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
def _solve(K, free, low, high, w, lam, y, side, held, n, factor, x, cutoff):
    """Solve a node from multipliers; return the number of held rows and the dual cost.

    The cost is inf without a plan, and at least ``cutoff`` if the node ends early.
    """
    r = len(free)
    a = 0
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
                total = left * (y[j] - (high[j] if side[j] > 0 else low[j]))
                for b in range(a):
                    total -= factor[a, b] * x[b]
                x[a] = total / factor[a, a]
            _transposed(factor, x, n)
            step, stop, end = _longest(lam, side, w, low, high, held, x, n, 0.0, 1.0)
            for a in range(n):
                lam[held[a]] += step * x[a]
            if stop < 0:
                break
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
            return n, value
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
                return n, value
            refined += 1
            continue
        sign = 1.0 if excess > 0 else -1.0
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
                if abs(excess) > FEASIBLE * (abs(free[row]) + near):
                    return n, np.inf
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
    return n, value


@compiled
def _respond(K, free, lam, y):
    """y = free - K lam."""
    for j in range(len(y)):
        y[j] = free[j]
    for i in range(len(lam)):
        if lam[i] != 0:
            for j in range(len(y)):
                y[j] -= lam[i] * K[i, j]
