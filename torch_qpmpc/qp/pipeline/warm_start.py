"""The warm start of every solver: the active set of a nearly equal QP, tried for a whole batch.

Between two visits to a transition theta changes little, and most active sets stay the same. With a
fixed set, the KKT conditions are linear in its multipliers, and need one Cholesky factor per QP, of
the active part of K = G H^-1 G'. If the signs of the solution contradict the set, the rows
concerned change their state, and the new set is tried. QPs that do not settle go to the backend;
the certificate judges every result. A QP without a known set starts from the empty one, and usually
settles.
"""

from __future__ import annotations

from torch_qpmpc.qp.pipeline.arrays import Array
from torch_qpmpc.qp.pipeline.batch import Programs
from torch_qpmpc.qp.solvers.base import BackendSolution, SoftQPs


def try_active_sets(p: Programs, qps: SoftQPs, active: Array) -> tuple[BackendSolution, Array]:
    """Solve from active sets ``(B, n_g)``, corrected where needed.

    Codes are those of `QPSolution.active`; a set with any other code starts as the empty one.

    Returns:
        The solutions, and True where an active set settled, ``(B,)``.
    """
    active = active[:, p.prepared.reduced(p.n_f).rows]
    *solution, settled = p.kernels.try_active_sets(qps, p.prepared.forces(p.n_f), active)
    return BackendSolution(*solution), settled
