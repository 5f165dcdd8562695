/* Branch and bound over actions on levels, as torch_qpmpc/qp/kernels/levels.py explains it. A decision
   is the level of one action in one stage, in a node one of those from s->first to s->last. */

enum { DECIDED = POLICY_DECIDED, DECISIONS = POLICY_LEVELS * DECIDED };

/* Take from decisions what no sequence of levels allows; return the least cost of starts, or BIG.
   The states of an action are 1, .., least[0] steps off, then 1, .., least[1] steps on. Each step
   leads to the next state, from the last one to the first; the last ones off and on also stay. */
static real allowed(policy_state *s, signed char *first, signed char *last)
{
    real total = 0;
    int a, i, k;
    for (a = 0; a < POLICY_LEVELS; a++, first += DECIDED, last += DECIDED) {
        const int off = LEAST_STEPS[2 * a], n = off + LEAST_STEPS[2 * a + 1];
        int run = s->runs[LEVEL_ACTION[a]];
        real cost = BIG;
        for (i = 0; i < n; i++) s->ahead[0][i] = BIG;
        if (run <= 0) s->ahead[0][run == 0 || -run > off ? off - 1 : -run - 1] = 0;
        if (run >= 0) s->ahead[0][run == 0 || off + run > n ? n - 1 : off + run - 1] = 0;
        for (k = 0; k < DECIDED; k++)
            for (i = 0; i < n; i++) {
                real least = s->ahead[k][i ? i - 1 : n - 1] + (i == off ? START_COST[a][k] : 0);
                int left = i < off ? first[k] == 0 : last[k] >= 1 && last[k] >= first[k];
                if (i == off - 1 || i == n - 1) least = smaller(least, s->ahead[k][i]);
                s->ahead[k + 1][i] = left ? smaller(least, BIG) : BIG;
            }
        for (i = 0; i < n; i++) cost = smaller(cost, s->ahead[DECIDED][i]);
        if (cost >= BIG) return BIG;
        for (k = DECIDED - 1; k >= 0; k--) { /* from where the end is not reached costs BIG */
            real *now = s->ahead[k], reach[2] = {BIG, BIG};
            const real *then = s->ahead[k + 1];
            for (i = 0; i < n; i++) {
                int stays = (i == off - 1 || i == n - 1) && then[i] < BIG;
                reach[i >= off] = smaller(reach[i >= off], then[i]);
                if (then[i + 1 < n ? i + 1 : 0] >= BIG && !stays) now[i] = BIG;
            }
            if (reach[0] >= BIG && first[k] == 0) first[k] = 1;
            if (reach[1] >= BIG) last[k] = 0;
        }
        total += cost;
    }
    return total;
}

/* Hold the rows between levels, and give those that are held the side of their multipliers. */
static void hold_between(policy_state *s, const signed char *first, const signed char *last, real most)
{
    int i;
    s->cutoff = most; /* of the cost */
    for (i = 0; i < DECISIONS; i++) {
        s->low[LEVEL_ROW[i]] = LEVEL[i][first[i]];
        s->high[LEVEL_ROW[i]] = LEVEL[i][last[i]];
    }
    for (i = 0; i < POLICY_ROWS; i++) {
        if (s->kind[i] == IGNORED) s->kind[i] = FREE;
        if (s->kind[i] == -HELD && s->lambda[i] > 0) s->kind[i] = HELD;
        if (s->kind[i] == HELD && s->lambda[i] < 0) s->kind[i] = -HELD;
    }
}

/* Return the first decision by stages, of those with several levels left, that is on none of them
   (that is left, if `any`), -1 if there is none. The nearest levels are the pattern. */
static int undecided(policy_state *s, int any)
{
    int i, e, k, a, found = -1;
    for (k = 0; k < DECIDED; k++)
        for (a = 0; a < POLICY_LEVELS; a++) {
            real y = s->y[LEVEL_ROW[i = a * DECIDED + k]];
            int at = s->first[i];
            for (e = at + 1; e <= s->last[i]; e++)
                if (absolute(LEVEL[i][e] - y) < absolute(LEVEL[i][at] - y)) at = e;
            s->pattern[i] = (signed char)at;
            if (s->first[i] == s->last[i] || (!any && absolute(LEVEL[i][at] - y) <= ON_LEVEL[i])) continue;
            if (found < 0) found = i;
        }
    return found;
}

/* Find the best plan on levels, which the state holds afterwards; return a code. *starts is the cost
   of its starts, and info->gap how far it may be from the best one. */
static int search(policy_state *s, policy_info *info, real *starts)
{
    real best = BIG, limit = BIG;
    int depth = 0, nodes = 0, i, e;
    restart(s); /* multipliers for another p may leave rounding that cuts off nodes */
    for (i = 0; i < POLICY_ROWS; i++) s->low[i] = Y_LOWER[i], s->high[i] = Y_UPPER[i];
    for (;;) {
        real cost, least = BIG, own;
        int branch = -1, iterations = 0, hinted = nodes++ == 0 && s->hint[0] >= 0;
        for (i = 0; i < DECISIONS; i++) {
            s->first[i] = hinted && s->hint[i] > FIRST[i] ? s->hint[i] : FIRST[i];
            s->last[i] = hinted && s->hint[i] < LAST[i] ? s->hint[i] : LAST[i];
        }
        for (i = 0; i < depth; i++) {
            e = s->at[i];
            if (s->above[i] && s->first[e] <= s->cut[i]) s->first[e] = (signed char)(s->cut[i] + 1);
            if (!s->above[i] && s->last[e] > s->cut[i]) s->last[e] = s->cut[i];
        }
        cost = allowed(s, s->first, s->last);
        if (cost < limit) {
            hold_between(s, s->first, s->last, limit - cost);
            if (solve(s, TIGHT, &iterations) != POLICY_INFEASIBLE) least = s->cost;
            info->iterations += iterations;
        }
        if (least + cost < limit && (branch = undecided(s, 0)) < 0) {
            own = allowed(s, s->pattern, s->pattern);
            if (least + own < limit) {
                best = least + (*starts = own);
                limit = best - GAIN * absolute(best);
                for (i = 0; i < DECISIONS; i++) s->plan[i] = s->pattern[i];
                for (i = 0; i < POLICY_ROWS; i++) s->best[i] = s->lambda[i];
            }
            if (own > cost) branch = undecided(s, 1);
        }
        if (hinted) continue; /* the last plan is one try */
        if (branch >= 0) { /* into the side of y */
            real y = s->y[LEVEL_ROW[branch]];
            int cut = s->first[branch];
            for (e = cut + 1; e < s->last[branch]; e++)
                if (LEVEL[branch][e] <= y) cut = e;
            s->at[depth] = branch;
            s->cut[depth] = (signed char)cut;
            y -= (LEVEL[branch][cut] + LEVEL[branch][cut + 1]) / 2;
            s->above[depth] = y > ON_LEVEL[branch]; /* rounding decides no tie */
            s->open[depth] = 1;
            s->bounds[depth++] = least + cost;
        }
        if (nodes >= POLICY_NODES) break;
        if (branch < 0) {
            while (depth && (!s->open[depth - 1] || s->bounds[depth - 1] >= limit)) depth--;
            if (!depth) break;
            s->above[depth - 1] = !s->above[depth - 1];
            s->open[depth - 1] = 0;
        }
    }
    if (!(best < BIG)) return depth ? POLICY_LIMIT : POLICY_INFEASIBLE;
    for (i = 0; i < depth; i++)
        if (s->open[i] || i == depth - 1) info->gap = larger(info->gap, best - s->bounds[i]);
    s->n_held = 0;
    for (i = 0; i < POLICY_ROWS; i++) {
        real x = s->lambda[i] = s->best[i];
        int kind = absolute(x) < W[i] ? HELD : SATURATED;
        s->kind[i] = (signed char)(x > 0 ? kind : x < 0 ? -kind : FREE);
        if (x != 0 && kind == HELD) s->held[s->n_held++] = i;
    }
    refactor(s);
    hold_between(s, s->plan, s->plan, BIG);
    return depth ? POLICY_NODE_LIMIT : POLICY_SOLVED;
}
