"""DAQP, the fast path: a dual active-set solver with soft constraints of its own, no slacks."""

from __future__ import annotations

import daqp
import numpy as np

from torch_qpmpc.qp.kernels import per_sample
from torch_qpmpc.qp.pipeline.batch import SoftArrays, SoftQPs
from torch_qpmpc.qp.solvers.base import Answer

#: Of a row's ``sense``.
SOFT = 8
#: From how many QPs on a neighbour's active set saves DAQP a third to a half of its iterations.
MANY = 16
#: Among how many QPs the next one is looked for.
NEAR = 256
#: DAQP's reciprocal quadratic slack weight; 1e4 to 1e8 are right to 1e-7, outside it errs.
RECIPROCAL_RHO = 1e6
#: DAQP's infinity.
NO_BOUND = 1e30
SETTINGS = {"primal_tol": 1e-9, "dual_tol": 1e-12, "iter_limit": 2000, "time_limit": 0.2}


def solve(qps: SoftQPs) -> Answer:
    """Solve a batch; of a large one, each QP from the active set of one much like it."""
    arrays = qps.arrays
    kinds = _alike(arrays)
    if len(kinds) == 1:
        return Answer.on(qps.device, *_solve_alike(arrays))
    v, lam = np.zeros_like(arrays.g), np.zeros_like(arrays.l)
    iterations = np.zeros(len(v), dtype=np.int64)
    for i in kinds:
        part = SoftArrays(arrays.H, arrays.G, *(vectors[i] for vectors in arrays[2:]))
        v[i], lam[i], iterations[i] = _solve_alike(part)
    return Answer.on(qps.device, v, lam, iterations)


def _alike(arrays: SoftArrays) -> list[np.ndarray]:
    """The indices of QPs that share their matrices and their pattern of hard rows."""
    group, hard = arrays.group, np.isinf(_distinct(arrays.w))
    if len(arrays.H) == 1 and len(group) and (hard == hard[0]).all():
        return [np.arange(len(group))]
    hard = np.broadcast_to(hard, arrays.w.shape)
    kinds: dict[tuple, list[int]] = {}
    for i, (m, pattern) in enumerate(zip(group, hard, strict=True)):
        kinds.setdefault((m, pattern.tobytes()), []).append(i)
    return [np.array(members) for members in kinds.values()]


def _distinct(vectors: np.ndarray) -> np.ndarray:
    """One row where it is repeated for the batch, without a copy."""
    return vectors[:1] if vectors.strides[0] == 0 else vectors


def _solve_alike(arrays: SoftArrays) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """v, lam and iterations by one model; with another pattern of soft rows, it corrupts memory."""
    _, _, (m, *_), g, lower, upper, w = arrays
    v, lam = np.zeros(g.shape), np.zeros(lower.shape)
    iterations = np.zeros(len(g), dtype=np.int64)
    upper, lower = np.minimum(upper, NO_BOUND), np.maximum(lower, -NO_BOUND)
    # A row that may be violated for nothing is no row; DAQP would hold it with its small rho.
    w = _distinct(w)
    hard = np.isinf(w[0])
    if not w.all():
        free = np.broadcast_to(w == 0, upper.shape)
        upper[free], lower[free] = NO_BOUND, -NO_BOUND
    weight = np.where(hard, 0.0, w)
    same_weight = (weight == weight[0]).all()
    empty = np.where(hard, 0, SOFT).astype(np.int32)
    rho = np.full(len(hard), RECIPROCAL_RHO)
    model = daqp.Model()
    flag, _ = model.setup(arrays.H[m], g[0], arrays.G[m], upper[0], lower[0], empty.copy())
    if flag < 0:
        return v, lam, iterations  # zeros, which do not pass the certificate
    model.settings = SETTINGS
    if len(hard):  # soft_weights refuses empty arrays
        model.soft_weights(rho_l=rho, rho_u=rho, w_l=weight[0], w_u=weight[0])
    many = len(g) >= MANY
    update, solve_one, failed = model.update, model.solve, False
    for k in per_sample.tour(g, NEAR).tolist() if many else range(len(g)):
        # Without a ``sense``, the model begins with the active set that it ended with.
        sense = None if many and not failed else empty
        if not len(hard):
            update(f=g[k])
        else:
            update(f=g[k], bupper=upper[k], blower=lower[k], sense=sense)
        if not same_weight:
            model.soft_weights(rho_l=rho, rho_u=rho, w_l=weight[k], w_u=weight[k])
        v[k], _, flag, info = solve_one()
        lam[k], iterations[k] = info["lam"], info["iterations"]
        failed = flag <= 0
    return v, lam, iterations
