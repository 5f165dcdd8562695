/* @HEADER@ */
#ifndef POLICY_H
#define POLICY_H

/* @SIZES@ */

#include "policy_plan.h"
#include "policy_target.h"

#ifdef __cplusplus
extern "C" {
#endif

typedef policy_plan_real policy_real;

/* What policy_step returns. */
#define POLICY_SOLVED 0     /* u is optimal, and certified to be */
#define POLICY_LIMIT 1      /* not certified within the limit of iterations, or to rounding */
#define POLICY_INFEASIBLE 2 /* no plan or no steady state satisfies the hard bounds */
#define POLICY_INVALID 3    /* r or known, or y before there are estimates, has a missing number */
#define POLICY_MISSING 4    /* as POLICY_SOLVED, for estimates that y, with a missing number, left */
#define POLICY_NODE_LIMIT 5 /* the best plan on levels that the search found; a better one may exist */

/* The state of a controller: estimates, the last signals, and the active sets of all QPs. */
typedef struct {
    policy_real e[POLICY_N_E];                   /* the estimates of the state and disturbances */
    policy_real u[POLICY_N_U];                   /* the last input */
    policy_real r[POLICY_SET_POINTS * POLICY_N_Y]; /* the last set-points */
    policy_real known[POLICY_N_D_];              /* the last known signals */
    policy_real x_s[POLICY_N_X];                 /* the target: state, input and outputs */
    policy_real u_s[POLICY_N_U];
    policy_real y_s[POLICY_N_Y];
    policy_real end[POLICY_N_Y];                /* the set-points of the terminal cost */
    policy_real p[POLICY_PLAN_N_P];              /* what the plan's QP knows */
    policy_plan_state plan;
    policy_target_state target;
#if POLICY_CARRIES
    policy_real P[POLICY_N_E][POLICY_N_E];       /* the covariance of e that is left after a missing output */
    int carried;                                 /* 1 while it is not the steady state's */
#endif
    int steps;                                   /* the place of the next gain; negative before a start */
} policy_state;

/* A number is missing if it is not finite, or above MOST_Y, MOST_KNOWN or MOST_U of policy.c, 1e8
   times a usual size, as a sensor's 3.4e38 for "bad". Python's Controller does the same. */

/* Forget the past: the plant rests with the outputs y, the input u and the known signals of this
   step, of which there are POLICY_N_D. If one of y or known is missing, or the pointer is null, it
   is in a state of the log of the model; without a log it rests with those of the first step. A
   missing entry of u is zero. u is clipped into its bounds. Inputs on levels have been on or off for
   longer than their minimum times; what policy_step and policy_observe apply counts from then on.

   u is the last input, which moves are counted from: another than the plant's is a bump. */
void policy_reset(policy_state *state, const policy_real y[], const policy_real u[],
                  const policy_real known[]);

/* Write the input u for measured outputs y; return one of the codes above.

   A missing output, all of them if y is null, leaves the estimates as predicted. If POLICY_CARRIES,
   the gains of the outputs that follow know that it was missing; else they are steady, which is
   right for a few missing outputs, and not for sensors that answer in some steps only. r has
   POLICY_SET_POINTS rows of POLICY_N_Y set-points, of which a null pointer repeats the last ones;
   they start as zero. Outputs without a weight need none. known has POLICY_STAGES rows of POLICY_N_D
   known signals, of this and later steps. With the codes 0, 4 and 5, u keeps the bounds of inputs and
   of their moves to rounding; with another it is the last input, which keeps them, too. The
   estimates go on with each code. */
int policy_step(policy_state *state, const policy_real y[], const policy_real r[],
                const policy_real known[], policy_real u[]);

/* Take note of a step in manual mode: of the outputs y, the input u that was applied, and the known
   signals of this step alone; return POLICY_SOLVED, POLICY_MISSING or POLICY_INVALID.

   The last input stands for a missing u. The next policy_step moves from u, without a bump. */
int policy_observe(policy_state *state, const policy_real y[], const policy_real u[],
                   const policy_real known[]);

/* Test all QPs and replay a closed loop; return 0, or the number of what fails: the plan's QP, one
   of the target's, and the steps of the loop. Only one thread at a time may call it. */
int policy_selftest(void);

#ifdef __cplusplus
}
#endif

#endif
