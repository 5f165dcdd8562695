/* @HEADER@ */
#include "policy.h"

/* A QP in the multipliers of its rows, by a dual active-set method.

   Without multipliers the rows are y_free(p), the action is u_free(p) and the value is v_free(p).
   Multipliers lambda move them to

       y = y_free(p) - Q lambda,   u = u_free(p) - F lambda,

   and are optimal if each row is in one of these states:

       FREE        lambda = 0,       lower <= y <= upper
       HELD        0 < lambda < w,   y = upper        or  -w < lambda < 0,  y = lower
       SATURATED   lambda = w,       y >= upper       or  lambda = -w,      y <= lower

   A hard row has w = BIG. The rows are scaled to Q[i][i] = 1. One iteration holds the row that is
   furthest from its conditions, and moves the multipliers of the held rows towards their optimum;
   a row whose multiplier meets 0 or w on the way is let go. The dual objective never decreases.
   The multipliers' intervals do not depend on p: those of the last step are a feasible start. */

typedef policy_real real;

enum { FREE = 0, HELD = 1, SATURATED = 2, IGNORED = 3 }; /* of kind; negative at the lower bound */

/* @TABLES@ */

static real absolute(real x) { return x < 0 ? -x : x; }
static real larger(real a, real b) { return a > b ? a : b; }
static real smaller(real a, real b) { return a < b ? a : b; }
static int is_finite(real x) { return x - x == 0; }

/* Four sums at once: a compiler may not reorder one. */
static real dot(const real *a, const real *b, int n)
{
    real s0 = 0, s1 = 0, s2 = 0, s3 = 0;
    int i;
    for (i = 0; i + 3 < n; i += 4) {
        s0 += a[i] * b[i];
        s1 += a[i + 1] * b[i + 1];
        s2 += a[i + 2] * b[i + 2];
        s3 += a[i + 3] * b[i + 3];
    }
    for (; i < n; i++) s0 += a[i] * b[i];
    return (s0 + s1) + (s2 + s3);
}

static void add(real *a, real factor, const real *b, int n)
{
    int i;
    for (i = 0; i < n; i++) a[i] += factor * b[i];
}

static real entry(int i, int j) { return Q[i][j]; }

/* Update y to the multipliers that have changed since the last call. */
static void respond(policy_state *s)
{
    int i;
    for (i = 0; i < POLICY_ROWS; i++) {
        if (s->lambda[i] == s->before[i]) continue;
        add(s->y, s->before[i] - s->lambda[i], Q[i], POLICY_ROWS);
        s->before[i] = s->lambda[i];
    }
}

/* Compute y from all multipliers. */
static void respond_anew(policy_state *s)
{
    int i;
    for (i = 0; i < POLICY_ROWS; i++) {
        s->y[i] = s->y_free[i];
        s->before[i] = 0;
    }
    respond(s);
}

#if POLICY_LEVELS /* rows that decisions hold have the bounds of a node */
#define LOW(row) (s->low[row])
#define HIGH(row) (s->high[row])
#else
#define LOW(row) ((void)s, Y_LOWER[row])
#define HIGH(row) ((void)s, Y_UPPER[row])
#endif

/* Return the bound that a row is held at. */
static real bound(const policy_state *s, int row)
{
    return s->kind[row] > 0 ? HIGH(row) : LOW(row);
}

/* Return the size of the terms that a row compares with its bound on a side; the other one, which
   may be far away, has no part in it. */
static real terms_of(const policy_state *s, int row, real side)
{
    return s->size[row] + absolute(side > 0 ? HIGH(row) : LOW(row));
}

/* Return the ends of the interval of a row's multiplier; equal bounds hold it on both sides. */
static real lowest(const policy_state *s, int row, int side)
{
    return side > 0 && LOW(row) < HIGH(row) ? 0 : -W[row];
}

static real highest(const policy_state *s, int row, int side)
{
    return side < 0 && LOW(row) < HIGH(row) ? 0 : W[row];
}

/* The factor: column i of L, from below its unit diagonal. */
static real *column(policy_state *s, int i)
{
    return s->lower + (i * (POLICY_HELD - 1) - (i * (i - 1)) / 2);
}

/* Solve L x = x. */
static void solve_lower(policy_state *s, real *x, int n)
{
    int i;
    for (i = 0; i < n; i++) add(x + i + 1, -x[i], column(s, i), n - 1 - i);
}

/* Solve D L' x = x. */
static void solve_upper(policy_state *s, real *x, int n)
{
    int i;
    for (i = n - 1; i >= 0; i--)
        x[i] = x[i] / s->diagonal[i] - dot(column(s, i), x + i + 1, n - 1 - i);
}

/* Append a row to the factor; return 0 if it depends on the held rows.

   x becomes the solution of L x = Q[held][row] in either case. */
static int append(policy_state *s, int row, real *x)
{
    real pivot = 1;
    int i, n = s->n_held;
    for (i = 0; i < n; i++) x[i] = entry(row, s->held[i]);
    solve_lower(s, x, n);
    for (i = 0; i < n; i++) pivot -= x[i] * x[i] / s->diagonal[i];
    if (n == POLICY_HELD || pivot <= DEPENDENT) return 0;
    for (i = 0; i < n; i++) column(s, i)[n - 1 - i] = x[i] / s->diagonal[i];
    s->diagonal[n] = pivot;
    s->held[n] = row;
    s->n_held++;
    return 1;
}

/* Remove the held row at a position, by a rank-one update of the rows after it. */
static void drop(policy_state *s, int at)
{
    real *removed = s->work + POLICY_HELD_, weight = s->diagonal[at];
    int i, j, n = --s->n_held;
    for (i = 0; i < at; i++) { /* the columns before it lose an entry */
        real *l = column(s, i);
        for (j = at - i - 1; j < n - i - 1; j++) l[j] = l[j + 1];
    }
    for (j = at; j < n; j++) removed[j] = column(s, at)[j - at];
    for (i = at; i < n; i++) { /* those after it move */
        const real *from = column(s, i + 1);
        real *to = column(s, i);
        for (j = 0; j < n - 1 - i; j++) to[j] = from[j];
        s->diagonal[i] = s->diagonal[i + 1];
        s->held[i] = s->held[i + 1];
    }
    for (i = at; i < n; i++) { /* L D L' + weight removed removed' */
        real *l = column(s, i), *v = removed + i + 1, c = removed[i];
        real old = s->diagonal[i], beta;
        s->diagonal[i] = old + weight * c * c;
        beta = weight * c / s->diagonal[i];
        weight *= old / s->diagonal[i];
        for (j = 0; j < n - 1 - i; j++) {
            v[j] -= c * l[j];
            l[j] += beta * v[j];
        }
    }
}

/* Factorise the held rows anew. */
static void refactor(policy_state *s)
{
    int i, n = s->n_held;
    s->n_held = 0;
    for (i = 0; i < n; i++) {
        int row = s->held[i];
        if (!append(s, row, s->work)) {
            s->lambda[row] = 0;
            s->kind[row] = FREE;
        }
    }
}

/* Let go the held row at a position, whose multiplier has met an end of its interval. */
static void release(policy_state *s, int at, real end)
{
    int row = s->held[at];
    s->lambda[row] = end;
    s->kind[row] = (signed char)(end > 0 ? SATURATED : end < 0 ? -SATURATED : FREE);
    drop(s, at);
}

/* Return the longest step in [0, most] along x that keeps the held multipliers in their intervals,
   the position of the row that stops it in *at (-1 if none does) and its end in *end. Entries of x
   up to `noise` are rounding. */
static real longest(const policy_state *s, const real *x, real noise, real most, int *at, real *end)
{
    int i;
    *at = -1;
    for (i = 0; i < s->n_held; i++) {
        int row = s->held[i];
        real to = x[i] > 0 ? highest(s, row, s->kind[row]) : lowest(s, row, s->kind[row]);
        real room = to - s->lambda[row];
        if (absolute(x[i]) > noise && absolute(to) < BIG && absolute(most * x[i]) > absolute(room)) {
            most = larger(0, room / x[i]);
            *at = i;
            *end = to;
        }
    }
    return most;
}

static void move(policy_state *s, const real *x, real step)
{
    int i;
    for (i = 0; i < s->n_held; i++) s->lambda[s->held[i]] += step * x[i];
}

/* Move the held multipliers to their optimum, letting go those that meet an end on the way. */
static void settle(policy_state *s, int *iterations)
{
    real *x = s->work, left = 1, step, end = 0;
    int i, at;
    while (s->n_held > 0 && *iterations < MAX_ITERATIONS) {
        for (i = 0; i < s->n_held; i++) {
            int row = s->held[i];
            x[i] = left * (s->y[row] - bound(s, row));
        }
        solve_lower(s, x, s->n_held);
        solve_upper(s, x, s->n_held);
        step = longest(s, x, 0, 1, &at, &end);
        move(s, x, step);
        if (at < 0) return;
        release(s, at, end);
        left *= 1 - step;
        ++*iterations;
    }
}

/* Hold a row that violates its conditions by `excess`; return 0 if that proves infeasibility.

   If the row depends on the held ones, the multipliers move along the dependence, which changes
   no y and increases the dual objective, until one of them meets an end. */
static int hold(policy_state *s, int row, int side, real excess, int *iterations)
{
    real *x = s->work, sign = excess > 0 ? 1 : -1;
    while (!append(s, row, x)) {
        real most = BIG, end = 0, own, room, step;
        int i, at;
        solve_upper(s, x, s->n_held);
        for (i = 0; i < s->n_held; i++) x[i] *= -sign;
        own = sign > 0 ? highest(s, row, side) : lowest(s, row, side);
        room = absolute(own - s->lambda[row]);
        if (absolute(own) < BIG) most = room;
        step = longest(s, x, NOISE, most, &at, &end);
        if (step >= BIG) {
            s->kind[row] = IGNORED;
            return absolute(excess) <= FEASIBLE * terms_of(s, row, excess);
        }
        move(s, x, step);
        s->lambda[row] += sign * step;
        ++*iterations;
        if (at < 0) {
            s->lambda[row] = own;
            s->kind[row] = (signed char)(own > 0 ? SATURATED : own < 0 ? -SATURATED : FREE);
            return 1;
        }
        release(s, at, end);
    }
    s->kind[row] = (signed char)(side > 0 ? HELD : -HELD);
    return 1;
}

/* Return the row that is furthest from its conditions, its side and its excess; -1 if none is off.

   *settled is 0 if a held row is not at its bound. */
static int worst(const policy_state *s, real tolerance, int *side, real *excess, int *settled)
{
    real sum = 0, gain = 0;
    int i, found = -1;
    *settled = 1;
    for (i = 0; i < POLICY_ROWS; i++) sum += absolute(s->lambda[i]);
    for (i = 0; i < POLICY_ROWS; i++) {
        int kind = s->kind[i];
        real above = s->y[i] - HIGH(i), below = s->y[i] - LOW(i), off = 0, size, length;
        if (kind == FREE) off = above > 0 ? above : smaller(below, 0);
        else if (kind == SATURATED) off = smaller(above, 0);
        else if (kind == -SATURATED) off = larger(below, 0);
        else if (kind != IGNORED) off = kind > 0 ? above : below;
        size = absolute(off);
        if (size <= tolerance * terms_of(s, i, kind ? (real)kind : off) + ROUNDING * sum) continue;
        if (kind == HELD || kind == -HELD) {
            *settled = 0;
            continue;
        }
        length = smaller(size, W[i]);
        if (length * (size - length / 2) > gain) { /* of the dual objective, by this row alone */
            gain = length * (size - length / 2);
            found = i;
            *side = kind == FREE ? (off > 0 ? 1 : -1) : kind;
            *excess = off;
        }
    }
    return found;
}

#if POLICY_LEVELS
/* Return the dual objective, relative to the value without multipliers. */
static real dual(const policy_state *s)
{
    real sum = 0;
    int i;
    for (i = 0; i < POLICY_ROWS; i++)
        if (s->lambda[i] != 0) sum += s->lambda[i] * ((s->y_free[i] + s->y[i]) / 2 - bound(s, i));
    return sum;
}
#endif

/* Solve from the multipliers of the state, with rows exact to a tolerance relative to their size. */
static int solve(policy_state *s, real tolerance, int *iterations)
{
    int refinements = 0;
    respond_anew(s);
    for (;;) {
        real excess = 0;
        int row, side = 0, settled;
        settle(s, iterations);
        respond(s);
#if POLICY_LEVELS
        if ((s->cost = dual(s)) >= s->cutoff) return POLICY_SOLVED; /* a node that needs no more */
#endif
        row = worst(s, tolerance, &side, &excess, &settled);
        if (row < 0) { /* judge y without the rounding of its updates */
            respond_anew(s);
            row = worst(s, tolerance, &side, &excess, &settled);
        }
        if (row < 0 && (settled || refinements++ == REFINEMENTS)) return POLICY_SOLVED;
        if (*iterations >= MAX_ITERATIONS) return POLICY_LIMIT;
        if (row < 0) continue;
        ++*iterations;
        if (!hold(s, row, side, excess, iterations)) return POLICY_INFEASIBLE;
    }
}

/* Return the distance of y to its bounds. */
static real distance(real y, real lower, real upper)
{
    return y > upper ? y - upper : y < lower ? lower - y : 0;
}

/* Certify the multipliers: complete the value and the info; return 1 if they are optimal. */
static int certify(const policy_state *s, real v_free, policy_info *info)
{
    real quadratic = 0, charges = 0, sum = 0, terms;
    int i, holds = 1;
    info->gap = 0;
    for (i = 0; i < POLICY_ROWS; i++) sum += absolute(s->lambda[i]);
    for (i = 0; i < POLICY_ROWS; i++) {
        real y = s->y[i], lambda = s->lambda[i], off = distance(y, LOW(i), HIGH(i));
        real rounding = TIGHT * terms_of(s, i, y - HIGH(i)) + ROUNDING * sum; /* as in worst */
        real charge = W[i] < BIG && off > rounding ? W[i] * off : 0;
        if (W[i] >= BIG) {
            info->violation = larger(info->violation, off * UNIT[i]);
            if (!(off <= FEASIBLE * terms_of(s, i, y - HIGH(i)) + ROUNDING * sum)) holds = 0;
        }
        if (lambda != 0) {
            real at = lambda > 0 ? HIGH(i) : LOW(i);
            info->gap += absolute(charge + lambda * (at - y));
            quadratic += lambda * (s->y_free[i] - y) / 2;
        } else {
            info->gap += charge;
        }
        charges += charge;
    }
    info->value += v_free + quadratic + charges;
    /* rounding of the entries of Q alone moves the value by up to EPSILON sum^2 */
    terms = absolute(v_free) + absolute(quadratic) + charges;
    return holds && info->gap <= larger(GAP * terms, smaller(COARSE * terms, EPSILON * sum * sum));
}

/* Write u for the current multipliers, within the action bounds. */
static void act(policy_state *s, const real p[], real u[])
{
    int i;
    for (i = 0; i < POLICY_N_U; i++) {
        real x = U_OFFSET[i] + dot(U_P[i], p, POLICY_N_P) - dot(U_LAMBDA[i], s->lambda, POLICY_ROWS);
        if (is_finite(x)) s->u[i] = smaller(larger(x, U_LOWER[i]), U_UPPER[i]);
        u[i] = s->u[i];
    }
}

/* Compute what depends on p alone; return 0 if it is not finite. */
static int prepare(policy_state *s, const real p[], real *v_free)
{
    const real *row = V_PP;
    real sum = V_OFFSET, check = 0;
    int i, j;
    for (i = 0; i < POLICY_N_P; i++) {
        sum += p[i] * (V_P[i] + dot(row, p, i + 1));
        row += i + 1;
    }
    for (i = 0; i < POLICY_ROWS; i++) {
        real y = 0, size = SIZE[i];
        for (j = 0; j < POLICY_N_P; j++) {
            real term = Y_P[i][j] * p[j];
            y += term;
            size += absolute(term);
        }
        s->y_free[i] = y;
        s->size[i] = size;
        check += size;
        if (s->kind[i] == IGNORED) {
            s->kind[i] = FREE;
            s->lambda[i] = 0;
        }
    }
    *v_free = sum;
    return is_finite(check) && is_finite(sum);
}

/* Judge the rows that p alone determines; return 0 if a hard one is violated. */
static int judge(const real p[], policy_info *info)
{
    int i, j, holds = 1;
    for (i = 0; i < POLICY_KNOWN; i++) {
        real y = 0, size = KNOWN_SIZE[i], off;
        for (j = 0; j < POLICY_N_P; j++) {
            real term = KNOWN_P[i][j] * p[j];
            y += term;
            size += absolute(term);
        }
        off = distance(y, KNOWN_LOWER[i], KNOWN_UPPER[i]);
        if (KNOWN_W[i] < BIG) {
            info->value += KNOWN_W[i] * off;
        } else {
            info->violation = larger(info->violation, off);
            if (off > KNOWN_FEASIBLE * size) holds = 0;
        }
    }
    return holds;
}

/* Forget the active set, but not the last action. */
static void restart(policy_state *s)
{
    int i;
    s->n_held = 0;
    for (i = 0; i < POLICY_ROWS; i++) {
        s->lambda[i] = 0;
        s->kind[i] = FREE;
    }
}

/* @LEVELS@ */

void policy_reset(policy_state *s)
{
    int i;
    restart(s);
    for (i = 0; i < POLICY_N_U; i++) s->u[i] = smaller(larger(0, U_LOWER[i]), U_UPPER[i]);
#if POLICY_LEVELS
    for (s->hint[0] = -1, i = 0; i < POLICY_N_U; i++) s->runs[i] = 0;
#endif
}

int policy_step(policy_state *s, const real p[], real u[], policy_info *info)
{
    policy_info local;
    real v_free = 0, value = 0, violation, gap = 0;
    int i, code, feasible, finite = 1, fresh = 0, cold = 1, iterations = 0, found = POLICY_SOLVED;
    if (!info) info = &local;
    info->value = info->gap = info->violation = 0;
    info->iterations = 0;
    for (i = 0; i < POLICY_N_P; i++) finite = finite && is_finite(p[i]);
    if (!finite || !prepare(s, p, &v_free)) {
        restart(s);
        for (i = 0; i < POLICY_N_U; i++) u[i] = s->u[i];
        return POLICY_INVALID;
    }
    feasible = judge(p, info);
#if POLICY_LEVELS
    found = search(s, info, &value);
    if (found != POLICY_SOLVED && found != POLICY_NODE_LIMIT) {
        act(s, p, u);
        return feasible ? found : POLICY_INFEASIBLE;
    }
    info->value += value;
    gap = info->gap;
    for (i = 0; i < DECISIONS; i++) s->hint[i] = s->plan[i + ((i + 1) % DECIDED > 0)];
#endif
    value = info->value;
    violation = info->violation;
    for (i = 0; i < POLICY_ROWS; i++) cold = cold && s->lambda[i] == 0;
    for (;;) { /* from the last active set, with a new factor and tight rows, and from none */
        code = solve(s, fresh ? TIGHT : TOLERANCE, &iterations);
        info->value = value;
        info->violation = violation;
        if (!certify(s, v_free, info) && code == POLICY_SOLVED) {
            code = POLICY_LIMIT;
            if (!fresh) {
                refactor(s);
                fresh = 1;
                continue;
            }
        }
        if (code == POLICY_SOLVED || cold || iterations >= MAX_ITERATIONS) break;
        restart(s);
        cold = 1;
        fresh = 0;
    }
    info->gap += gap;
    info->iterations += iterations;
    act(s, p, u);
    return !feasible ? POLICY_INFEASIBLE : code ? code : found;
}

/* @EXAMPLES@ */

static int near(real x, real expected, real tolerance) { return absolute(x - expected) <= tolerance; }

/* With an operating system each thread has its own; without one a stack may be too small. */
#if defined(__GNUC__) && (defined(__unix__) || defined(__APPLE__))
#define OWN static __thread
#elif defined(_MSC_VER)
#define OWN static __declspec(thread)
#else
#define OWN static
#endif

int policy_selftest(void)
{
    OWN policy_state state;
    OWN real p[POLICY_N_P], u[POLICY_N_U];
    policy_info info;
    volatile real zero = 0;
    int round, i, j;
    for (round = 0; round < 2; round++) { /* cold, then from the last active set */
        policy_reset(&state);
        for (i = 0; i < EXAMPLES; i++) {
            int code, good;
            if (round == 0) policy_reset(&state);
            code = policy_step(&state, EXAMPLE_P[i], u, &info);
            good = code == EXAMPLE_CODE[i];
            if (round && code == POLICY_NODE_LIMIT) good = 1; /* the last plan takes a node */
            if (code == POLICY_LIMIT && info.iterations >= MAX_ITERATIONS) good = 1;
            for (j = 0; j < POLICY_N_U; j++) {
                good = good && u[j] >= U_LOWER[j] && u[j] <= U_UPPER[j];
                if (code == POLICY_SOLVED) good = good && near(u[j], EXAMPLE_U[i][j], NEAR_U[j]);
            }
            if (code == POLICY_SOLVED) good = good && near(info.value, EXAMPLE_VALUE[i], NEAR_VALUE[i]);
            if (!good) return i + 1;
        }
    }
    for (j = 0; j < POLICY_N_P; j++) p[j] = 0;
    for (round = 0; round < 2; round++) { /* a NaN and an infinity */
        p[POLICY_N_P - 1] = (round ? 1 : zero) / zero;
        if (policy_step(&state, p, u, 0) != POLICY_INVALID) return EXAMPLES + 1;
        for (j = 0; j < POLICY_N_U; j++)
            if (!(u[j] >= U_LOWER[j] && u[j] <= U_UPPER[j])) return EXAMPLES + 1;
    }
    return 0;
}
