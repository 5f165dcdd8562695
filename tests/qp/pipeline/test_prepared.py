import numpy as np

from tests.problems import known_qp, normal
from torch_qpmpc.qp.pipeline.batch import LATEST, Prepared, Programs, Theta
from torch_qpmpc.qp.pipeline.scaling import Units


def test_a_theta_that_the_batch_shares_is_prepared_once():
    theta, fixed = known_qp(0).qp.tensors(), normal(5, 2)
    one = Programs.of(*theta, fixed)[0].prepared
    assert Programs.of(*(x.clone() for x in theta), fixed[:2])[0].prepared is one
    assert Programs.of(*theta, fixed, n_kept=4)[0].prepared is not one
    assert Programs.of(*known_qp(1).qp.tensors(), fixed)[0].prepared is not one
    assert Programs.of(*theta, fixed)[0].prepared is one


def test_other_bounds_are_in_the_same_units_even_if_those_are_far_from_one():
    rng = np.random.default_rng(0)
    H = np.diag(10.0 ** rng.uniform(-12, 12, 4))[None]
    shapes = (1, 1, 4), (1, 2, 4)
    C, G = (rng.normal(size=x) * 10.0 ** rng.uniform(-12, 12, x) for x in shapes)
    lb, ub, far, q = -np.full((1, 2), 1e-3), np.ones((1, 2)), np.full((1, 1), 1e5), np.ones((1, 4))
    theta = Theta(H, C, G, q, np.zeros(1), far, lb, ub, np.full((1, 2), np.inf))
    prepared = Prepared(theta, np.zeros(1, np.int64), 1)
    assert Units.of(prepared.scaled.theta, prepared.group) is not None
    assert prepared.units is not None
    other = prepared.bounded(2 * lb, 3 * ub)
    assert other.units is prepared.units
    for own, new in zip(prepared.scaled.theta[-3:-1], other.scaled.theta[-3:-1], strict=True):
        assert np.array_equal(new, own * (2 if own.max() < 0 else 3))


def test_only_the_latest_are_remembered():
    fixed = normal(5, 2)
    known = [known_qp(100 + i).qp.tensors() for i in range(LATEST + 1)]
    prepared = [Programs.of(*theta, fixed)[0].prepared for theta in known]
    assert Programs.of(*known[-1], fixed)[0].prepared is prepared[-1]
    assert Programs.of(*known[0], fixed)[0].prepared is not prepared[0]
