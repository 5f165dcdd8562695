/* policy_plan: the policy and value of a quadratic program, by torch_qpmpc 0.1.0 on 2026-11-27.
   SHA-256 of H, q, c, C, b, G, lb, ub, w: 01d8dd2d1c440d3cd6a5942403bf620434200db609943d2f410fbc784a6679c8
   
   p[0 .. 5]: x_0
   u[0]: u_0 */
#ifndef POLICY_PLAN_H
#define POLICY_PLAN_H

#ifdef __cplusplus
extern "C" {
#endif

typedef double policy_plan_real;

/* The size of p and u, and of the state's arrays. */
#define POLICY_PLAN_N_P 6
#define POLICY_PLAN_N_U 1
#define POLICY_PLAN_ROWS 19
#define POLICY_PLAN_ROWS_ 19
#define POLICY_PLAN_KNOWN 2
#define POLICY_PLAN_D 10
#define POLICY_PLAN_HELD 10
#define POLICY_PLAN_HELD_ 10
#define POLICY_PLAN_TRIANGLE 55
#define POLICY_PLAN_FACTORED 0
#define POLICY_PLAN_WORK 0

/* What policy_plan_step returns. */
#define POLICY_PLAN_SOLVED 0     /* u is optimal, and certified to be */
#define POLICY_PLAN_LIMIT 1      /* not certified within the limit of iterations */
#define POLICY_PLAN_INFEASIBLE 2 /* no plan satisfies the hard rows */
#define POLICY_PLAN_INVALID 3    /* p has a NaN, an infinity, or numbers that overflow */

/* The state of a controller: the active set of the last step, where the next one starts. */
typedef struct {
    policy_plan_real lambda[POLICY_PLAN_ROWS_];          /* multipliers of the rows */
    policy_plan_real lower[POLICY_PLAN_TRIANGLE];        /* L of the factor L D L' of Q on the held rows */
    policy_plan_real diagonal[POLICY_PLAN_HELD_];        /* D */
    policy_plan_real u[POLICY_PLAN_N_U];                 /* the last action */
    policy_plan_real y_free[POLICY_PLAN_ROWS_];          /* rows without multipliers */
    policy_plan_real y[POLICY_PLAN_ROWS_];               /* rows with the multipliers before[] */
    policy_plan_real before[POLICY_PLAN_ROWS_];
    policy_plan_real size[POLICY_PLAN_ROWS_];            /* size of the terms of a row */
    policy_plan_real work[2 * POLICY_PLAN_HELD_ + POLICY_PLAN_WORK];
    int held[POLICY_PLAN_HELD_];                    /* rows held at a bound, in the order of the factor */
    int n_held;
    signed char kind[POLICY_PLAN_ROWS_];            /* see policy_plan.c */
} policy_plan_state;

typedef struct {
    policy_plan_real value;     /* cost to go, c included */
    policy_plan_real gap;       /* bound on value minus the optimal value */
    policy_plan_real violation; /* largest violation of a hard row, in the units of the row */
    int iterations;        /* changes of the active set */
} policy_plan_info;

/* Forget the last active set; call it before the first step. */
void policy_plan_reset(policy_plan_state *state);

/* Write the action u for what is known, p; return one of the codes above.

   u is always written, within the action bounds: the optimal action if the code is 0, that of the
   last iterate with the codes 1 and 2, and with code 3 the last action. info may be a null pointer. */
int policy_plan_step(policy_plan_state *state, const policy_plan_real p[], policy_plan_real u[], policy_plan_info *info);

/* Compare with actions of an exact solver; return 0, or the number of the first state that fails.

   Without an operating system, only one thread at a time may call it. */
int policy_plan_selftest(void);

#ifdef __cplusplus
}
#endif

#endif
