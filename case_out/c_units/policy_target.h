/* policy_target: the policy and value of a quadratic program, by torch_qpmpc 0.1.0 on 2026-11-27.
   SHA-256 of H, q, c, C, b, G, lb, ub, w: afe5402cb38d83c9ce48791a2533fe4fabcf891fa8cc7226b9059460671e0dc8
   
   p[0 .. 4]: x_0
   u[0 .. 1]: u_0 */
#ifndef POLICY_TARGET_H
#define POLICY_TARGET_H

#ifdef __cplusplus
extern "C" {
#endif

typedef double policy_target_real;

/* The size of p and u, and of the state's arrays. */
#define POLICY_TARGET_N_P 5
#define POLICY_TARGET_N_U 2
#define POLICY_TARGET_ROWS 2
#define POLICY_TARGET_ROWS_ 2
#define POLICY_TARGET_KNOWN 0
#define POLICY_TARGET_D 2
#define POLICY_TARGET_HELD 2
#define POLICY_TARGET_HELD_ 2
#define POLICY_TARGET_TRIANGLE 3
#define POLICY_TARGET_FACTORED 0
#define POLICY_TARGET_WORK 0

/* What policy_target_step returns. */
#define POLICY_TARGET_SOLVED 0     /* u is optimal, and certified to be */
#define POLICY_TARGET_LIMIT 1      /* not certified within the limit of iterations */
#define POLICY_TARGET_INFEASIBLE 2 /* no plan satisfies the hard rows */
#define POLICY_TARGET_INVALID 3    /* p has a NaN, an infinity, or numbers that overflow */

/* The state of a controller: the active set of the last step, where the next one starts. */
typedef struct {
    policy_target_real lambda[POLICY_TARGET_ROWS_];          /* multipliers of the rows */
    policy_target_real lower[POLICY_TARGET_TRIANGLE];        /* L of the factor L D L' of Q on the held rows */
    policy_target_real diagonal[POLICY_TARGET_HELD_];        /* D */
    policy_target_real u[POLICY_TARGET_N_U];                 /* the last action */
    policy_target_real y_free[POLICY_TARGET_ROWS_];          /* rows without multipliers */
    policy_target_real y[POLICY_TARGET_ROWS_];               /* rows with the multipliers before[] */
    policy_target_real before[POLICY_TARGET_ROWS_];
    policy_target_real size[POLICY_TARGET_ROWS_];            /* size of the terms of a row */
    policy_target_real work[2 * POLICY_TARGET_HELD_ + POLICY_TARGET_WORK];
    int held[POLICY_TARGET_HELD_];                    /* rows held at a bound, in the order of the factor */
    int n_held;
    signed char kind[POLICY_TARGET_ROWS_];            /* see policy_target.c */
} policy_target_state;

typedef struct {
    policy_target_real value;     /* cost to go, c included */
    policy_target_real gap;       /* bound on value minus the optimal value */
    policy_target_real violation; /* largest violation of a hard row, in the units of the row */
    int iterations;        /* changes of the active set */
} policy_target_info;

/* Forget the last active set; call it before the first step. */
void policy_target_reset(policy_target_state *state);

/* Write the action u for what is known, p; return one of the codes above.

   u is always written, within the action bounds: the optimal action if the code is 0, that of the
   last iterate with the codes 1 and 2, and with code 3 the last action. info may be a null pointer. */
int policy_target_step(policy_target_state *state, const policy_target_real p[], policy_target_real u[], policy_target_info *info);

/* Compare with actions of an exact solver; return 0, or the number of the first state that fails.

   Without an operating system, only one thread at a time may call it. */
int policy_target_selftest(void);

#ifdef __cplusplus
}
#endif

#endif
