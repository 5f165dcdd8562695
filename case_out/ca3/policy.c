/* policy: a linear MPC with an observer, by torch_qpmpc.
   y and r: y1
   known: d
   u: u1 */
#include "policy.h"

/* An observer of e = [x; w], the state and constant disturbances; a QP for the steady state that is
   nearest to the set-point, or two if that leaves inputs free; and a QP for the plan to it.

       e  is corrected by L (y - H e), and predicted by F e + G u + E d + OFFSET
       [x_s; u_s; y_s] = [X_V; U_V; Y_V] v + [X_L; U_L; Y_L] [w; level; 1], v by the target's QPs
       u = u_s + the plan's first input, within the bounds */

typedef policy_real real;

enum { N_X = POLICY_N_X, N_W = POLICY_N_W, N_E = POLICY_N_E, N_U = POLICY_N_U };
enum { N_Y = POLICY_N_Y, N_D = POLICY_N_D, N_A = POLICY_TARGET_N_U, LOADS = N_W + N_D + 1 };
enum { N_V = N_A + POLICY_N_F, STAGES = POLICY_STAGES, SET_POINTS = POLICY_SET_POINTS };

#define BIG 1e300
static const real F[4][4] =
{
{0.7722167484342909, 0.020904942336288944, -0.028388480306396492, 0.0},
{-0.022632464605522293, 0.8892201418455117, -0.10099930645736255, 0.0},
{-0.011596618882209475, -0.04326065381374709, 1.0661499758322441, 0.0},
{0.0, 0.0, 0.0, 1.0}};
static const real G[4][1] =
{
{0.22578661322792176},
{-0.3526307943415954},
{-0.2812874181513504},
{0.0}};
static const real E[4][1] =
{
{0.04819453885067859},
{-0.02385536065733667},
{0.09577587029597641},
{0.0}};
static const real OFFSET[4] =
{0.0, 0.0, 0.0, 0.0};
static const real H[1][4] =
{
{-0.6680463461089501, -1.0551505512051214, -0.39080097723465473, 1.0}};
static const real L[4][1] =
{
{-0.7243235889549247},
{-2.9182103927461243},
{5.9303787976084665},
{-0.5675632891206797}};
static const real REST[4][5] =
{
{-4.286443113387597, -0.05670995798364102, -1.926127269609073, 0.0, -1.9704949234316798e-16},
{0.9778164053135345, -5.642173393487752, -8.19496713443533, 0.0, -7.176919793543249e-17},
{-0.11197691381386023, -3.6998011053403044, 9.420166705701588, 0.0, 1.0249536512169404e-15},
{-1.875559828004647, -7.43711313389328, -6.252256019308903, 0.0, 1.0}};
static const real X_V[3][1] =
{
{0.12468076209576058},
{-1.386599605760483},
{0.4208121606405468}};
static const real U_V[1][1] =
{
{0.30707397105449435}};
static const real Y_V[1][1] =
{
{1.2153250071602733}};
static const real X_L[3][3] =
{
{0.0, 0.43858149915436184, 0.0},
{0.0, 0.05961366045201642, 0.0},
{0.0, -0.8201303454312144, 0.0}};
static const real U_L[1][3] =
{
{0.0, 0.12037253413989185, 0.0}};
static const real Y_L[1][3] =
{
{1.0, -0.03538641421204353, 0.0}};
static const real ACTS[1] =
{1.0};
static const real NOMINAL[1] =
{0.0};
static const real U_LOWER[1] =
{-1.0};
static const real U_UPPER[1] =
{1.0};
static const real MOVE_LOWER[1] =
{-0.4000004000000009};
static const real MOVE_UPPER[1] =
{0.4000004000000009};
static const real MOST_Y[1] =
{200000000.0};
static const real MOST_KNOWN[1] =
{3685949199.98973};
static const real MOST_U[1] =
{100000000.0};
static const int OF_Y[] = {0};
static const int OF_U[] = {0};
static const int LOWER_OF[] = {-1};
static const int UPPER_OF[] = {-1};

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

/* Return x within the bounds of input i, some of which are known signals: in the last valid row. */
static real within(const policy_state *s, real x, int i)
{
    int seen = s->starts < 2;
    real lower = seen && LOWER_OF[i] >= 0 ? s->known[LOWER_OF[i]] : U_LOWER[i];
    real upper = seen && UPPER_OF[i] >= 0 ? s->known[UPPER_OF[i]] : U_UPPER[i];
    if (x < lower) x = lower;
    return x > upper ? upper : x;
}

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
    int i, j, missing = 0, valid = are_sane(known, MOST_KNOWN, stages, N_D);
    if (valid) {
        copy(s->known, known, N_D);
        if (s->starts) s->starts = 1;
    }
    if (s->starts) {
        if (!valid || !y || !are_sane(y, MOST_Y, 1, N_Y)) return POLICY_INVALID;
        rest(s, y);
        s->starts = 0;
    }
    for (i = 0; i < N_Y; i++) {
        error[i] = 0;
        if (!y || !is_sane(y[i], MOST_Y[i])) {
            missing = 1;
            continue;
        }
        error[i] = y[i];
        for (j = 0; j < N_E; j++) error[i] -= H[i][j] * s->e[j];
    }
    add(s->e, &L[0][0], N_E, N_Y, error);
    return !valid ? POLICY_INVALID : missing ? POLICY_MISSING : POLICY_SOLVED;
}

/* Set the target for the set-point of a stage; return the code of its QPs. */
static int aim(policy_state *s, const real r[], const real level[])
{
    real loads[LOADS], t[N_A + POLICY_TARGET_N_P], v[N_V];
    int i, code;
    copy(loads, s->e + N_X, N_W);
    copy(loads + N_W, level, N_D);
    loads[LOADS - 1] = 1;
    copy(t, r, N_Y);
    copy(t + N_Y, loads, LOADS);
    code = policy_target_step(&s->target, t, v, 0);
#if POLICY_N_F
    if (code == POLICY_SOLVED) {
        copy(t, v, N_A);
        copy(t + N_A, loads, LOADS);
        code = policy_free_step(&s->free, t, v + N_A, 0);
    }
#endif
    for (i = 0; i < N_X; i++) s->x_s[i] = 0;
    for (i = 0; i < N_U; i++) s->u_s[i] = 0;
    for (i = 0; i < N_Y; i++) s->y_s[i] = 0;
    add(s->x_s, &X_V[0][0], N_X, N_V, v);
    add(s->u_s, &U_V[0][0], N_U, N_V, v);
    add(s->y_s, &Y_V[0][0], N_Y, N_V, v);
    add(s->x_s, &X_L[0][0], N_X, LOADS, loads);
    add(s->u_s, &U_L[0][0], N_U, LOADS, loads);
    add(s->y_s, &Y_L[0][0], N_Y, LOADS, loads);
    return code;
}

/* Replace the last input by the plan's; return a code. */
static int plan(policy_state *s, const real known[])
{
    /* a stage of p has set-points and inputs relative to the target if it has any, then known ones */
    enum { N_R = POLICY_N_R, N_UR = POLICY_N_UR, N_K = N_R + N_UR + N_D };
    real level[POLICY_N_D_] = {0}, move[N_U], *p = s->p;
    int i, k, code;
    for (i = 0; i < N_D; i++) {
        for (k = 0; k < STAGES; k++) level[i] += known[k * N_D + i] - NOMINAL[i];
        level[i] /= (real)STAGES;
    }
    for (k = 0; k < SET_POINTS; k++) {
        if ((code = aim(s, s->r + k * N_Y, level)) != POLICY_SOLVED) return code;
        copy(p + k * N_K, s->y_s, N_R);
        copy(p + k * N_K + N_R, s->u_s, N_UR);
    }
    for (k = 0; k < STAGES; k++) {
        for (i = 0; i < N_R; i++) *p++ -= s->y_s[i];
        for (i = 0; i < N_UR; i++) *p++ -= s->u_s[i];
        for (i = 0; i < N_D; i++) *p++ = known[k * N_D + i] - NOMINAL[i] - ACTS[i] * level[i];
    }
    for (i = 0; i < N_X; i++) *p++ = s->e[i] - s->x_s[i];
    for (i = 0; i < POLICY_MOVES; i++) *p++ = s->u[i] - s->u_s[i];
    for (i = 0; i < POLICY_BOUNDED_Y; i++) *p++ = s->y_s[OF_Y[i]];
    for (i = 0; i < POLICY_BOUNDED_U; i++) *p++ = s->u_s[OF_U[i]];
    *p = 1;
    if ((code = policy_plan_step(&s->plan, s->p, move, 0)) != POLICY_SOLVED) return code;
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
#if POLICY_N_F
    policy_free_reset(&s->free);
#endif
    for (i = 0; i < N_E; i++) s->e[i] = 0;
    for (i = 0; i < POLICY_N_D_; i++) s->known[i] = 0;
    s->starts = 2;
    for (i = 0; i < N_U; i++) s->u[i] = within(s, u && is_sane(u[i], MOST_U[i]) ? u[i] : 0, i);
    for (i = 0; i < SET_POINTS * N_Y; i++) s->r[i] = 0;
    if (y && are_sane(y, MOST_Y, 1, N_Y) && (!N_D || (known && are_sane(known, MOST_KNOWN, 1, N_D)))) {
        copy(s->known, known, N_D);
        rest(s, y);
        s->starts = 0;
    }
}

int policy_observe(policy_state *s, const real y[], const real u[], const real known[])
{
    int i, code = see(s, y, known, 1);
    real applied[N_U];
    for (i = 0; i < N_U; i++) applied[i] = u && is_sane(u[i], MOST_U[i]) ? u[i] : s->u[i];
    if (!s->starts) predict(s, applied);
    for (i = 0; i < N_U; i++) s->u[i] = within(s, applied[i], i);
    return code;
}

int policy_step(policy_state *s, const real y[], const real r[], const real known[], real u[])
{
    int i, code, seen = see(s, y, known, STAGES), sane = !r || are_sane(r, MOST_Y, SET_POINTS, N_Y);
    if (r && sane) copy(s->r, r, SET_POINTS * N_Y);
    code = seen == POLICY_INVALID || !sane ? POLICY_INVALID : plan(s, known);
    for (i = 0; i < N_U; i++) s->u[i] = within(s, s->u[i], i);
    if (!s->starts) predict(s, s->u);
    copy(u, s->u, N_U);
    return code ? code : seen;
}

#define EXAMPLES 10
static const real EXAMPLE_Y[10][1] =
{
{-0.017352335286434054},
{0.41769542520269304},
{0.6533740071122174},
{0.8223101423033438},
{1.4308966773756322},
{1.5398682281177698},
{1.7545866444183222},
{1.8398737941982077},
{1.7942739622302766},
{1.7214087260669315}};
static const real EXAMPLE_R[10][1] =
{
{0.5478467492858172},
{0.5478467492858172},
{0.5478467492858172},
{0.5478467492858172},
{0.5478467492858172},
{0.5478467492858172},
{0.5478467492858172},
{0.5478467492858172},
{0.5478467492858172},
{0.5478467492858172}};
static const real EXAMPLE_KNOWN[10][9] =
{
{-4.664279258852025, -2.2973580065635826, 0.15232546051376467, -8.569945323731515,
 -0.8064549586365889, -4.592364459285883, -2.6991002702477838, -2.006110962450126,
 -1.1658663083255119},
{-2.2973580065635826, 0.15232546051376467, -8.569945323731515, -0.8064549586365889,
 -4.592364459285883, -2.6991002702477838, -2.006110962450126, -1.1658663083255119,
 1.5172492462395786},
{0.15232546051376467, -8.569945323731515, -0.8064549586365889, -4.592364459285883,
 -2.6991002702477838, -2.006110962450126, -1.1658663083255119, 1.5172492462395786,
 3.8426513200758357},
{-8.569945323731515, -0.8064549586365889, -4.592364459285883, -2.6991002702477838,
 -2.006110962450126, -1.1658663083255119, 1.5172492462395786, 3.8426513200758357,
 -0.47377223804951274},
{-0.8064549586365889, -4.592364459285883, -2.6991002702477838, -2.006110962450126,
 -1.1658663083255119, 1.5172492462395786, 3.8426513200758357, -0.47377223804951274,
 5.036714936087805},
{-4.592364459285883, -2.6991002702477838, -2.006110962450126, -1.1658663083255119,
 1.5172492462395786, 3.8426513200758357, -0.47377223804951274, 5.036714936087805,
 -2.451873774575413},
{-2.6991002702477838, -2.006110962450126, -1.1658663083255119, 1.5172492462395786,
 3.8426513200758357, -0.47377223804951274, 5.036714936087805, -2.451873774575413, 1.2956482616477},
{-2.006110962450126, -1.1658663083255119, 1.5172492462395786, 3.8426513200758357,
 -0.47377223804951274, 5.036714936087805, -2.451873774575413, 1.2956482616477, 3.3301451932740602},
{-1.1658663083255119, 1.5172492462395786, 3.8426513200758357, -0.47377223804951274,
 5.036714936087805, -2.451873774575413, 1.2956482616477, 3.3301451932740602, 0.3465245537208919},
{1.5172492462395786, 3.8426513200758357, -0.47377223804951274, 5.036714936087805,
 -2.451873774575413, 1.2956482616477, 3.3301451932740602, 0.3465245537208919, -2.7405004633486354}};
static const real EXAMPLE_U[10][1] =
{
{0.4000000000000069},
{0.7999999999999996},
{1.0},
{0.9999999999999699},
{0.9999999999999897},
{0.9999999999999882},
{0.9085433961151157},
{0.8506332868522954},
{0.9999999999999727},
{0.9999999999999674}};
static const real EXAMPLE_START[1][1] =
{
{0.0}};
static const real NEAR_U[1] =
{1e-06};

int policy_selftest(void)
{
    static policy_state state;
    real u[N_U];
    int i, j;
    if (policy_plan_selftest()) return 1;
    if (policy_target_selftest()) return 2;
#if POLICY_N_F
    if (policy_free_selftest()) return 2;
#endif
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
