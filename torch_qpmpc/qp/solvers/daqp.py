"""DAQP, the fast backend: a dual active-set solver with built-in soft constraints, no slacks."""

from __future__ import annotations

import math
from functools import partial

import daqp
import numpy as np

from torch_qpmpc.qp.kernels.linalg import compiled
from torch_qpmpc.qp.pipeline.arrays import BackendSolution, SoftQPs
from torch_qpmpc.qp.pipeline.condensing import inverse_factors

#: The code of a soft row in DAQP's ``sense``.
SOFT = 8
#: Smallest batch that is warm-started from neighbours, which saves a third to half of the
#: iterations.
MANY = 16
#: The next QP is the nearest of this many.
NEAR = 256
#: DAQP's reciprocal quadratic slack weight; 1e4 to 1e8 are accurate to 1e-7, others less. A soft
#: row is off its bound by its multiplier over this weight: with 1e6, the certificate rejects QPs
#: with large multipliers narrowly.
RECIPROCAL_RHO = 1e7
#: DAQP's infinity.
NO_BOUND = 1e30
#: A limit of iterations, not of time: the result does not depend on the machine's load.
SETTINGS = {"primal_tol": 1e-9, "dual_tol": 1e-12, "iter_limit": 2000}


def solve(qps: SoftQPs) -> BackendSolution:
    """Solve a batch; in a large one, start each QP from the active set of a similar one."""
    kinds, inverse = _alike(qps), None
    if len(kinds) == 1:
        return _solve_alike(qps)
    solution = BackendSolution(np.zeros_like(qps.g), np.zeros_like(qps.l), np.zeros_like(qps.group))
    if len(qps.H) > 1 and not (factors := inverse_factors(qps.H))[1].any():
        G, inverse = qps.G @ factors[0].swapaxes(1, 2), factors[0][qps.group]
        g = np.einsum("bij,bj->bi", inverse, qps.g)
        qps = qps._replace(H=np.eye(G.shape[2])[None], G=G, g=g)  # whose setup is fast
    for index in kinds:
        solution.put(index, _solve_alike(qps.take(index)))
    v = solution.v if inverse is None else np.einsum("bij,bi->bj", inverse, solution.v)
    return solution._replace(v=v)


def _alike(qps: SoftQPs) -> list[np.ndarray]:
    """Return the indices of QPs grouped by their matrices and their pattern of hard rows."""
    group, hard = qps.group, np.isinf(_distinct(qps.w))
    if len(qps.H) == 1 and len(group) and (hard == hard[0]).all():
        return [np.arange(len(group))]
    hard = np.broadcast_to(hard, qps.w.shape)
    kinds: dict[tuple, list[int]] = {}
    for i, (m, pattern) in enumerate(zip(group, hard, strict=True)):
        kinds.setdefault((m, pattern.tobytes()), []).append(i)
    return [np.array(members) for members in kinds.values()]


def _distinct(vectors: np.ndarray) -> np.ndarray:
    """Return a single row if it is repeated for the batch without a copy."""
    return vectors[:1] if vectors.strides[0] == 0 else vectors


def _solve_alike(qps: SoftQPs) -> BackendSolution:
    """Solve with one model, which another pattern of soft rows would corrupt."""
    H, G, (m, *_), g, lower, upper, w = qps
    v, lam = np.zeros(g.shape), np.zeros(lower.shape)
    iterations = np.zeros(len(g), dtype=np.int64)
    upper, lower = np.minimum(upper, NO_BOUND), np.maximum(lower, -NO_BOUND)
    # A row with zero weight is no constraint, but DAQP would hold it with its small rho.
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
    flag, _ = model.setup(H[m % len(H)], g[0], G[m], upper[0], lower[0], empty.copy())
    if flag < 0:
        return BackendSolution(v, lam, iterations)  # zeros, which the certificate rejects
    model.settings = SETTINGS
    model.soft_weights(rho_l=rho, rho_u=rho, w_l=weight[0], w_u=weight[0])
    many = len(g) >= MANY
    update, solve_one, failed = model.update, model.solve, False
    for k in tour(g, NEAR).tolist() if many else range(len(g)):
        # Without a ``sense``, the model starts from its last active set.
        sense = None if many and not failed else empty
        update(f=g[k], bupper=upper[k], blower=lower[k], sense=sense)
        if not same_weight:
            model.soft_weights(rho_l=rho, rho_u=rho, w_l=weight[k], w_u=weight[k])
        v[k], _, flag, info = solve_one()
        lam[k], iterations[k] = info["lam"], info["iterations"]
        failed = flag <= 0
    return BackendSolution(v, lam, iterations)


def tour(vectors: np.ndarray, near: int) -> np.ndarray:
    """Return an order of vectors ``(B, n)`` in which each is followed by a near one.

    It is a nearest-neighbour tour in units of the entries' standard deviations. Of more than
    ``near`` vectors, each step compares the next ``near`` in the order of their first entry.
    """
    few = len(vectors) <= near or not vectors.shape[1]
    order = np.arange(len(vectors)) if few else vectors[:, 0].argsort()
    _walk(np.ascontiguousarray(vectors), order, near)
    return order


# Vectorised, with sums in any order; vectors with NaN need no particular order.
@partial(compiled, fastmath={"reassoc", "nsz", "nnan", "contract"})
def _walk(vectors, order, near):
    n_qps, n = vectors.shape
    points, distance = np.empty((n, n_qps), np.float32), np.empty(near, np.float32)
    for k in range(n):
        mean = square = 0.0
        for i in range(n_qps):
            mean += vectors[i, k] / n_qps
        for i in range(n_qps):
            square += (vectors[i, k] - mean) ** 2 / n_qps
        for i in range(n_qps):
            points[k, i] = (vectors[order[i], k] - mean) / (
                math.sqrt(square) if square > 0 else 1.0
            )
    for at in range(n_qps - 1):
        left, nearest = min(near, n_qps - 1 - at), 0
        for j in range(left):
            distance[j] = 0.0
        for k in range(n):
            for j in range(left):
                distance[j] += (points[k, at + 1 + j] - points[k, at]) ** 2
        for j in range(left):
            nearest = j if distance[j] < distance[nearest] else nearest
        nearest += at + 1
        order[at + 1], order[nearest] = order[nearest], order[at + 1]
        for k in range(n):
            points[k, at + 1], points[k, nearest] = points[k, nearest], points[k, at + 1]
