"""Branch and bound over actions on levels, as loops that Numba compiles for the CPU.

A *decision* is the level of one action in one stage; its row of G is held between the lowest and
the highest level that are left to it. A node of the tree is a QP that
`torch_qpmpc.qp.kernels.active_set` solves. Multipliers stay feasible whatever the levels, so each
node starts from the last one's, and the dual cost ends a node as soon as it exceeds the best
plan's. The search goes deep first, into the nearer levels: it soon has a plan, and its memory is
one branch.

Minimum times and start costs are no rows: an automaton of each action, on or off (its lowest
level) for so many steps, leaves each decision only levels that some sequence allows, and adds the
least cost of starts to the node's bound.
"""

import numpy as np

from torch_qpmpc.qp.kernels.active_set import solve
from torch_qpmpc.qp.kernels.linalg import compiled

#: A plan replaces the best one if it costs less by this fraction.
GAIN = 1e-13
#: A row is on a level within this fraction of the levels' distance.
ON_LEVEL = 1e-9


@compiled
def search(
    K, group, free, lower, upper, w, rows, values, rules, starts, runs, lows, highs, hint, cap
):
    """Return the best plans on levels of B QPs.

    Args:
        K: ``(M, r, r)``, with a unit diagonal.
        group: the index of each QP's K, ``(B,)``.
        free, lower, upper, w: ``(B, r)``.
        rows: the row of each decision ``(m, S)``, -1 for one that is fixed.
        values: ascending levels in the units of the rows, ``(M, m, S, L)``.
        rules: the fewest steps off and on, ``(m, 2)``.
        starts: the costs of starts, ``(m, S)``.
        runs: steps on, or minus steps off, before the plan; 0 if unknown, ``(B, m)``.
        lows, highs: the lowest and highest level of each decision by place, ``(B, m, S)``.
        hint: levels that may be good ``(B, m, S)``, -1 for none.
        cap: the most nodes.

    Returns:
        The places of the levels ``(B, m, S)``, -1 without a plan, multipliers ``(B, r)``, and
        ``(B,)`` costs of starts, whether it ended at the cap, numbers of nodes, and costs above
        the lower bound.
    """
    B, r = free.shape
    m, S = rows.shape
    plans, lams = np.full((B, m, S), -1), np.zeros((B, r))
    capped, nodes = np.zeros(B, np.bool_), np.zeros(B, np.int64)
    gaps, costs = np.zeros(B), np.zeros(B)
    low, high, lam, y, x = np.empty(r), np.empty(r), np.empty(r), np.empty(r), np.empty(r)
    side, held, factor = np.zeros(r, np.int64), np.empty(r + 1, np.int64), np.empty((r + 1, r + 1))
    first, last = np.empty((m, S), np.int64), np.empty((m, S), np.int64)
    pattern, ahead = np.empty((m, S), np.int64), np.empty((S + 1, rules.sum(1).max()))
    most = m * S * (values.shape[3] - 1) + 1
    at, cut, bounds = np.empty(most, np.int64), np.empty(most, np.int64), np.empty(most)
    above, untried = np.empty(most, np.bool_), np.empty(most, np.bool_)
    for i in range(B):
        levels = values[group[i]]
        near = ON_LEVEL * (levels[:, :, -1] - levels[:, :, 0])
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
                n, least, _ = solve(
                    K[group[i]], free[i], low, high, w[i],
                    lam, y, side, held, n, factor, x, limit - cost,
                )  # fmt: skip
            if least + cost < limit:
                branch, several = _undecided(first, last, levels, near, rows, y, pattern)
                if branch < 0:
                    of_starts = _allowed(pattern, pattern, rules, starts, runs[i], ahead)
                    if least + of_starts < limit:
                        best, costs[i] = least + of_starts, of_starts
                        limit = best - GAIN * abs(best)
                        lams[i], plans[i] = lam, pattern
                    if of_starts > cost:
                        branch = several
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
        capped[i] = depth > 0
    return plans, lams, costs, capped, nodes, gaps


@compiled
def _undecided(first, last, levels, near, rows, y, pattern):
    """Return the first decisions by stages that are on no level, and with several left, or -1.

    ``pattern`` gets the nearest levels. A level alone is held, to the tolerance of a row.
    """
    found, several = -1, -1
    for k in range(pattern.shape[1]):
        for a in range(len(pattern)):
            best = first[a, k]
            if best < last[a, k]:
                at, one = y[rows[a, k]], a * pattern.shape[1] + k
                several = one if several < 0 else several
                for e in range(best + 1, last[a, k] + 1):
                    if abs(levels[a, k, e] - at) < abs(levels[a, k, best] - at):
                        best = e
                if found < 0 and abs(levels[a, k, best] - at) > near[a, k]:
                    found = one
            pattern[a, k] = best
    return found, several


@compiled
def _allowed(firsts, lasts, rules, starts, runs, ahead):
    """Take from decisions what no sequence allows; return the least cost of starts, or inf.

    ``ahead`` ``(S + 1, n)`` is scratch: the least cost of a sequence to each state. The states are
    1, .., rule[0] steps off, then 1, .., rule[1] steps on. Each step leads to the next state, from
    the last one to the first; the last state off and the last one on also stay.
    """
    total, S = 0.0, firsts.shape[1]
    for a in range(len(firsts)):
        first, last, run, cost = firsts[a], lasts[a], runs[a], np.inf
        off, n = rules[a, 0], rules[a, 0] + rules[a, 1]
        ahead[0, :] = np.inf
        if run <= 0:
            ahead[0, off - 1 if run == 0 else min(-run, off) - 1] = 0.0
        if run >= 0:
            ahead[0, n - 1 if run == 0 else min(off + run, n) - 1] = 0.0
        for k in range(S):
            for s in range(n):
                least = ahead[k, s - 1 if s else n - 1] + (starts[a, k] if s == off else 0.0)
                if s == off - 1 or s == n - 1:
                    least = min(least, ahead[k, s])
                left = first[k] == 0 if s < off else last[k] >= max(first[k], 1)
                ahead[k + 1, s] = least if left else np.inf
        for s in range(n):
            cost = min(cost, ahead[S, s])
        if cost == np.inf:
            return np.inf
        for k in range(S - 1, -1, -1):  # inf from where the end is not reached
            may_off, may_on = False, False
            for s in range(n):
                reached = ahead[k + 1, s] < np.inf
                may_off, may_on = may_off or (reached and s < off), may_on or (reached and s >= off)
                stays = reached and (s == off - 1 or s == n - 1)
                if not stays and ahead[k + 1, s + 1 if s < n - 1 else 0] == np.inf:
                    ahead[k, s] = np.inf
            first[k] = first[k] if may_off else max(first[k], 1)
            last[k] = last[k] if may_on else 0
        total += cost
    return total
