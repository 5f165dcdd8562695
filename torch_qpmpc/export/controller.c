/* @HEADER@ */
#include "policy.h"

/* An observer of e = [x; w], the state and constant disturbances; a QP for the steady state that is
   nearest to the set-point, solved again if that leaves inputs free; and a QP for the plan to it.

       e  is corrected by L_k (y - H e), and predicted by F e + G u + E d + OFFSET
       [x_s; u_s; y_s] = [X_V; U_V; Y_V] v + [X_L; U_L; Y_L] [w; known; 1], v by the target's QPs
       u = u_s + the plan's first input, within the bounds */

typedef policy_real real;

enum { N_X = POLICY_N_X, N_W = POLICY_N_W, N_E = POLICY_N_E, N_U = POLICY_N_U };
enum { N_Y = POLICY_N_Y, N_D = POLICY_N_D, N_V = POLICY_TARGET_N_U, LOADS = N_W + N_D + 1 };
enum { N_F = POLICY_N_F, N_A = N_V - N_F, STAGES = POLICY_STAGES, SET_POINTS = POLICY_SET_POINTS };

enum { LAST = POLICY_GAINS - 1 }; /* the steady gain */
enum { UNKNOWN = -2, STARTS = -1 }; /* of steps: before known signals, and before estimates */

/* @TABLES@ */

/* Add M x to y, where M has so many rows and columns. */
static void add(real *y, const real *M, int rows, int columns, const real *x)
{
    int i, j;
    for (i = 0; i < rows; i++)
        for (j = 0; j < columns; j++) y[i] += M[i * columns + j] * x[j];
}

static void copy(real *to, const real *from, int n)
{
    int i;
    for (i = 0; i < n; i++) to[i] = from[i];
}

/* Return 1 if x is not above `most` in size; a NaN is. */
static int is_sane(real x, real most) { return x <= most && -x <= most; }

static int are_sane(const real *x, const real most[], int rows, int columns)
{
    int i;
    for (i = 0; i < rows * columns; i++)
        if (!is_sane(x[i], most[i % columns])) return 0;
    return 1;
}

/* Return x within the bounds of input i: numbers before known signals, in the last valid row. */
static real within(const policy_state *s, real x, int i)
{
    int seen = s->steps > UNKNOWN;
    real lower = seen && LOWER_OF[i] >= 0 ? s->known[LOWER_OF[i]] : U_LOWER[i];
    real upper = seen && UPPER_OF[i] >= 0 ? s->known[UPPER_OF[i]] : U_UPPER[i];
    if (x < lower) x = lower;
    if (x > upper) x = upper;
    if (x < U_LOWER[i]) return U_LOWER[i];
    return x > U_UPPER[i] ? U_UPPER[i] : x;
}

#if POLICY_LEVELS
/* Return the level of input i within its bounds that is nearest to x; without one x. */
static real on_level(const policy_state *s, real x, int i)
{
    real level = BIG;
    int k;
    for (k = 0; k < POLICY_LEVELS; k++) {
        real next = INPUT_LEVELS[i][k];
        int inside = next < BIG && within(s, next, i) == next;
        if (inside && (level >= BIG || x - level > next - x)) level = next;
    }
    return level < BIG ? level : x;
}

/* Count the steps on and off, of which u is the last one. */
static void count(policy_state *s, const real u[])
{
    int i, *runs = s->plan.runs;
    for (i = 0; i < N_U; i++) {
        if (u[i] > SWITCH[i]) runs[i] = runs[i] < 0 ? 1 : runs[i] + (runs[i] < POLICY_RUNS);
        else runs[i] = runs[i] > 0 ? -1 : runs[i] - (runs[i] > -POLICY_RUNS);
    }
}
#endif

/* Predict the estimates of the next step with the input u. */
static void predict(policy_state *s, const real u[])
{
    real next[N_E];
    copy(next, OFFSET, N_E);
    add(next, &F[0][0], N_E, N_E, s->e);
    add(next, &G[0][0], N_E, N_U, u);
    add(next, &E[0][0], N_E, N_D, s->known);
    copy(s->e, next, N_E);
}

#if POLICY_CARRIES
/* Set the gain for the outputs that are seen, and the covariance to the next step's; the outputs
   seen have V = H P H' + S as covariance of their errors, which is factored as V D V'. */
static void advance(policy_state *s, const int seen[], real K[N_E][N_Y])
{
    real PH[N_E][N_Y], V[N_Y][N_Y], X[N_E][N_E];
    int at[N_Y], m = 0, i, j, k, a, b;
    for (i = 0; i < N_Y; i++)
        if (seen[i]) at[m++] = i;
    for (i = 0; i < N_E; i++) {
        for (j = 0; j < N_Y; j++) K[i][j] = 0;
        for (a = 0; a < m; a++) {
            PH[i][a] = LS[i][at[a]];
            for (j = 0; j < N_E; j++) PH[i][a] += s->P[i][j] * H[at[a]][j];
        }
    }
    for (a = 0; a < m; a++)
        for (b = 0; b <= a; b++) {
            V[a][b] = S[at[a]][at[b]];
            for (j = 0; j < N_E; j++) V[a][b] += H[at[a]][j] * (PH[j][b] - LS[j][at[b]]);
            for (k = 0; k < b; k++) V[a][b] -= V[a][k] * V[b][k] * V[k][k];
            if (b < a) V[a][b] /= V[b][b];
        }
    for (i = 0; i < N_E; i++) {
        for (a = 0; a < m; a++) {
            real x = PH[i][a];
            for (k = 0; k < a; k++) x -= V[a][k] * K[i][at[k]];
            K[i][at[a]] = x;
        }
        for (a = m - 1; a >= 0; a--) {
            K[i][at[a]] /= V[a][a];
            for (k = a + 1; k < m; k++) K[i][at[a]] -= V[k][a] * K[i][at[k]];
        }
    }
    for (i = 0; i < N_E; i++)
        for (j = 0; j < N_E; j++) {
            real x = s->P[i][j] + LSL[i][j];
            for (a = 0; a < m; a++) x -= (PH[i][a] * K[j][at[a]] + PH[j][a] * K[i][at[a]]) / 2;
            X[i][j] = x;
        }
    for (i = 0; i < N_E; i++) {
        real row[N_E] = {0};
        for (k = 0; k < N_E; k++)
            for (j = 0; j < N_E; j++) row[j] += F[i][k] * X[k][j];
        for (j = 0; j <= i; j++) {
            s->P[i][j] = 0;
            for (k = 0; k < N_E; k++) s->P[i][j] += row[k] * F[j][k];
        }
    }
    for (i = 0; i < N_E; i++)
        for (j = i + 1; j < N_E; j++) s->P[i][j] = s->P[j][i];
}

/* Correct the estimates by the outputs that are seen, whose covariance is carried. */
static void correct(policy_state *s, const int seen[], int all, const real error[])
{
    real K[N_E][N_Y];
    int i, j, k, whole[N_Y];
    if (!s->carried) {
        for (i = 0; i < N_E; i++)
            for (j = 0; j < N_E; j++) s->P[i][j] = s->steps < LAST ? FIRST[i][j] : 0;
        for (i = 0; i < N_Y; i++) whole[i] = 1;
        for (k = 0; k < s->steps && s->steps < LAST; k++) advance(s, whole, K);
        s->steps = LAST;
    }
    advance(s, seen, K);
    add(s->e, &K[0][0], N_E, N_Y, error);
    s->carried = !all;
    for (i = 0; i < N_E; i++) {
        real off = 0, size = 0;
        for (j = 0; j < N_Y; j++) {
            real gain = GAINS[LAST][i * N_Y + j], by = K[i][j] - gain;
            off = by * OF_S[j] > off ? by * OF_S[j] : -by * OF_S[j] > off ? -by * OF_S[j] : off;
            size = gain * OF_S[j] > size ? gain * OF_S[j] : -gain * OF_S[j] > size ? -gain * OF_S[j] : size;
        }
        if (!(off <= STEADY[0] * size)) s->carried = 1;
    }
}
#endif

/* Set the estimates to where the plant rests with outputs y and the last input. */
static void rest(policy_state *s, const real y[])
{
    real known[N_E + N_Y];
    int i;
    for (i = 0; i < N_E; i++) s->e[i] = 0;
    predict(s, s->u);
    for (i = 0; i < N_E; i++) known[i] = -s->e[i];
    copy(known + N_E, y, N_Y);
    for (i = 0; i < N_E; i++) s->e[i] = 0;
    add(s->e, &REST[0][0], N_E, N_E + N_Y, known);
}

/* Correct the estimates by those outputs that are not missing; return a code. Rows of known signals
   that are not sane are not taken, the last ones hold. */
static int see(policy_state *s, const real y[], const real known[], int stages)
{
    real error[N_Y];
    int seen[N_Y];
    int i, j, missing = 0, valid = are_sane(known, MOST_KNOWN, stages, N_D);
    if (valid) {
        copy(s->known, known, N_D);
        if (s->steps < 0) s->steps = STARTS;
    }
    if (s->steps < 0) {
        if (!valid || !y || !are_sane(y, MOST_Y, 1, N_Y)) return POLICY_INVALID;
        if (LAST) copy(s->e, START, N_E);
        else rest(s, y);
        s->steps = 0;
    }
    for (i = 0; i < N_Y; i++) {
        error[i] = 0;
        seen[i] = y && is_sane(y[i], MOST_Y[i]);
        if (!seen[i]) {
            missing = 1;
            continue;
        }
        error[i] = y[i];
        for (j = 0; j < N_E; j++) error[i] -= H[i][j] * s->e[j];
    }
#if POLICY_CARRIES
    if (missing || s->carried) correct(s, seen, !missing, error);
    else
#endif
    add(s->e, GAINS[s->steps], N_E, N_Y, error);
    if (s->steps < LAST) s->steps++;
    return !valid ? POLICY_INVALID : missing ? POLICY_MISSING : POLICY_SOLVED;
}

/* Take set-points, but for outputs without a weight, whose stay zero; return 1 if all are sane. */
static int take(policy_state *s, const real r[])
{
    int i, k;
    for (k = 0; k < SET_POINTS * N_Y; k += N_Y)
        for (i = 0; i < POLICY_WEIGHTED; i++)
            if (!is_sane(r[k + OF_R[i]], MOST_Y[OF_R[i]])) return 0;
    for (k = 0; k < SET_POINTS * N_Y; k += N_Y)
        for (i = 0; i < POLICY_WEIGHTED; i++) s->r[k + OF_R[i]] = r[k + OF_R[i]];
    return 1;
}

#if POLICY_ENDS
/* Set the set-points of the terminal cost: r, but for what the outputs' bounds hold off. */
static void set_end(policy_state *s, const real r[])
{
    real off[N_Y], own[N_Y] = {0}, pull[N_Y], size = 0, share = 0;
    int i;
    for (i = 0; i < N_Y; i++) off[i] = s->y_s[i] - r[i];
    add(own, &MOVED[0][0], N_Y, N_Y, off);
    copy(pull, own, N_Y);
    add(pull, &SHIFTS[0][0], N_Y, POLICY_TARGET_ROWS, s->target.lambda);
    for (i = 0; i < N_Y; i++) {
        real weighed = 0;
        add(&weighed, Q[i], 1, N_Y, pull);
        size += weighed * pull[i];
        share += weighed * own[i];
    }
    if (share > size) share = size;
    share = share > 0 ? share / size : 0;
    for (i = 0; i < N_Y; i++) s->end[i] = r[i] + own[i] - share * pull[i];
}
#endif

/* Set the target for the signals of a stage; return the code of its QPs. */
static int aim(policy_state *s, const real r[], const real known[])
{
    real loads[LOADS], t[POLICY_TARGET_N_P], v[N_V], move[N_V];
    int i, round, stays = 0, follows = 0, code = POLICY_SOLVED;
    copy(loads, s->e + N_X, N_W);
    for (i = 0; i < N_D; i++) loads[N_W + i] = known[i] - NOMINAL[i];
    loads[LOADS - 1] = 1;
    for (i = 0; i < N_F; i++) t[i] = 0;
    copy(t + N_F, r, N_Y);
    copy(t + N_F + N_Y, loads, LOADS);
    for (round = 0; round < POLICY_ROUNDS && !stays && code == POLICY_SOLVED; round++) {
        real share = 0, size = 0;
        code = policy_target_step(&s->target, t, v, 0);
        for (i = 0, stays = 1; i < N_F; i++) {
            real f = v[N_A + i], by = f - t[i], near = STAYS[0] * (1 + (f < 0 ? -f : f));
            if (!(by <= near && -by <= near)) stays = 0;
            if (follows) share += by * move[i];
            if (follows) size += move[i] * move[i];
            move[i] = by;
        }
        share = share > 0 ? share / size : 0;
        if (share > SHRINKS[0]) share = SHRINKS[0];
        for (i = 0; i < N_F; i++) t[i] = v[N_A + i] + move[i] * share / (1 - share);
        follows = !follows;
    }
    for (i = 0; i < N_X; i++) s->x_s[i] = 0;
    for (i = 0; i < N_U; i++) s->u_s[i] = 0;
    for (i = 0; i < N_Y; i++) s->y_s[i] = 0;
    add(s->x_s, &X_V[0][0], N_X, N_V, v);
    add(s->u_s, &U_V[0][0], N_U, N_V, v);
    add(s->y_s, &Y_V[0][0], N_Y, N_V, v);
    add(s->x_s, &X_L[0][0], N_X, LOADS, loads);
    add(s->u_s, &U_L[0][0], N_U, LOADS, loads);
    add(s->y_s, &Y_L[0][0], N_Y, LOADS, loads);
#if POLICY_ENDS
    set_end(s, r);
#endif
    return code;
}

/* Replace the last input by the plan's; return a code. */
static int plan(policy_state *s, const real known[])
{
    /* a stage of p has set-points and inputs relative to the last target if it has any, then known
       signals */
    enum { N_R = POLICY_N_R, N_UR = POLICY_N_UR, N_K = N_R + N_UR + N_D, LAST_ROW = STAGES - 1 };
    const real *r = s->r, *last = known + LAST_ROW * N_D;
    real move[N_U], *p = s->p;
    int i, k, code;
    for (k = N_R || N_UR ? 0 : LAST_ROW; k < STAGES; k++) {
        if (SET_POINTS > 1) r = s->r + k * N_Y;
        if ((code = aim(s, r, known + k * N_D)) != POLICY_SOLVED) return code;
        for (i = 0; i < N_R; i++) p[k * N_K + i] = r[OF_R[i]];
        copy(p + k * N_K + N_R, s->u_s, N_UR);
    }
    for (k = 0; k < STAGES; k++) {
        for (i = 0; i < N_R; i++) *p++ -= s->y_s[OF_R[i]];
        for (i = 0; i < N_UR; i++) *p++ -= s->u_s[i];
        for (i = 0; i < N_D; i++) *p++ = known[k * N_D + i] - NOMINAL[i] - ACTS[i] * last[i];
    }
    for (i = 0; i < N_X; i++) *p++ = s->e[i] - s->x_s[i];
    for (i = 0; i < POLICY_MOVES; i++) *p++ = s->u[i] - s->u_s[i];
    for (i = 0; i < POLICY_OFF; i++) *p++ = s->y_s[OF_R[i]] - r[OF_R[i]];
    for (i = 0; i < POLICY_ENDS; i++) *p++ = s->y_s[OF_R[i]] - s->end[OF_R[i]];
    for (i = 0; i < POLICY_BOUNDED_Y; i++) *p++ = s->y_s[OF_Y[i]];
    for (i = 0; i < POLICY_BOUNDED_U; i++) *p++ = s->u_s[OF_U[i]];
    *p = 1;
    code = policy_plan_step(&s->plan, s->p, move, 0);
    if (code != POLICY_SOLVED && code != POLICY_NODE_LIMIT) return code;
    for (i = 0; i < N_U; i++) {
        real by = (move[i] = within(s, s->u_s[i] + move[i], i)) - s->u[i];
        if (!(by >= MOVE_LOWER[i] && by <= MOVE_UPPER[i])) return POLICY_LIMIT;
    }
    copy(s->u, move, N_U);
    return code;
}

void policy_reset(policy_state *s, const real y[], const real u[], const real known[])
{
    int i;
    policy_plan_reset(&s->plan);
    policy_target_reset(&s->target);
#if POLICY_CARRIES
    s->carried = 0;
#endif
    for (i = 0; i < N_E; i++) s->e[i] = 0;
    for (i = 0; i < POLICY_N_D_; i++) s->known[i] = 0;
    s->steps = UNKNOWN;
    for (i = 0; i < N_U; i++) s->u[i] = within(s, u && is_sane(u[i], MOST_U[i]) ? u[i] : 0, i);
#if POLICY_LEVELS
    for (i = 0; i < N_U; i++) s->plan.runs[i] = s->u[i] > SWITCH[i] ? POLICY_RUNS : -POLICY_RUNS;
#endif
    for (i = 0; i < SET_POINTS * N_Y; i++) s->r[i] = 0;
    if (y && are_sane(y, MOST_Y, 1, N_Y) && (!N_D || (known && are_sane(known, MOST_KNOWN, 1, N_D)))) {
        copy(s->known, known, N_D);
        rest(s, y);
        s->steps = LAST;
    }
}

int policy_observe(policy_state *s, const real y[], const real u[], const real known[])
{
    int i, code = see(s, y, known, 1);
    real applied[N_U];
    for (i = 0; i < N_U; i++) applied[i] = u && is_sane(u[i], MOST_U[i]) ? u[i] : s->u[i];
    if (s->steps >= 0) predict(s, applied);
#if POLICY_LEVELS
    count(s, applied);
#endif
    for (i = 0; i < N_U; i++) s->u[i] = within(s, applied[i], i);
    return code;
}

int policy_step(policy_state *s, const real y[], const real r[], const real known[], real u[])
{
    int i, code, seen = see(s, y, known, STAGES), sane = !r || take(s, r);
    code = seen == POLICY_INVALID || !sane ? POLICY_INVALID : plan(s, known);
    for (i = 0; i < N_U; i++) s->u[i] = within(s, s->u[i], i);
#if POLICY_LEVELS
    for (i = 0; i < N_U; i++) s->u[i] = on_level(s, s->u[i], i);
    count(s, s->u);
    if (code != POLICY_SOLVED && code != POLICY_NODE_LIMIT) s->plan.hint[0] = -1;
#endif
    if (s->steps >= 0) predict(s, s->u);
    copy(u, s->u, N_U);
    return code ? code : seen;
}

/* @EXAMPLES@ */

int policy_selftest(void)
{
    static policy_state state;
    real u[N_U];
    int i, j;
    if (policy_plan_selftest()) return 1;
    if (policy_target_selftest()) return 2;
    policy_reset(&state, 0, EXAMPLE_START[0], 0);
    for (i = 0; i < EXAMPLES; i++) {
        if (policy_step(&state, EXAMPLE_Y[i], EXAMPLE_R[i], EXAMPLE_KNOWN[i], u)) return 3 + i;
        for (j = 0; j < N_U; j++) {
            real off = u[j] - EXAMPLE_U[i][j];
            if (!(off <= NEAR_U[j] && -off <= NEAR_U[j])) return 3 + i;
        }
    }
    return 0;
}
