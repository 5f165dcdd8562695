import numpy as np
import pytest

from torch_qpmpc.qp.kernels.active_set import solve


@pytest.mark.parametrize("last", [1.0, np.inf])
def test_rows_without_a_solution_are_seen_whatever_bounds_the_last_has(last):
    """y_0 = y_1 cannot be below -1 and above 1; the last row's nearer bound stood for theirs."""
    K = np.array([[1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    low, high = np.array([-np.inf, 1.0, -last]), np.array([-1.0, np.inf, last])
    lam, y, x = np.zeros((3, 3))
    side, held = np.zeros(3, np.int64), np.zeros(3, np.int64)
    w, factor = np.full(3, np.inf), np.zeros((3, 3))
    n, cost, _ = solve(K, 0 * y, low, high, w, lam, y, side, held, 0, factor, x, np.inf)
    assert n <= 1
    assert cost == np.inf
