/* @HEADER@ */
#ifndef POLICY_H
#define POLICY_H

#ifdef __cplusplus
extern "C" {
#endif

typedef @REAL@ policy_real;

/* The size of p and u, and of the state's arrays. */
/* @SIZES@ */

/* What policy_step returns. */
#define POLICY_SOLVED 0     /* u is optimal, and certified to be */
#define POLICY_LIMIT 1      /* not certified within the limit of iterations */
#define POLICY_INFEASIBLE 2 /* no plan satisfies the hard rows */
#define POLICY_INVALID 3    /* p has a NaN, an infinity, or numbers that overflow */
#define POLICY_NODE_LIMIT 5 /* the best plan on levels of POLICY_NODES; a better one may exist */

/* The state of a controller: the active set of the last step, where the next one starts. */
typedef struct {
    policy_real lambda[POLICY_ROWS_];          /* multipliers of the rows */
    policy_real lower[POLICY_TRIANGLE];        /* L of the factor L D L' of Q on the held rows */
    policy_real diagonal[POLICY_HELD_];        /* D */
    policy_real u[POLICY_N_U];                 /* the last action */
    policy_real y_free[POLICY_ROWS_];          /* rows without multipliers */
    policy_real y[POLICY_ROWS_];               /* rows with the multipliers before[] */
    policy_real before[POLICY_ROWS_];
    policy_real size[POLICY_ROWS_];            /* size of the terms of a row */
    policy_real work[2 * POLICY_HELD_];
    int held[POLICY_HELD_];                    /* rows held at a bound, in the order of the factor */
    int n_held;
    signed char kind[POLICY_ROWS_];            /* see policy.c */
#if POLICY_LEVELS
    policy_real low[POLICY_ROWS_], high[POLICY_ROWS_], cost, cutoff; /* of a node: bounds, cost */
    policy_real ahead[POLICY_DECIDED + 1][POLICY_RUNS], bounds[POLICY_DEPTH], best[POLICY_ROWS_];
    int at[POLICY_DEPTH], runs[POLICY_N_U]; /* runs: steps on, or minus steps off, before the next step */
    signed char cut[POLICY_DEPTH], above[POLICY_DEPTH], open[POLICY_DEPTH]; /* the branch of a node */
    signed char first[POLICY_DECISIONS], last[POLICY_DECISIONS];            /* what it leaves */
    signed char pattern[POLICY_DECISIONS];
    signed char plan[POLICY_DECISIONS], hint[POLICY_DECISIONS]; /* the best plan, and a try; levels */
#endif
} policy_state;

typedef struct {
    policy_real value;     /* cost to go, c included */
    policy_real gap;       /* bound on value minus the optimal value, up to rounding */
    policy_real violation; /* largest violation of a hard row, in the units of the row */
    int iterations;        /* changes of the active set */
} policy_info;

/* Forget the last active set; call it before the first step. */
void policy_reset(policy_state *state);

/* Write the action u for what is known, p; return one of the codes above.

   u is always written, within the action bounds: the optimal action if the code is 0, that of the
   best plan found with code 5, of the last iterate with the codes 1 and 2, and with code 3 the last
   action. info may be a null pointer. Minimum times count from the state's runs, which are 0 after
   a reset: unknown. Set them. */
int policy_step(policy_state *state, const policy_real p[], policy_real u[], policy_info *info);

/* Compare with actions of an exact solver; return 0, or the number of the first state that fails.

   Without an operating system, only one thread at a time may call it. */
int policy_selftest(void);

#ifdef __cplusplus
}
#endif

#endif
