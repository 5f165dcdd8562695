"""The tables: multipliers move rows and actions as they say, and bad costs are refused."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from tests.exported import SCHEMES, draw_known, random_qp
from torch_qpmpc import QPMPC, QPError, solve_qp
from torch_qpmpc.export.tables import make_tables


@pytest.mark.parametrize("name", ["point mass", "house", "tied", "rates"])
def test_the_value_and_action_without_rows_are_those_of_the_equalities(name):
    mpc = SCHEMES[name]()
    tables = make_tables(mpc)
    qp = mpc.quadratic_program()
    rows = {name: getattr(qp, name).detach()[:0] for name in ("G", "lb", "ub", "w")}
    without = dataclasses.replace(qp, **rows, check_values=False, n_known=0)
    p = draw_known(mpc, 20)
    with torch.no_grad():
        solution = solve_qp(without, torch.as_tensor(p))
    value = np.einsum("bi,ij,bj->b", p, tables.P, p) / 2 + p @ tables.g + tables.c
    np.testing.assert_allclose(value, solution.value, rtol=1e-7, atol=1e-7)
    u = solution.z[:, mpc.n_p : mpc.n_p + mpc.n_u]
    np.testing.assert_allclose(p @ tables.K.T + tables.k, u, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_rows_have_unit_norm_and_depend_on_the_variables_only(seed):
    tables = make_tables(random_qp(seed))
    np.testing.assert_allclose(np.diag(tables.Q), 1, rtol=1e-12)
    np.testing.assert_allclose(tables.Q, tables.R @ tables.R.T, atol=1e-12)
    assert (tables.rows.lower <= tables.rows.upper).all()
    assert (tables.rows.w > 0).all()


def test_a_cost_that_is_singular_on_the_plan_is_refused():
    mpc = QPMPC.of(1, 2, 3, B=[[1.0, 1.0]], stage_weight=[1.0, 0.0, 0.0])
    match = r"H: got eigenvalues from .*, expected a cost that is positive definite.*Add a small"
    with pytest.raises(QPError, match=match):
        make_tables(mpc)


@pytest.mark.parametrize("part", ["q", "C", "b", "lb"])
def test_a_theta_with_nan_is_refused(part):
    mpc = QPMPC.of(1, 1, 2, stage_weight=[1.0, 1.0])
    with torch.no_grad():
        getattr(mpc, part).fill_(torch.nan)
    match = f"{part}: got NaN or inf, expected a finite theta. Export a theta that mpc.value"
    with pytest.raises(QPError, match=match):
        make_tables(mpc)


def test_crossed_bounds_are_refused():
    mpc = QPMPC.of(1, 1, 2, stage_weight=[1.0, 1.0], action_bounds=([-1.0], [1.0]))
    mpc.lb[1] = 2.0
    with pytest.raises(QPError, match="lb: got entries above ub, expected lb <= ub in every row"):
        make_tables(mpc)


def test_the_action_bounds_are_those_of_hard_rows_with_one_action():
    tables = make_tables(SCHEMES["rates"]())
    np.testing.assert_array_equal(tables.u_lower, [-1])
    np.testing.assert_array_equal(tables.u_upper, [1])
    soft = QPMPC.of(
        1, 1, 2, stage_weight=[1.0, 1.0], action_bounds=([-1.0], [1.0]), action_slack=2.0
    )
    np.testing.assert_array_equal(make_tables(soft).u_upper, [np.inf])
