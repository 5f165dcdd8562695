"""Polytopes: bounding boxes, vertices, and their errors."""

import numpy as np

from tests.refused import refused
from torch_qpmpc.proofs import Polytope

TRIANGLE = [[-1.0, 0.0], [0.0, -1.0], [1.0, 1.0]], [0.0, 0.0, 1.0]
#: Rows of an unbounded set, which a presolver took for an empty one.
CONE = [[-2.0, 0.0, 0.0], [0.0, -2.0, 0.0], [-2.0, -1.0, 2.0], [1.0, 1.0, -2.0]]


def test_a_triangle_has_its_box_and_vertices():
    triangle = Polytope.of(*TRIANGLE)
    assert np.allclose((triangle.lower, triangle.upper), ([0, 0], [1, 1]))
    vertices = triangle.vertices()
    assert sorted(map(tuple, vertices.round(9) + 0.0)) == [(0, 0), (0, 1), (1, 0)]
    assert not triangle.is_box()


def test_a_box_has_all_corners():
    box = Polytope.box([-1.0, 0.0, 2.0], [1.0, 0.5, 2.0])
    assert box.is_box()
    assert {tuple(x) for x in box.vertices()} == {
        (a, b, 2.0) for a in (-1.0, 1.0) for b in (0.0, 0.5)
    }
    fixed = Polytope.box([0.0] * 40 + [-1.0], [0.0] * 40 + [1.0])  # one entry varies
    assert fixed.vertices()[:, -1].tolist() == [-1.0, 1.0]


LINE = [[1.0, 1], [-1, -1], [1, -1], [-1, 1]], [0.0, 0, 1, 1]


@refused(
    (lambda: Polytope.of([1.0], [1.0]), r".*shapes \(1,\) and \(1,\)"),
    (lambda: Polytope.of([[np.nan]], [1.0]), ".*NaN or inf"),
    (lambda: Polytope.of([[1.0], [-1.0]], [0.0, -1.0]), ".*an empty set"),
    (lambda: Polytope.of([[1.0]], [1.0]), ".*an unbounded set"),
    (lambda: Polytope.of(CONE, np.ones(4)), ".*an unbounded set"),
    (lambda: Polytope.box([0.0], [1.0, 2.0]), r".*shapes \(1,\) and \(2,\)"),
    (lambda: Polytope.box([1.0], [0.0]), ".*expected lower <= upper"),
    (lambda: Polytope.box(np.zeros(9), np.ones(9)).vertices(), ".*9 dimensions"),
    (lambda: Polytope.of(*LINE).vertices(), ".*a flat polytope"),
)
def test_errors(make):
    make()
