/* A learned policy as a search tree: affine in each leaf. */
/* @HEADER@ */
#ifndef POLICY_H
#define POLICY_H

#ifdef __cplusplus
extern "C" {
#endif

typedef @REAL@ policy_real;

/* The size of s and u, the nodes of the tree, and the facets of the set of s. */
/* @SIZES@ */

#define POLICY_INSIDE 0
#define POLICY_OUTSIDE 1 /* s is outside the set, or not finite */

/* Write the action u for s; return one of the codes above. u is always written, and outside the set
   it is that of some leaf. */
int policy_action(const policy_real s[], policy_real u[]);

#ifdef __cplusplus
}
#endif

#endif
