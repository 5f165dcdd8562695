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
TOLERANCE, ROUNDING = 1e-13, 4e-15
#: A row with a smaller pivot depends on the held ones; smaller entries are rounding.
DEPENDENT, NOISE = 1e-11, 1e-9
#: A plan replaces the best one if it costs less by this fraction.
GAIN = 1e-13
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
    K, unit, group, free, lower, upper, w, rows, values, rules, starts, runs, lows, highs, hint, cap
):
    """Return the best plans on levels of B QPs.

    Args:
        K: ``(M, r, r)``, with a unit diagonal.
        unit: the units of the rows, ``(M, r)``.
        group: the index of each QP's K, ``(B,)``.
        free, lower, upper, w: ``(B, r)``.
        rows: the row of each decision ``(m, S)``, -1 for one that is fixed.
        values: ascending levels, ``(m, L)``.
        rules: the fewest steps off and on, ``(m, 2)``.
        starts: the costs of starts, ``(m, S)``.
        runs: steps on, or minus steps off, before the plan; 0 if unknown, ``(B, m)``.
        lows, highs: the lowest and highest level of each decision by place, ``(B, m, S)``.
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
    first, last = np.empty((m, S), np.int64), np.empty((m, S), np.int64)
    pattern, ahead = np.empty((m, S), np.int64), np.empty((S + 1, rules.sum(1).max()))
    most = m * S * (values.shape[1] - 1) + 1
    at, cut, bounds = np.empty(most, np.int64), np.empty(most, np.int64), np.empty(most)
    above, untried = np.empty(most, np.bool_), np.empty(most, np.bool_)
    levels, near = np.empty((m, S, values.shape[1])), np.empty((m, S))
    for i in range(B):
        for a in range(m):
            for k in range(S):
                levels[a, k] = values[a] / (unit[group[i], rows[a, k]] if rows[a, k] >= 0 else 1.0)
                near[a, k] = ON_LEVEL * (levels[a, k, -1] - levels[a, k, 0])
        low[:], high[:], lam[:], side[:] = lower[i], upper[i], 0.0, 0
        n, depth, best, limit, hinted = 0, 0, np.inf, np.inf, hint[i, 0, 0] >= 0
        while True:
            nodes[i] += 1
            first[:], last[:] = lows[i], highs[i]
            if hinted:
                first[:], last[:] = np.maximum(first, hint[i]), np.minimum(last, hint[i])
            for e in range(depth):
                a, k = at[e] // S, at[e] % S
                if above[e]:
                    first[a, k] = max(first[a, k], cut[e] + 1)
                else:
                    last[a, k] = min(last[a, k], cut[e])
            cost, least, branch = _allowed(first, last, rules, starts, runs[i], ahead), np.inf, -1
            if cost < limit:
                for a in range(m):
                    for k in range(S):
                        if rows[a, k] >= 0:
                            low[rows[a, k]] = levels[a, k, first[a, k]]
                            high[rows[a, k]] = levels[a, k, last[a, k]]
                n, least = _solve(
                    K[group[i]], free[i], low, high, w[i],
                    lam, y, side, held, n, factor, x, limit - cost,
                )  # fmt: skip
            if least + cost < limit:
                branch = _undecided(first, last, levels, near, rows, y, pattern, False)
                if branch < 0:
                    of_starts = _allowed(pattern, pattern, rules, starts, runs[i], ahead)
                    if least + of_starts < limit:
                        best, costs[i] = least + of_starts, of_starts
                        limit = best - GAIN * abs(best)
                        lams[i], plans[i] = lam, pattern
                    if of_starts > cost:
                        branch = _undecided(first, last, levels, near, rows, y, pattern, True)
            if hinted:
                hinted = False
                continue
            if branch >= 0:
                a, k = branch // S, branch % S
                at_y, own = y[rows[a, k]], first[a, k]
                for e in range(own + 1, last[a, k]):
                    own = e if levels[a, k, e] <= at_y else own
                middle = (levels[a, k, own] + levels[a, k, own + 1]) / 2
                at[depth], cut[depth], untried[depth] = branch, own, True
                above[depth] = at_y > middle + near[a, k]  # rounding decides no tie
                bounds[depth] = least + cost
                depth += 1
            if nodes[i] >= cap:
                break
            if branch < 0:
                while depth and (not untried[depth - 1] or bounds[depth - 1] >= limit):
                    depth -= 1
                if not depth:
                    break
                above[depth - 1], untried[depth - 1] = not above[depth - 1], False
        for e in range(depth):
            if untried[e] or e == depth - 1:
                gaps[i] = max(gaps[i], best - bounds[e])
        found, open_ = best < np.inf, depth > 0
        outcomes[i] = (CAPPED if open_ else BEST) if found else (UNKNOWN if open_ else NONE)
    return plans, lams, costs, outcomes, nodes, gaps


@compiled
def _undecided(first, last, levels, near, rows, y, pattern, any_):
    """Return the first decision by stages, of those with several levels left, that is on none.

    With ``any_`` it is the first of those with several, and -1 if there is none. ``pattern`` gets
    the nearest levels. A level alone is held, to the tolerance of a row.
    """
    found = -1
    for k in range(pattern.shape[1]):
        for a in range(len(pattern)):
            best = first[a, k]
            if best < last[a, k]:
                at = y[rows[a, k]]
                for e in range(best + 1, last[a, k] + 1):
                    if abs(levels[a, k, e] - at) < abs(levels[a, k, best] - at):
                        best = e
                if found < 0 and (any_ or abs(levels[a, k, best] - at) > near[a, k]):
                    found = a * pattern.shape[1] + k
            pattern[a, k] = best
    return found


@compiled
def _next(state, on, rule, first, last):
    """Return the state after a step on or off, -1 if that is not left to it.

    The states are 1, .., rule[0] steps off, then 1, .., rule[1] steps on, the last of each or more.
    """
    off, n = rule[0], rule[0] + rule[1]
    if first > last or (last == 0 if on else first > 0):
        return -1
    if on:
        return min(state + 1, n - 1) if state >= off else off if state == off - 1 else -1
    return min(state + 1, off - 1) if state < off else 0 if state == n - 1 else -1


@compiled
def _allowed(firsts, lasts, rules, starts, runs, ahead):
    """Take from decisions what no sequence allows; return the least cost of starts, or inf.

    ``ahead`` ``(S + 1, n)`` is scratch: the least cost of a sequence to each state.
    """
    total, S = 0.0, firsts.shape[1]
    for a in range(len(firsts)):
        rule, first, last, run, cost = rules[a], firsts[a], lasts[a], runs[a], np.inf
        off, n = rule[0], rule[0] + rule[1]
        ahead[:, :] = np.inf
        if run <= 0:
            ahead[0, off - 1 if run == 0 else min(-run, off) - 1] = 0.0
        if run >= 0:
            ahead[0, n - 1 if run == 0 else off + min(run, rule[1]) - 1] = 0.0
        for k in range(S):
            for s in range(n):
                for on in range(2 if ahead[k, s] < np.inf else 0):
                    to = _next(s, on, rule, first[k], last[k])
                    if to >= 0:
                        by = starts[a, k] if on and s < off else 0.0
                        ahead[k + 1, to] = min(ahead[k + 1, to], ahead[k, s] + by)
        for s in range(n):
            cost = min(cost, ahead[S, s])
        if cost == np.inf:
            return np.inf
        for k in range(S - 1, -1, -1):  # inf from where the end is not reached
            off_ends, on_ends = False, False
            for s in range(n):
                ends = False
                for on in range(2 if ahead[k, s] < np.inf else 0):
                    to = _next(s, on, rule, first[k], last[k])
                    if to >= 0 and ahead[k + 1, to] < np.inf:
                        ends = True
                        off_ends, on_ends = off_ends or not on, on_ends or on == 1
                if not ends:
                    ahead[k, s] = np.inf
            first[k] = first[k] if off_ends else max(first[k], 1)
            last[k] = last[k] if on_ends else 0
        total += cost
    return total


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
    r, a = len(free), 0
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
