/* @HEADER@ */
#include "policy.h"

typedef policy_real real;

/* Rows of coefficients of s and a constant. CHILD has two entries for each node: the next node, or
   -1 - i for the law i. */
/* @TABLES@ */

static real dot(const real *row, const real *s)
{
    real sum = 0;
    int i;
    for (i = 0; i < POLICY_N_S; i++) sum += row[i] * s[i];
    return sum;
}

int policy_action(const policy_real s[], policy_real u[])
{
    int i, at = @ROOT@, code = POLICY_INSIDE;
    for (i = 0; i < POLICY_FACETS; i++)
        if (!(dot(WITHIN[i], s) <= WITHIN[i][POLICY_N_S])) code = POLICY_OUTSIDE;
    while (at >= 0) at = CHILD[2 * at + (dot(PLANE[at], s) > PLANE[at][POLICY_N_S])];
    for (i = 0; i < POLICY_N_U; i++) {
        const real *law = LAW[(-1 - at) * POLICY_N_U + i];
        u[i] = dot(law, s) + law[POLICY_N_S];
    }
    return code;
}
