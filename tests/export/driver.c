/* Run the self-test, then step through the p of a binary file, and write code, value and u. */
#include <stdio.h>

#include "policy.h"

int main(int count, char **names)
{
    static policy_state state;
    static policy_real p[POLICY_N_P], u[POLICY_N_U];
    policy_info info;
    FILE *file;
    int failed = policy_selftest(), i;
    if (failed) return failed;
    if (count < 2) return 0;
    file = fopen(names[1], "rb");
    if (!file) return 100;
    policy_reset(&state);
    while (fread(p, sizeof(policy_real), POLICY_N_P, file) == POLICY_N_P) {
        int code = policy_step(&state, p, u, &info);
        printf("%d %.17g", code, (double)info.value);
        for (i = 0; i < POLICY_N_U; i++) printf(" %.17g", (double)u[i]);
        printf("\n");
    }
    fclose(file);
    return 0;
}
