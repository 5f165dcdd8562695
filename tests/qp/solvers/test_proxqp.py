import time
from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.testing import assert_array_equal
from torch import Tensor
from torch.testing import assert_close

from tests.benchmarks.problems import PAPER, make_mpc, transitions
from tests.problems import one_sided, soft_qps
from torch_qpmpc import QuadraticProgram, solve_qp
from torch_qpmpc.qp.solvers import proxqp


def split(qp: QuadraticProgram) -> QuadraticProgram:
    """Write each soft row as two, with one bound each."""
    soft = qp.w.isfinite()
    none = torch.full_like(qp.w[soft], torch.inf)
    return replace(
        qp,
        G=torch.cat((qp.G, qp.G[soft])),
        lb=torch.cat((qp.lb.masked_fill(soft, -torch.inf), qp.lb[soft])),
        ub=torch.cat((qp.ub, none)),
        w=torch.cat((qp.w, qp.w[soft])),
    )


def seconds(qp: QuadraticProgram, s: Tensor) -> float:
    began = time.process_time()
    solve_qp(qp, s, solver="proxqp")
    return time.process_time() - began


@torch.no_grad()
def test_rows_with_one_bound_take_twice_the_time_of_rows_with_two():
    # With the default initial guess, they take 14 times as long.
    s, two = transitions(4, 2, 16).s, make_mpc(PAPER, dense=True).quadratic_program()
    one = split(two)
    value = solve_qp(two, s, solver="daqp").value
    assert_close(solve_qp(one, s, solver="proxqp").value, value, rtol=1e-6, atol=0)
    solve_qp(two, s, solver="proxqp")
    fastest = np.min([(seconds(one, s), seconds(two, s)) for _ in range(3)], axis=0)
    assert fastest[0] < 6 * fastest[1]


@pytest.mark.usefixtures("two_threads")
def test_rows_with_one_bound_start_alike_on_all_threads():
    qps, _ = soft_qps(one_sided(16))
    two = proxqp.solve(qps)
    torch.set_num_threads(1)
    for x, y in zip(two, proxqp.solve(qps), strict=True):
        assert_array_equal(x, y)
