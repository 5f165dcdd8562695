/* policy_plan: the policy and value of a quadratic program, by torch_qpmpc 0.1.0 on 2026-11-27.
   SHA-256 of H, q, c, C, b, G, lb, ub, w: 01d8dd2d1c440d3cd6a5942403bf620434200db609943d2f410fbc784a6679c8
   
   p[0 .. 5]: x_0
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
#define MAX_ITERATIONS 480
#define REFINEMENTS 3
static const real Y_P[19][6] =
{
{-0.9099638546806263, -0.34642237615183225, 0.29151133630348225, -3.717053263429884e-16,
 0.6860796651550694, 3.5894965332199e-16},
{-0.9616802436385685, -0.42164537842583844, 0.04953408251487599, 9.676161846449813e-16,
 0.6761024052618675, 9.737272245412985e-16},
{10.204526720831542, 1.9862484853754123, 0.2915113363034823, 13.721593303101443,
 9.319596908291364e-15, -1.0753157404519087e-15},
{-0.6342993819319315, -0.3427022788102884, -0.0667119463683654, 1.4675989906791722e-15,
 0.6581600260637802, 1.1000536641363334e-16},
{3.5238698525402214, 0.9237153481659064, 0.257137659623828, 6.464119596237154,
 5.103022433225016e-15, -5.697031598982541e-16},
{-0.24102309686555307, -0.20537405481839496, -0.0955621585119195, 7.933545629858176e-16,
 0.6217910875607556, 5.431924344331808e-17},
{1.5311067021872813, 0.5027953052793998, 0.21090062952692787, 4.462521138512523,
 6.1402731917402004e-15, 6.171248970649952e-17},
{0.04421300809126554, -0.08482902742873817, -0.0809241873377957, 1.3487925392216593e-15,
 0.5973522805363305, -1.024905773437273e-15},
{0.6342807170380088, 0.2669670024228123, 0.16289764016211475, 3.700768328028216,
 4.0869888790468785e-15, 6.55665969417646e-17},
{0.20016990992374695, -0.001146107200384167, -0.051579062045369634, 2.283131817705942e-15,
 0.5879273925004536, -4.682089305186204e-16},
{0.16318006448007943, 0.1169077111509094, 0.11560486703500288, 3.3973207375637338,
 2.9462833811092895e-15, -7.281079230781347e-17},
{0.24860629863410388, 0.04530259012053262, -0.02209539228903742, 1.1075277204973818e-15,
 0.586236128739531, -7.25691765831872e-16},
{-0.0814168864098637, 0.021282430742798546, 0.0716855498281379, 3.292998082683526,
 2.1880701771273086e-15, -2.9737612464513494e-16},
{0.22300828843638376, 0.0608219898696955, 0.00023619983907235373, -4.601521136912771e-16,
 0.5862359363014791, -8.086257475080187e-16},
{-0.18116749804917898, -0.03245221307143239, 0.03473102025229574, 3.269543100911093,
 1.5359125063838217e-15, -6.047092019741253e-16},
{0.15989989930378798, 0.05542845134036474, 0.013008845718065865, -4.778081983014345e-16,
 0.5856519193535477, 5.655611929616177e-16},
{-0.18752605855425641, -0.053402789575504456, 0.00785977386499168, 3.2683544749086235,
 3.2477667824851604e-15, -1.2270195722605804e-15},
{0.08973998164560312, 0.039700566259898644, 0.017272600461042485, -3.5298838375816396e-16,
 0.5846229656964612, 8.999684843534798e-16},
{-0.14372917045642625, -0.051941549664744194, -0.008002680008761446, 3.2671226726058173,
 4.236662574509631e-15, -1.813009453522382e-15}};
static const real Y_LOWER[19] =
{-0.6860796651550696, -0.6761024052618664, -13.721593303101438, -0.6581600260637803,
 -6.464119596237152, -0.6217910875607564, -4.462521138512517, -0.5973522805363316,
 -3.7007683280282166, -0.5879273925004552, -3.3973207375637315, -0.5862361287395326,
 -3.292998082683524, -0.5862359363014797, -3.2695431009110942, -0.5856519193535483,
 -3.2683544749086266, -0.5846229656964621, -3.2671226726058227};
static const real Y_UPPER[19] =
{0.6860796651550696, 0.6761024052618664, 13.721593303101438, 0.6581600260637803, 6.464119596237152,
 0.6217910875607564, 4.462521138512517, 0.5973522805363316, 3.7007683280282166, 0.5879273925004552,
 3.3973207375637315, 0.5862361287395326, 3.292998082683524, 0.5862359363014797, 3.2695431009110942,
 0.5856519193535483, 3.2683544749086266, 0.5846229656964621, 3.2671226726058227};
static const real W[19] =
{BIG, BIG, BIG, BIG, BIG, BIG, BIG, BIG, BIG, BIG, BIG, BIG, BIG, BIG, BIG, BIG, BIG, BIG, BIG};
static const real SIZE[19] =
{0.6860796651550696, 0.6761024052618664, 13.721593303101438, 0.6581600260637803, 6.464119596237152,
 0.6217910875607564, 4.462521138512517, 0.5973522805363316, 3.7007683280282166, 0.5879273925004552,
 3.3973207375637315, 0.5862361287395326, 3.292998082683524, 0.5862359363014797, 3.2695431009110942,
 0.5856519193535483, 3.2683544749086266, 0.5846229656964621, 3.2671226726058227};
static const real UNIT[19] =
{1.4575566815174115, 1.4790658814661106, 0.07287783407587033, 1.5193873228379462,
 0.15470010805216428, 1.6082572105092903, 0.2240885743643397, 1.67405404245239, 0.2702141586184628,
 1.700890301686744, 0.29434959994890403, 1.7057972905049403, 0.30367463778936726, 1.70579785045067,
 0.3058531327271199, 1.707498886204993, 0.30596436453789394, 1.7105041345898868,
 0.30607972219249746};
static const real Q[19][19] =
{
{0.9999999999999999, 0.16992163372784852, 0.9999999999999999, -0.22884854913125557,
 0.8820845970673705, -0.32781626856676715, 0.7234731664341402, -0.277602196758305,
 0.5588037920848734, -0.1769367280854987, 0.39657074232835554, -0.07579599671566338,
 0.24590999011272943, 0.0008102595325022042, 0.11914123372594501, 0.04462552257152293,
 0.02696215510744034, 0.059251899703346635, -0.027452380103771025},
{0.16992163372784852, 0.9999999999999998, 0.16992163372786043, 0.12412044585054906,
 0.6141254866486158, -0.26876168539444284, 0.7230274535194663, -0.3575225622934414,
 0.6862039695800806, -0.2993143172688992, 0.5729101240403365, -0.18674143525850256,
 0.4205885334653652, -0.07455603421661773, 0.26085246907438187, 0.008380522643861799,
 0.12194740177415331, 0.05396747494323029, 0.02189529287132095},
{0.9999999999999999, 0.16992163372786043, 1.0000000000000002, -0.22884854913124172,
 0.8820845970673764, -0.3278162685667661, 0.7234731664341518, -0.2776021967583053,
 0.5588037920848875, -0.17693672808550331, 0.3965707423283712, -0.0757959967156782,
 0.24590999011274492, 0.000810259532488058, 0.11914123372595611, 0.044625522571516404,
 0.026962155107444208, 0.05925189970335188, -0.02745238010377423},
{-0.22884854913125557, 0.12412044585054906, -0.22884854913124172, 1.0, -0.12393954739574792,
 0.1891701257697974, 0.24714616668611217, -0.18781738979458318, 0.4558128205312054,
 -0.3020517177940471, 0.5224661901497597, -0.2731871477893556, 0.48430444205396705,
 -0.18197106539581887, 0.3792454543600998, -0.08271765243731193, 0.24766741140067014,
 -0.005415923924662757, 0.12494886298280863},
{0.8820845970673705, 0.6141254866486158, 0.8820845970673764, -0.12393954739574792, 1.0,
 -0.3910128446890364, 0.9250350968978631, -0.3932301765760846, 0.7755556381710415,
 -0.2847857163730258, 0.5914712053061586, -0.14997200901994376, 0.3979975641350111,
 -0.03499208539615954, 0.22011350471035324, 0.03974481183732299, 0.07988886441717219,
 0.07325093617253876, -0.011518479163499988},
{-0.32781626856676715, -0.26876168539444284, -0.3278162685667661, 0.1891701257697974,
 -0.3910128446890364, 1.0, -0.3180002236690676, 0.2626951162066792, 0.010447628445393611,
 -0.11663655361001, 0.2653134649050755, -0.2596927465907144, 0.3978251942210164,
 -0.2583567661967826, 0.4152271381300838, -0.18637332393271283, 0.3493200306432985,
 -0.09743323634713368, 0.24289283274346038},
{0.7234731664341402, 0.7230274535194663, 0.7234731664341518, 0.24714616668611217,
 0.9250350968978631, -0.3180002236690676, 1.0, -0.46016487451223775, 0.9338707078794254,
 -0.3951932600168523, 0.7784139403572246, -0.2508733441828885, 0.5736943767778763,
 -0.10294731668825004, 0.35899708139450476, 0.008152559840643787, 0.17140706169033137,
 0.07025688308038835, 0.03526963118904429},
{-0.277602196758305, -0.3575225622934414, -0.2776021967583053, -0.18781738979458318,
 -0.3932301765760846, 0.2626951162066792, -0.46016487451223775, 1.0, -0.4084775884334433,
 0.29750636219720983, -0.1008749050831757, -0.09068881275729408, 0.1787936037266931,
 -0.24971065999460715, 0.34639303732485566, -0.2603432211325009, 0.39127732319654923,
 -0.19518200895406365, 0.34308475657920695},
{0.5588037920848734, 0.6862039695800806, 0.5588037920848875, 0.4558128205312054,
 0.7755556381710415, 0.010447628445393611, 0.9338707078794254, -0.4084775884334433,
 0.9999999999999998, -0.4744665689816268, 0.9325617149835356, -0.36914604429189657,
 0.7631312688644428, -0.20759639451887565, 0.5389525406314193, -0.0603522370167366,
 0.31267456449626724, 0.0398592247854706, 0.12675379102254264},
{-0.1769367280854987, -0.2993143172688992, -0.17693672808550331, -0.3020517177940471,
 -0.2847857163730258, -0.11663655361001, -0.3951932600168523, 0.29750636219720983,
 -0.4744665689816268, 1.0000000000000002, -0.439235642919795, 0.30538115040522934,
 -0.13974510693246378, -0.08940128072500554, 0.15363878161047145, -0.2534218356051369,
 0.33603318891586403, -0.2662692325983725, 0.3898160322839598},
{0.39657074232835554, 0.5729101240403365, 0.3965707423283712, 0.5224661901497597,
 0.5914712053061586, 0.2653134649050755, 0.7784139403572246, -0.1008749050831757,
 0.9325617149835356, -0.439235642919795, 1.0000000000000002, -0.46436779894993, 0.9273278357979418,
 -0.33855616956257695, 0.7428157601336609, -0.17268732512023924, 0.5052732109547082,
 -0.03180869442224453, 0.2760415611138431},
{-0.07579599671566338, -0.18674143525850256, -0.0757959967156782, -0.2731871477893556,
 -0.14997200901994376, -0.2596927465907144, -0.2508733441828885, -0.09068881275729408,
 -0.36914604429189657, 0.30538115040522934, -0.46436779894993, 0.9999999999999999,
 -0.44316215170745976, 0.3044411600731295, -0.1473810403499992, -0.09243773344322825,
 0.1510974986206779, -0.25673991999406753, 0.3370210357416469},
{0.24590999011272943, 0.4205885334653652, 0.24590999011274492, 0.48430444205396705,
 0.3979975641350111, 0.3978251942210164, 0.5736943767778763, 0.1787936037266931,
 0.7631312688644428, -0.13974510693246378, 0.9273278357979418, -0.44316215170745976, 1.0,
 -0.449908904236714, 0.9217478534699461, -0.3168592332608474, 0.726374378944801,
 -0.15251983991123275, 0.4828222207540856},
{0.0008102595325022042, -0.07455603421661773, 0.000810259532488058, -0.18197106539581887,
 -0.03499208539615954, -0.2583567661967826, -0.10294731668825004, -0.24971065999460715,
 -0.20759639451887565, -0.08940128072500554, -0.33855616956257695, 0.3044411600731295,
 -0.449908904236714, 1.0000000000000002, -0.4399089683848164, 0.30417392968583523,
 -0.14730556600672282, -0.09222728644161322, 0.15101825871243904},
{0.11914123372594501, 0.26085246907438187, 0.11914123372595611, 0.3792454543600998,
 0.22011350471035324, 0.4152271381300838, 0.35899708139450476, 0.34639303732485566,
 0.5389525406314193, 0.15363878161047145, 0.7428157601336609, -0.1473810403499992,
 0.9217478534699461, -0.4399089683848164, 0.9999999999999999, -0.4409425923710779,
 0.9180621300178697, -0.30699026435448823, 0.7176581224152687},
{0.04462552257152293, 0.008380522643861799, 0.044625522571516404, -0.08271765243731193,
 0.03974481183732299, -0.18637332393271283, 0.008152559840643787, -0.2603432211325009,
 -0.0603522370167366, -0.2534218356051369, -0.17268732512023924, -0.09243773344322825,
 -0.3168592332608474, 0.30417392968583523, -0.4409425923710779, 0.9999999999999997,
 -0.4381077568959815, 0.30598117197857494, -0.14832843248665378},
{0.02696215510744034, 0.12194740177415331, 0.026962155107444208, 0.24766741140067014,
 0.07988886441717219, 0.3493200306432985, 0.17140706169033137, 0.39127732319654923,
 0.31267456449626724, 0.33603318891586403, 0.5052732109547082, 0.1510974986206779,
 0.726374378944801, -0.14730556600672282, 0.9180621300178697, -0.4381077568959815,
 1.0000000000000002, -0.4384103041795155, 0.9166423173506898},
{0.059251899703346635, 0.05396747494323029, 0.05925189970335188, -0.005415923924662757,
 0.07325093617253876, -0.09743323634713368, 0.07025688308038835, -0.19518200895406365,
 0.0398592247854706, -0.2662692325983725, -0.03180869442224453, -0.25673991999406753,
 -0.15251983991123275, -0.09222728644161322, -0.30699026435448823, 0.30598117197857494,
 -0.4384103041795155, 0.9999999999999998, -0.4387998074585206},
{-0.027452380103771025, 0.02189529287132095, -0.02745238010377423, 0.12494886298280863,
 -0.011518479163499988, 0.24289283274346038, 0.03526963118904429, 0.34308475657920695,
 0.12675379102254264, 0.3898160322839598, 0.2760415611138431, 0.3370210357416469,
 0.4828222207540856, 0.15101825871243904, 0.7176581224152687, -0.14832843248665378,
 0.9166423173506898, -0.4387998074585206, 0.9999999999999998}};
static const real KNOWN_P[2][6] =
{
{1.0, 0.0, 0.0, 1.0, 0.0, 0.0},
{0.9000000000000011, 0.10000000000000032, 0.0, 1.0000000000000007, 6.486352597046177e-16,
 -1.1203995570903358e-16}};
static const real KNOWN_LOWER[2] =
{-1.0, -1.0};
static const real KNOWN_UPPER[2] =
{1.0, 1.0};
static const real KNOWN_W[2] =
{BIG, BIG};
static const real U_P[1][6] =
{
{-1.3263238963290858, -0.504930248987241, 0.42489429596720973, -5.417815819668326e-16,
 -1.6772677306413135e-16, 5.231894655278251e-16}};
static const real U_OFFSET[1] =
{0.0};
static const real U_LAMBDA[1][19] =
{
{1.4575566815174112, 0.24767041257437986, 1.4575566815174115, -0.3335597318418271,
 1.2856882981191395, -0.47781079255959746, 1.0545031476346391, -0.4046209366889785,
 0.8144882008105737, -0.2578953102268481, 0.5780243351750144, -0.11047696144518696,
 0.3584277491406894, 0.0011809991953618537, 0.17365510126147868, 0.06504422859032924,
 0.039298869324958415, 0.08636300230521236, -0.04001340004380713}};
static const real U_LOWER[1] =
{-BIG};
static const real U_UPPER[1] =
{BIG};
static const real V_PP[21] =
{3.0841204820388763, 0.85682087862948, 0.1093962326705732, 0.2652647792658169, 0.10098604979744819,
 0.05751057040327903, 5.756671447565435e-16, 1.8548009652517703e-16, 1.0835631639336673e-16,
 4.3782055326370285e-30, 1.5421083606106066e-16, 6.402241759189162e-17, 3.35453546128264e-17,
 3.989533257962199e-31, 9.721581857867069e-31, 5.623066807116927e-16, 7.682421393378036e-17,
 -1.0463789310556505e-16, -1.1093497223085107e-15, -2.3059970674002826e-16, 0.11000000000000015};
static const real V_P[6] =
{0.0, 0.0, 0.0, 0.0, 0.0, 0.0};
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

/* States of the self-test: interior, interior, interior, at bounds, at bounds, at bounds, infeasible, infeasible, infeasible. */
#define EXAMPLES 9
static const int EXAMPLE_CODE[] = {0, 0, 0, 0, 0, 0, 2, 2, 2};
static const real EXAMPLE_P[9][6] =
{
{-0.3752915997782384, 0.20298809445322763, 1.5046382808938004, -0.5315244675804176,
 -0.2469387185921909, 1.0},
{-0.6350523034763076, 1.297160499252057, -0.647070852810766, 0.010611148384153904,
 -0.23725360387223293, 1.0},
{-0.1457243559979515, -0.31295363037753965, -0.7089744401903846, -0.7045328424838148,
 -0.2065419703285488, 1.0},
{-0.032352172420488524, -0.777637779913171, -2.9564426003066533, -0.32520588895488306,
 0.35905449505498216, 1.0},
{-0.9347528370612405, 0.17138331669026466, -2.225941259875358, 0.6422873442630139,
 -0.029942097210745276, 1.0},
{1.0262196823351186, 0.805590084438919, 22.479552663835076, -0.3261161600252159,
 0.26848715994985595, 1.0},
{-2.4408610852191615, -12.304491664118176, -21.99421478143151, 1.4137311105990666,
 -0.1749818071695718, 1.0},
{-0.7405134408258129, -5.865595502901587, -2.0866080631592685, -0.004894236733493501,
 -0.6914599296949078, 1.0},
{1.1007731114113397, 3.792101714707113, 6.929792185892052, 0.7050311959355671,
 -0.32553379172311325, 1.0}};
static const real EXAMPLE_U[9][1] =
{
{1.0345756108494186},
{-0.08762724279022925},
{0.050058254521802334},
{-0.7827273156361875},
{0.20334759743556022},
{0.731512840050144},
{0.0},
{0.0},
{0.0}};
static const real EXAMPLE_VALUE[9] =
{0.49486898822818814, 0.8803735965573709, 0.3040022324882154, 0.9639194820197339,
 3.4693104324118726, 52.99423265189059, 0.0, 0.0, 0.0};
static const real NEAR_U[1] =
{1.2011714490131027e-06};
static const real NEAR_VALUE[9] =
{9.830761947887224e-08, 9.830761947887224e-08, 9.830761947887224e-08, 9.830761947887224e-08,
 9.830761947887224e-08, 5.29942326518906e-07, 9.830761947887224e-08, 9.830761947887224e-08,
 9.830761947887224e-08};

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
