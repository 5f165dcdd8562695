"""DAQP's order of a batch."""

from __future__ import annotations

import numpy as np
import pytest

from tests.problems import random_states
from torch_qpmpc.qp.solvers.daqp import tour


@pytest.mark.parametrize("near", [40, 8])
def test_a_tour_goes_from_neighbour_to_neighbour(near):
    vectors = random_states(40, 3, seed=1).numpy()
    order = tour(vectors, near)
    scaled = (vectors - vectors.mean(0)) / vectors.std(0)

    def length(order):
        return np.linalg.norm(np.diff(scaled[order], axis=0), axis=1).sum()

    assert sorted(order) == list(range(40))
    assert length(order) < 0.7 * length(np.arange(40))
    if near == 40:
        left, at = set(range(1, 40)), 0
        for k in order[1:]:
            assert k == min(left, key=lambda j: np.linalg.norm(scaled[j] - scaled[at]))
            left, at = left - {k}, k


@pytest.mark.parametrize("vectors", [np.zeros((0, 3)), np.zeros((4, 0)), np.full((5, 2), np.nan)])
def test_a_tour_visits_each_of_any_vectors_once(vectors):
    for near in (2, 40):
        assert sorted(tour(vectors, near)) == list(range(len(vectors)))
