/* What Python calls, beside the exported functions. */
#include "policy.h"

#ifdef __cplusplus
extern "C" {
#endif

unsigned long policy_state_size(void) { return (unsigned long)sizeof(policy_state); }

void policy_steps(policy_state *states, const policy_real *p, policy_real *u, policy_info *info,
                  int *codes, long count)
{
    long i;
    for (i = 0; i < count; i++)
        codes[i] = policy_step(states + i, p + i * POLICY_N_P, u + i * POLICY_N_U, info + i);
}

void policy_resets(policy_state *states, long count)
{
    long i;
    for (i = 0; i < count; i++) policy_reset(states + i);
}

#ifdef __cplusplus
}
#endif
