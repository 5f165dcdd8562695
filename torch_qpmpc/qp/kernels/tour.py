"""An order of vectors in which each is near the one before, for warm starts within a batch."""

from __future__ import annotations

import math
from functools import partial

import numpy as np

from torch_qpmpc.qp.kernels.linalg import compiled


def tour(vectors: np.ndarray, near: int) -> np.ndarray:
    """Return an order of vectors ``(B, n)`` in which each is followed by a near one.

    It is a nearest-neighbour tour in units of the entries' standard deviations. Of more than
    ``near`` vectors, each step compares the next ``near`` in the order of their first entry.
    """
    few = len(vectors) <= near or not vectors.shape[1]
    order = np.arange(len(vectors)) if few else vectors[:, 0].argsort()
    _walk(vectors, order, near)
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
