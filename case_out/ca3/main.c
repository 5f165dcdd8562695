/* The closed loop of the controller with a plant: its model, at rest until a load comes. Put yours
   in place of it.

   Each line has the step, the outputs, the inputs and the code of policy_step. */
#include <stdio.h>
#include "policy.h"

#if POLICY_N_X != 3 || POLICY_N_U != 1 || POLICY_N_Y != 1 || POLICY_N_D != 1 || POLICY_STAGES != 9 || POLICY_SET_POINTS != 1
#error "main.c was written for another controller: delete it and export again"
#endif

typedef policy_real real;

enum { STEPS = 200 };
static const real A[3][3] =
{
{0.7722167484342909, 0.020904942336288944, -0.028388480306396492},
{-0.022632464605522293, 0.8892201418455117, -0.10099930645736255},
{-0.011596618882209475, -0.04326065381374709, 1.0661499758322441}};
static const real B[3][1] =
{
{0.22578661322792176},
{-0.3526307943415954},
{-0.2812874181513504}};
static const real C[1][3] =
{
{-0.6680463461089501, -1.0551505512051214, -0.39080097723465473}};
static const real LOAD[3] =
{0.02257866132279218, -0.03526307943415954, -0.02812874181513504};
static const real R[1] =
{0.49999999999999994};
static const real KNOWN[9] =
{0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0};
static const real START_X[3] =
{0.0, 0.0, 0.0};
static const real START_U[1] =
{0.0};

int main(void)
{
    static policy_state state;
    real x[POLICY_N_X], next[POLICY_N_X], y[POLICY_N_Y], u[POLICY_N_U];
    int i, j, k, code = policy_selftest();
    if (code) fprintf(stderr, "self-test: number %d fails\n", code);
    policy_reset(&state, 0, START_U, 0);
    for (i = 0; i < POLICY_N_X; i++) x[i] = START_X[i];
    for (k = 0; k < STEPS && !code; k++) {
        for (i = 0; i < POLICY_N_Y; i++)
            for (y[i] = 0, j = 0; j < POLICY_N_X; j++) y[i] += C[i][j] * x[j];
        code = policy_step(&state, y, R, KNOWN, u);
        printf("%d", k);
        for (i = 0; i < POLICY_N_Y; i++) printf(" %.6g", y[i]);
        for (i = 0; i < POLICY_N_U; i++) printf(" %.6g", u[i]);
        printf(" %d\n", code);
        for (i = 0; i < POLICY_N_X; i++) {
            next[i] = LOAD[i];
            for (j = 0; j < POLICY_N_X; j++) next[i] += A[i][j] * x[j];
            for (j = 0; j < POLICY_N_U; j++) next[i] += B[i][j] * u[j];
        }
        for (i = 0; i < POLICY_N_X; i++) x[i] = next[i];
    }
    return code;
}
