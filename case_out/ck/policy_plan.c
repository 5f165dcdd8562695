/* policy_plan: the policy and value of a quadratic program, by torch_qpmpc 0.1.0 on 2026-11-27.
   SHA-256 of H, q, c, C, b, G, lb, ub, w: f749e8b56d2bb51d8f5542b2772db8d827af75dc1658bb3f1649db4ffbf2aabe
   
   p[0]: d_0
   p[1]: d_1
   p[2]: d_2
   p[3]: d_3
   p[4]: d_4
   p[5]: d_5
   p[6]: d_6
   p[7]: d_7
   p[8]: d_8
   p[9 .. 12]: x_0
   u[0]: u_0 */
#include "policy_plan.h"

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

typedef policy_plan_real real;

enum { FREE = 0, HELD = 1, SATURATED = 2, IGNORED = 3 }; /* of kind; negative at the lower bound */

#define BIG 1e300
#define TOLERANCE 1e-11
#define TIGHT 1e-14
#define EPSILON 2.2e-16
#define ROUNDING 4e-15
#define DEPENDENT 1e-12
#define NOISE 1e-10
#define FEASIBLE 1e-8
#define KNOWN_FEASIBLE 1e-6
#define GAP 1e-9
#define COARSE 1e-7
#define MAX_ITERATIONS 260
#define REFINEMENTS 3
static const real Y_P[8][13] =
{
{-0.1311259014038727, -0.07852068946209916, -0.03110938720434527, -0.005333159933489735,
 0.0037301784396407156, 0.004520698525834686, 0.0027961490384977635, 0.001146959497277748, 0.0,
 -1.1801331126348544, 0.24182912355193398, 0.8270302478975365, -5.780036547716704e-16},
{-0.10935173088608531, -0.12581446616016576, -0.07636152384971982, -0.030702829635895233,
 -0.0055616315052751195, 0.0034322598462271396, 0.004331863303815519, 0.0027167474384373566, 0.0,
 -0.9841655779747677, -0.015525154632255471, 0.8253241881279225, 6.373254563533696e-16},
{-0.05429433185876423, -0.08058356479968928, -0.11057683236081638, -0.07119871645884987,
 -0.030398461056069068, -0.00666595546832047, 0.00242931172398578, 0.003784351700157436, 0.0,
 -0.48864898672887785, -0.07292350584382484, 0.786905719604633, 5.873934707642349e-16},
{-0.0174549456838476, -0.03481677770036203, -0.07128875995860459, -0.10639872240738596,
 -0.07015327813749203, -0.030624357583090997, -0.00712985384637605, 0.0021010947718541895, 0.0,
 -0.15709451115462858, -0.055520616985912874, 0.7658861647233888, -6.115503495727026e-17},
{-0.0006753723477010631, -0.008399902788487793, -0.03104773504532742, -0.07021772636754019,
 -0.10613138643480662, -0.0702117334909604, -0.030743560605058413, -0.007214084589190233, 0.0,
 -0.00607835112930985, -0.027538160647751764, 0.760904187978265, 1.6413368274951332e-16},
{0.003996813665408972, 0.0020821711436310422, -0.007302367046731838, -0.030841323709785085,
 -0.07030540473910016, -0.10622467594496711, -0.07026661862637422, -0.030764875756247055, 0.0,
 0.03597132298868089, -0.008491438544564201, 0.7604349650295725, -3.9478311255429016e-16},
{0.003517635763738583, 0.003949209286047596, 0.0020633105060592306, -0.007305598965351012,
 -0.03083905659864245, -0.0703026511179126, -0.10622296124137927, -0.07026591036208994, 0.0,
 0.031658721873647336, 0.0001466103748172165, 0.7604348252819825, -4.3181372958473255e-16},
{0.001887662362103389, 0.002752142313356112, 0.003645804360890363, 0.0020112311916283473,
 -0.0072688945938680265, -0.03079352930718146, -0.070272058113351, -0.10620673631512692, 0.0,
 0.016988961258930572, 0.002357062879668893, 0.7603987036428045, -6.539431165232821e-16}};
static const real Y_LOWER[8] =
{-7.44327223107783, -7.427917693151301, -7.082151476441697, -6.892975482510499, -6.848137691804381,
 -6.843914685266149, -6.84391342753784, -6.843588332785237};
static const real Y_UPPER[8] =
{7.44327223107783, 7.427917693151301, 7.082151476441697, 6.892975482510499, 6.848137691804381,
 6.843914685266149, 6.84391342753784, 6.843588332785237};
static const real W[8] =
{BIG, BIG, BIG, BIG, BIG, BIG, BIG, BIG};
static const real SIZE[8] =
{7.44327223107783, 7.427917693151301, 7.082151476441697, 6.892975482510499, 6.848137691804381,
 6.843914685266149, 6.84391342753784, 6.843588332785237};
static const real UNIT[8] =
{1.20914561775967, 1.211645089753511, 1.270800268807847, 1.3056770654176328, 1.3142259114869863,
 1.315036848629273, 1.315037090297887, 1.3150995592303747};
static const real Q[8][8] =
{
{1.0, -0.06419886242080922, -0.3015497255778795, -0.22958614814641856, -0.11387445913576172,
 -0.0351133826225879, 0.0006062560731471803, 0.009746811488413193},
{-0.06419886242080922, 0.9999999999999999, -0.041725015543934124, -0.27815022044086746,
 -0.2203115866095397, -0.11131523364708514, -0.03507986262479599, -2.0757505493109527e-05},
{-0.3015497255778795, -0.041725015543934124, 0.9999999999999999, 0.030511567800025955,
 -0.22913853838008674, -0.19933821648992878, -0.10631635660067257, -0.0363844704076788},
{-0.22958614814641856, -0.27815022044086746, 0.030511567800025955, 0.9999999999999999,
 0.05564738003520109, -0.2148187949989302, -0.19415271496685632, -0.10570928829664114},
{-0.11387445913576172, -0.2203115866095397, -0.22913853838008674, 0.05564738003520109,
 1.0000000000000002, 0.05924982690516202, -0.21349042822510686, -0.19399053051196746},
{-0.0351133826225879, -0.11131523364708514, -0.19933821648992878, -0.2148187949989302,
 0.05924982690516202, 1.0000000000000002, 0.05919199102989516, -0.2136908848621882},
{0.0006062560731471803, -0.03507986262479599, -0.10631635660067257, -0.19415271496685632,
 -0.21349042822510686, 0.05919199102989516, 0.9999999999999999, 0.05919507751992298},
{0.009746811488413193, -2.0757505493109527e-05, -0.0363844704076788, -0.10570928829664114,
 -0.19399053051196746, -0.2136908848621882, 0.05919507751992298, 0.9999999999999998}};
static const real KNOWN_P[1][13] =
{
{0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0}};
static const real KNOWN_LOWER[1] =
{0.0};
static const real KNOWN_UPPER[1] =
{0.0};
static const real KNOWN_W[1] =
{0.0};
static const real U_P[1][13] =
{
{-0.15855030905727924, -0.09494294756656509, -0.03761577920932283, -0.006448566962390566,
 0.004510328913753175, 0.00546618281172561, 0.0033809513565024856, 0.001386841049881223, 0.0,
 -1.4269527815155132, 0.2924066249894828, -1.234494637427034e-16, -6.988905862162384e-16}};
static const real U_OFFSET[1] =
{0.0};
static const real U_LAMBDA[1][8] =
{
{1.20914561775967, -0.0776257731612775, -0.36461752921912405, -0.2776030849295643,
 -0.13769080323875885, -0.04245719272282078, 0.0007330518740860797, 0.011785314398344432}};
static const real U_LOWER[1] =
{-BIG};
static const real U_UPPER[1] =
{BIG};
static const real V_PP[91] =
{0.007384205213215445, 0.002995473199216479, 0.004301455876413734, -0.0013833205599970352,
 0.0005527426671878917, 0.0038175588902987986, -0.001944303907607196, -0.0018020839549862948,
 0.0003868313297942546, 0.0038033375928607067, -0.0012607505065513082, -0.0016514077247099497,
 -0.001686040389566217, 0.0004067249679933134, 0.003796380477264933, -0.0005418947867209484,
 -0.0009057821414524595, -0.0015107715638356485, -0.0016619307813168466, 0.00038986195582014273,
 0.003786162119684184, -0.00012105774491627858, -0.00032233923637932, -0.0008187956583327776,
 -0.0014958592538154658, -0.001672360916174277, 0.00037722140898378305, 0.0037822528949614373,
 4.1444127529644856e-05, -3.0997694404900594e-05, -0.0002866580292707991, -0.0008126787398965684,
 -0.0015001376174033467, -0.0016775459742828028, 0.0003740143392882795, 0.0037815951369172475, 0.0,
 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.13291569383787796, 0.026959258792948332,
 -0.012449885039973319, -0.017498735168464764, -0.011346754558961777, -0.0048770530804885396,
 -0.0010895197042465076, 0.000372997147766803, 0.0, 1.5981206222704514, 0.03171006181145583,
 0.018988589513313017, 0.007523155841864563, 0.0012897133924781128, -0.000902065782750634,
 -0.0010932365623451236, -0.0006761902713004964, -0.000277368209976247, 0.0, 0.2853905563031028,
 0.07075933750105172, -1.0401801746319583e-17, 1.3497618354054766e-18, 1.2016056939753868e-17,
 -3.138814687291524e-18, -1.124748988302902e-17, 1.817930227490319e-17, 2.8306325910625863e-17,
 2.2878605062663855e-18, 0.0, -9.361621571687633e-17, 2.4689892748540703e-17,
 6.2234199947506275e-31, 1.6755591623726076e-17, 5.179818140928357e-17, 6.322608295289206e-17,
 1.2096449129547041e-16, 1.5213279320641117e-16, 6.60131890985687e-17, 4.568643092232574e-17,
 -2.7652795210027276e-17, 0.0, 1.5080032461353457e-16, 1.397781172432477e-16,
 -1.026210329937977e-15, 0.7279999999999982};
static const real V_P[13] =
{0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0};
static const real V_OFFSET = 0.0;

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

#if POLICY_PLAN_FACTORED /* the table is R with Q = R R' */

static real entry(int i, int j) { return dot(R[i], R[j], POLICY_PLAN_D); }

/* Update y to the multipliers that have changed since the last call. */
static void respond(policy_plan_state *s)
{
    real *plan = s->work + 2 * POLICY_PLAN_HELD_;
    int i;
    for (i = 0; i < POLICY_PLAN_D; i++) plan[i] = 0;
    for (i = 0; i < POLICY_PLAN_ROWS; i++) {
        if (s->lambda[i] == s->before[i]) continue;
        add(plan, s->lambda[i] - s->before[i], R[i], POLICY_PLAN_D);
        s->before[i] = s->lambda[i];
    }
    for (i = 0; i < POLICY_PLAN_ROWS; i++) s->y[i] -= dot(R[i], plan, POLICY_PLAN_D);
}

#else

static real entry(int i, int j) { return Q[i][j]; }

/* Update y to the multipliers that have changed since the last call. */
static void respond(policy_plan_state *s)
{
    int i;
    for (i = 0; i < POLICY_PLAN_ROWS; i++) {
        if (s->lambda[i] == s->before[i]) continue;
        add(s->y, s->before[i] - s->lambda[i], Q[i], POLICY_PLAN_ROWS);
        s->before[i] = s->lambda[i];
    }
}

#endif

/* Compute y from all multipliers. */
static void respond_anew(policy_plan_state *s)
{
    int i;
    for (i = 0; i < POLICY_PLAN_ROWS; i++) {
        s->y[i] = s->y_free[i];
        s->before[i] = 0;
    }
    respond(s);
}

/* Return the bound that a row is held at. */
static real bound(const policy_plan_state *s, int row)
{
    return s->kind[row] > 0 ? Y_UPPER[row] : Y_LOWER[row];
}

/* Return the ends of the interval of a row's multiplier; equal bounds hold it on both sides. */
static real lowest(int row, int side)
{
    return side > 0 && Y_LOWER[row] < Y_UPPER[row] ? 0 : -W[row];
}

static real highest(int row, int side)
{
    return side < 0 && Y_LOWER[row] < Y_UPPER[row] ? 0 : W[row];
}

/* The factor: column i of L, from below its unit diagonal. */
static real *column(policy_plan_state *s, int i)
{
    return s->lower + (i * (POLICY_PLAN_HELD - 1) - (i * (i - 1)) / 2);
}

/* Solve L x = x. */
static void solve_lower(policy_plan_state *s, real *x, int n)
{
    int i;
    for (i = 0; i < n; i++) add(x + i + 1, -x[i], column(s, i), n - 1 - i);
}

/* Solve D L' x = x. */
static void solve_upper(policy_plan_state *s, real *x, int n)
{
    int i;
    for (i = n - 1; i >= 0; i--)
        x[i] = x[i] / s->diagonal[i] - dot(column(s, i), x + i + 1, n - 1 - i);
}

/* Append a row to the factor; return 0 if it depends on the held rows.

   x becomes the solution of L x = Q[held][row] in either case. */
static int append(policy_plan_state *s, int row, real *x)
{
    real pivot = 1;
    int i, n = s->n_held;
    for (i = 0; i < n; i++) x[i] = entry(row, s->held[i]);
    solve_lower(s, x, n);
    for (i = 0; i < n; i++) pivot -= x[i] * x[i] / s->diagonal[i];
    if (n == POLICY_PLAN_HELD || pivot <= DEPENDENT) return 0;
    for (i = 0; i < n; i++) column(s, i)[n - 1 - i] = x[i] / s->diagonal[i];
    s->diagonal[n] = pivot;
    s->held[n] = row;
    s->n_held++;
    return 1;
}

/* Remove the held row at a position, by a rank-one update of the rows after it. */
static void drop(policy_plan_state *s, int at)
{
    real *removed = s->work + POLICY_PLAN_HELD_, weight = s->diagonal[at];
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
static void refactor(policy_plan_state *s)
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
static void release(policy_plan_state *s, int at, real end)
{
    int row = s->held[at];
    s->lambda[row] = end;
    s->kind[row] = (signed char)(end > 0 ? SATURATED : end < 0 ? -SATURATED : FREE);
    drop(s, at);
}

/* Return the longest step in [0, most] along x that keeps the held multipliers in their intervals,
   the position of the row that stops it in *at (-1 if none does) and its end in *end. Entries of x
   up to `noise` are rounding. */
static real longest(const policy_plan_state *s, const real *x, real noise, real most, int *at, real *end)
{
    int i;
    *at = -1;
    for (i = 0; i < s->n_held; i++) {
        int row = s->held[i];
        real to = x[i] > 0 ? highest(row, s->kind[row]) : lowest(row, s->kind[row]);
        real room = to - s->lambda[row];
        if (absolute(x[i]) > noise && absolute(to) < BIG && absolute(most * x[i]) > absolute(room)) {
            most = larger(0, room / x[i]);
            *at = i;
            *end = to;
        }
    }
    return most;
}

static void move(policy_plan_state *s, const real *x, real step)
{
    int i;
    for (i = 0; i < s->n_held; i++) s->lambda[s->held[i]] += step * x[i];
}

/* Move the held multipliers to their optimum, letting go those that meet an end on the way. */
static void settle(policy_plan_state *s, int *iterations)
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
static int hold(policy_plan_state *s, int row, int side, real excess, int *iterations)
{
    real *x = s->work, sign = excess > 0 ? 1 : -1;
    while (!append(s, row, x)) {
        real most = BIG, end = 0, own, room, step;
        int i, at;
        solve_upper(s, x, s->n_held);
        for (i = 0; i < s->n_held; i++) x[i] *= -sign;
        own = sign > 0 ? highest(row, side) : lowest(row, side);
        room = absolute(own - s->lambda[row]);
        if (absolute(own) < BIG) most = room;
        step = longest(s, x, NOISE, most, &at, &end);
        if (step >= BIG) {
            s->kind[row] = IGNORED;
            return absolute(excess) <= FEASIBLE * s->size[row];
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
static int worst(const policy_plan_state *s, real tolerance, int *side, real *excess, int *settled)
{
    real sum = 0, gain = 0;
    int i, found = -1;
    *settled = 1;
    for (i = 0; i < POLICY_PLAN_ROWS; i++) sum += absolute(s->lambda[i]);
    for (i = 0; i < POLICY_PLAN_ROWS; i++) {
        int kind = s->kind[i];
        real above = s->y[i] - Y_UPPER[i], below = s->y[i] - Y_LOWER[i], off = 0, size, length;
        if (kind == FREE) off = above > 0 ? above : smaller(below, 0);
        else if (kind == SATURATED) off = smaller(above, 0);
        else if (kind == -SATURATED) off = larger(below, 0);
        else if (kind != IGNORED) off = kind > 0 ? above : below;
        size = absolute(off);
        if (size <= tolerance * s->size[i] + ROUNDING * sum) continue;
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

/* Solve from the multipliers of the state, with rows exact to a tolerance relative to their size. */
static int solve(policy_plan_state *s, real tolerance, int *iterations)
{
    int refinements = 0;
    respond_anew(s);
    for (;;) {
        real excess = 0;
        int row, side = 0, settled;
        settle(s, iterations);
        respond(s);
        row = worst(s, tolerance, &side, &excess, &settled);
        if (row < 0) { /* judge y without the rounding of its updates */
            respond_anew(s);
            row = worst(s, tolerance, &side, &excess, &settled);
        }
        if (row < 0 && (settled || refinements++ == REFINEMENTS)) return POLICY_PLAN_SOLVED;
        if (*iterations >= MAX_ITERATIONS) return POLICY_PLAN_LIMIT;
        if (row < 0) continue;
        ++*iterations;
        if (!hold(s, row, side, excess, iterations)) return POLICY_PLAN_INFEASIBLE;
    }
}

/* Return the distance of y to its bounds. */
static real distance(real y, real lower, real upper)
{
    return y > upper ? y - upper : y < lower ? lower - y : 0;
}

/* Certify the multipliers: complete the value and the info; return 1 if they are optimal. */
static int certify(const policy_plan_state *s, real v_free, policy_plan_info *info)
{
    real quadratic = 0, charges = 0, sum = 0, terms;
    int i, holds = 1;
    info->gap = 0;
    for (i = 0; i < POLICY_PLAN_ROWS; i++) sum += absolute(s->lambda[i]);
    for (i = 0; i < POLICY_PLAN_ROWS; i++) {
        real y = s->y[i], lambda = s->lambda[i], off = distance(y, Y_LOWER[i], Y_UPPER[i]);
        real charge = W[i] < BIG ? W[i] * off : 0;
        if (W[i] >= BIG) {
            info->violation = larger(info->violation, off * UNIT[i]);
            if (!(off <= FEASIBLE * s->size[i] + ROUNDING * sum)) holds = 0;
        }
        if (lambda != 0) {
            real at = lambda > 0 ? Y_UPPER[i] : Y_LOWER[i];
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
static void act(policy_plan_state *s, const real p[], real u[])
{
    int i;
    for (i = 0; i < POLICY_PLAN_N_U; i++) {
        real x = U_OFFSET[i] + dot(U_P[i], p, POLICY_PLAN_N_P) - dot(U_LAMBDA[i], s->lambda, POLICY_PLAN_ROWS);
        if (is_finite(x)) s->u[i] = smaller(larger(x, U_LOWER[i]), U_UPPER[i]);
        u[i] = s->u[i];
    }
}

/* Compute what depends on p alone; return 0 if it is not finite. */
static int prepare(policy_plan_state *s, const real p[], real *v_free)
{
    const real *row = V_PP;
    real sum = V_OFFSET, check = 0;
    int i, j;
    for (i = 0; i < POLICY_PLAN_N_P; i++) {
        sum += p[i] * (V_P[i] + dot(row, p, i + 1));
        row += i + 1;
    }
    for (i = 0; i < POLICY_PLAN_ROWS; i++) {
        real y = 0, size = SIZE[i];
        for (j = 0; j < POLICY_PLAN_N_P; j++) {
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
static int judge(const real p[], policy_plan_info *info)
{
    int i, holds = 1;
    for (i = 0; i < POLICY_PLAN_KNOWN; i++) {
        real y = dot(KNOWN_P[i], p, POLICY_PLAN_N_P);
        real off = distance(y, KNOWN_LOWER[i], KNOWN_UPPER[i]);
        if (KNOWN_W[i] < BIG) {
            info->value += KNOWN_W[i] * off;
        } else {
            info->violation = larger(info->violation, off);
            if (off > KNOWN_FEASIBLE * (1 + absolute(y))) holds = 0;
        }
    }
    return holds;
}

/* Forget the active set, but not the last action. */
static void restart(policy_plan_state *s)
{
    int i;
    s->n_held = 0;
    for (i = 0; i < POLICY_PLAN_ROWS; i++) {
        s->lambda[i] = 0;
        s->kind[i] = FREE;
    }
}

void policy_plan_reset(policy_plan_state *s)
{
    int i;
    restart(s);
    for (i = 0; i < POLICY_PLAN_N_U; i++) s->u[i] = smaller(larger(0, U_LOWER[i]), U_UPPER[i]);
}

int policy_plan_step(policy_plan_state *s, const real p[], real u[], policy_plan_info *info)
{
    policy_plan_info local;
    real v_free = 0, value, violation;
    int i, code, feasible, finite = 1, fresh = 0, cold = 1;
    if (!info) info = &local;
    info->value = info->gap = info->violation = 0;
    info->iterations = 0;
    for (i = 0; i < POLICY_PLAN_N_P; i++) finite = finite && is_finite(p[i]);
    if (!finite || !prepare(s, p, &v_free)) {
        restart(s);
        for (i = 0; i < POLICY_PLAN_N_U; i++) u[i] = s->u[i];
        return POLICY_PLAN_INVALID;
    }
    feasible = judge(p, info);
    value = info->value;
    violation = info->violation;
    for (i = 0; i < POLICY_PLAN_ROWS; i++) cold = cold && s->lambda[i] == 0;
    for (;;) { /* from the last active set, with a new factor and tight rows, and from none */
        code = solve(s, fresh ? TIGHT : TOLERANCE, &info->iterations);
        info->value = value;
        info->violation = violation;
        if (!certify(s, v_free, info) && code == POLICY_PLAN_SOLVED) {
            code = POLICY_PLAN_LIMIT;
            if (!fresh) {
                refactor(s);
                fresh = 1;
                continue;
            }
        }
        if (code == POLICY_PLAN_SOLVED || cold || info->iterations >= MAX_ITERATIONS) break;
        restart(s);
        cold = 1;
        fresh = 0;
    }
    act(s, p, u);
    return feasible ? code : POLICY_PLAN_INFEASIBLE;
}

/* States of the self-test: interior, interior, interior, at bounds, at bounds, at bounds. */
#define EXAMPLES 6
static const int EXAMPLE_CODE[] = {0, 0, 0, 0, 0, 0};
static const real EXAMPLE_P[6][13] =
{
{40.79837469960884, 6.233939081251705, -29.660279158563114, -11.172689613614974, 17.1246742156754,
 2.730174456074732, -8.233615207440518, 19.347652517088306, 0.1747316534447149, -3.322546811647567,
 -31.68510823792324, 2.1796987094080795, 1.0},
{-2.7525648768566024, 44.32851409284948, -21.1910760879247, -18.664470495120735, 9.894717852055859,
 52.17685165488756, -47.13353165405688, -22.000455253233067, 0.505279325418555,
 -1.6985317708970722, 27.864049588517027, -2.9007402622626577, 1.0},
{-1.5358335654969457, 2.4160124036747166, -16.902141687039602, -21.451478501983903,
 61.40839203840411, -39.08463835193935, -5.017069977568588, -13.916148051827744,
 -0.037793054285701747, 2.6224331572912134, 28.442690490963916, -0.433675804784173, 1.0},
{-230.00755098171535, -204.27159246486116, -144.18839811073653, 180.32579248640303,
 -22.156383357511785, -46.69726898482143, -7.8022158331846505, -231.02622315420564,
 -0.6868292298961707, -13.547285451020153, 107.57666342141003, 9.13841042289316, 1.0},
{16.332057499324222, 68.98001067460135, -104.0989244405703, -48.78637417721538,
 -100.57363570306816, -125.07993555737765, 9.872565789486993, -71.35562098625446,
 0.6401807144816606, -0.22318113480813537, 39.100245609245654, -2.6682733904224123, 1.0},
{-5.2006481489510445, -0.3101761353108634, -47.67374547734977, 29.127367571165422,
 50.79442708335498, 10.742377652094495, 116.44943622856822, -42.97876034167722, 0.5115955356215418,
 -2.60482137451434, 9.29035279675965, -7.340398932256951, 1.0}};
static const real EXAMPLE_U[6][1] =
{
{-10.30538305526152},
{7.856544812996924},
{5.390051229757722},
{-0.13841042289316086},
{11.668273390422412},
{3.2543843289342376}};
static const real EXAMPLE_VALUE[6] =
{85.08553632058246, 94.71864685590573, 107.63002804679962, 18890.9610117161, 814.9500151678578,
 324.4008078295176};
static const real NEAR_U[1] =
{3.2479229711031384e-05};
static const real NEAR_VALUE[6] =
{0.002242291774343209, 0.002242291774343209, 0.002242291774343209, 0.002242291774343209,
 0.002242291774343209, 0.002242291774343209};

static int near(real x, real expected, real tolerance) { return absolute(x - expected) <= tolerance; }

/* With an operating system each thread has its own; without one a stack may be too small. */
#if defined(__GNUC__) && (defined(__unix__) || defined(__APPLE__))
#define OWN static __thread
#elif defined(_MSC_VER)
#define OWN static __declspec(thread)
#else
#define OWN static
#endif

int policy_plan_selftest(void)
{
    OWN policy_plan_state state;
    OWN real p[POLICY_PLAN_N_P], u[POLICY_PLAN_N_U];
    policy_plan_info info;
    volatile real zero = 0;
    int round, i, j;
    for (round = 0; round < 2; round++) { /* cold, then from the last active set */
        policy_plan_reset(&state);
        for (i = 0; i < EXAMPLES; i++) {
            int code, good;
            if (round == 0) policy_plan_reset(&state);
            code = policy_plan_step(&state, EXAMPLE_P[i], u, &info);
            good = code == EXAMPLE_CODE[i];
            if (code == POLICY_PLAN_LIMIT && info.iterations >= MAX_ITERATIONS) good = 1;
            for (j = 0; j < POLICY_PLAN_N_U; j++) {
                good = good && u[j] >= U_LOWER[j] && u[j] <= U_UPPER[j];
                if (code == POLICY_PLAN_SOLVED) good = good && near(u[j], EXAMPLE_U[i][j], NEAR_U[j]);
            }
            if (code == POLICY_PLAN_SOLVED) good = good && near(info.value, EXAMPLE_VALUE[i], NEAR_VALUE[i]);
            if (!good) return i + 1;
        }
    }
    for (j = 0; j < POLICY_PLAN_N_P; j++) p[j] = 0;
    for (round = 0; round < 2; round++) { /* a NaN and an infinity */
        p[POLICY_PLAN_N_P - 1] = (round ? 1 : zero) / zero;
        if (policy_plan_step(&state, p, u, 0) != POLICY_PLAN_INVALID) return EXAMPLES + 1;
        for (j = 0; j < POLICY_PLAN_N_U; j++)
            if (!(u[j] >= U_LOWER[j] && u[j] <= U_UPPER[j])) return EXAMPLES + 1;
    }
    return 0;
}
