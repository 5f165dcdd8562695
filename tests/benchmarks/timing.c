/* Time each step of an exported policy; compiled by tests/benchmarks/export.py. */
#define _POSIX_C_SOURCE 199309L
#include <time.h>

#include "policy.h"

static double now(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return 1e9 * (double)t.tv_sec + (double)t.tv_nsec;
}

/* Step one controller through `count` p; cold forgets the active set before each step. */
void policy_timed(policy_state *state, const policy_real *p, policy_real *u, long count, int cold,
                  double *nanoseconds, int *codes, int *iterations)
{
    long i;
    policy_info info;
    policy_reset(state);
    for (i = 0; i < count; i++) {
        double start;
        if (cold) policy_reset(state);
        start = now();
        codes[i] = policy_step(state, p + i * POLICY_N_P, u + i * POLICY_N_U, &info);
        nanoseconds[i] = now() - start;
        iterations[i] = info.iterations;
    }
}
