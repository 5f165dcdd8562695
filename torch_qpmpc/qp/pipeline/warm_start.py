"""The warm start of every solver: the active set of a nearly equal QP, tried for a whole batch.

Between two visits to a transition theta has moved a little, and most active sets have not changed.
With the set held, the KKT conditions are linear in its multipliers: with K = G H^-1 G', one
Cholesky factor of K's active part a QP, and no loop over the batch. Where the signs of the solution
contradict the set, the rows concerned change their state, and it is tried again. QPs that do not
settle go to the backend; the certificate judges every result. A QP of which no set is known starts
from the empty one, and mostly settles from there.
"""

from __future__ import annotations

from torch_qpmpc.qp.pipeline.arrays import Array
from torch_qpmpc.qp.pipeline.batch import Programs, SoftQPs
from torch_qpmpc.qp.solvers.base import BackendSolution


def try_active_sets(p: Programs, qps: SoftQPs, active: Array) -> tuple[BackendSolution, Array]:
    """Solve with active sets ``(B, n_g)``, or with sets near to them.

    Returns:
        The solutions, and True where an active set settled, ``(B,)``. The codes are those of
        `QPSolution.active`; a set with any other code starts as the empty one.
    """
    active = active[:, p.prepared.reduced(p.n_f).rows]
    *found, settled = p.kernels.try_active_sets(qps, p.prepared.forces(p.n_f), active)
    return BackendSolution(*found), settled
