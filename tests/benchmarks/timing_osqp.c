/* Time each step of OSQP's generated code; compiled by tests/benchmarks/export.py. */
#define _POSIX_C_SOURCE 199309L
#include <time.h>

#include "osqp.h"
#include "workspace.h"

static double now(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return 1e9 * (double)t.tv_sec + (double)t.tv_nsec;
}

void osqp_timed(const double *p, double *lower, double *upper, double *u, double *nanoseconds,
                long count, long n_p, long n_u, int cold)
{
    long i, j;
    for (i = 0; i < count; i++) {
        double start;
        if (cold) osqp_cold_start(&solver);
        start = now();
        for (j = 0; j < n_p; j++) lower[j] = upper[j] = p[i * n_p + j];
        osqp_update_data_vec(&solver, OSQP_NULL, lower, upper);
        osqp_solve(&solver);
        for (j = 0; j < n_u; j++) u[i * n_u + j] = solver.solution->x[n_p + j];
        nanoseconds[i] = now() - start;
    }
}
