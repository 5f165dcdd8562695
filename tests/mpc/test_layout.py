"""The QP's cost of theta (eq:qpH), with its discounts; sizes; and blocks of equal actions."""

from typing import Any

import cvxpy
import numpy as np
import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from tests.problems import random_mpc, random_states
from tests.refused import refused
from torch_qpmpc import QPMPC, Layout, QPError
from torch_qpmpc.export.tables import make_tables
from torch_qpmpc.mpc.layout import band_distance, banded_matrix

# Sizes


@refused(
    ({"n_x": 0}, "n_x: got 0, expected a whole number >= 1"),
    ({"horizon": "3"}, "horizon: got '3', expected a whole number >= 1"),
    ({"n_d": -1}, "n_d: got -1, expected a whole number >= 0"),
    ({"blocks": 3}, "blocks: got 3, expected whole numbers >= 1 with the horizon 3 as their"),
    ({"blocks": [1, 1]}, r"blocks: got \[1, 1\], .* sum\. The last one may hold its actions"),
    ({"blocks": [1.5, 1.5]}, r"blocks: got \[1.5, 1.5\], expected whole numbers >= 1"),
)
def test_bad_sizes_are_named(sizes):
    Layout(**({"n_x": 2, "n_u": 1, "horizon": 3} | sizes))


# The band


def test_band_distance_counts_stages():
    expected = torch.tensor(
        [
            # x_0, u_0, x_1, u_1, x_2, u_2, x_3
            [0, 0, 0, 1, 1, 2, 2],
            [-1, -1, 0, 0, 0, 1, 1],
            [-2, -2, -1, -1, 0, 0, 0],
        ]
    )
    assert torch.equal(band_distance(Layout(1, 1, 3)), expected)
    blocks = expected.repeat_interleave(4, 0).repeat_interleave(torch.tensor([4, 2] * 3 + [4]), 1)
    assert torch.equal(band_distance(Layout(4, 2, 3)), blocks)


@refused(
    ((2, 3), (3, 2), r"A: got shape \(2, 3\), expected shape \(2, 2\) or \(4, 2, 2\)"),
    ((5, 3, 3), (3, 2), r"A: got shape \(5, 3, 3\), expected shape \(3, 3\) or \(4, 3, 3\)"),
    ((3, 3), (2, 2), r"B: got shape \(2, 2\), expected shape \(3, 2\) or \(4, 3, 2\)"),
    ((3, 3), (5, 3, 2), r"B: got shape \(5, 3, 2\), expected shape \(3, 2\) or \(4, 3, 2\)"),
)
def test_a_model_that_does_not_fit_is_named(A, B):
    banded_matrix(torch.ones(A), torch.ones(B), 4)


# Blocks


def blocked(blocks: list[int], **options: Any) -> QPMPC:
    """Make a QPMPC of four stages with hard rows of actions and of D."""
    rows = ([[0.0, 0.0, 1.0], [1.0, 0.0, 1.0]], [-0.4, -1.5], [0.3, 1.5])
    settings: dict[str, Any] = {
        "constraints": rows,
        "constraint_slack": [torch.inf, 5.0],
        "learn": ["H", "q", "C", "b", "lb", "ub", "w"],
        "structure": "tied",
    }
    return random_mpc(3, free=0.02, horizon=4, blocks=blocks, **{**settings, **options})


def dense(mpc: QPMPC, s: Tensor, held: list[int]) -> tuple[float, np.ndarray]:
    """Solve the QP of a QPMPC without blocks, and with u_k = u_{k-1} for k in ``held``."""
    H, q, c, C, b, G, lb, ub, w = (x.detach().numpy() for x in mpc.quadratic_program().tensors())
    z, soft = cvxpy.Variable(len(q)), np.isfinite(w)
    excess = cvxpy.maximum(G @ z - np.minimum(ub, 1e3), np.maximum(lb, -1e3) - G @ z, 0)
    cost = cvxpy.quad_form(z, cvxpy.psd_wrap(H)) / 2 + q @ z + c + w[soft] @ excess[soft]
    u = [mpc.n_p + 3 * k for k in range(4)]
    rows = [C @ z == b, z[: mpc.n_p] == s.numpy(), excess[~soft] <= 0]
    rows += [z[u[k]] == z[u[k - 1]] for k in held]
    problem = cvxpy.Problem(cvxpy.Minimize(cost), rows)
    problem.solve(solver="CLARABEL", tol_gap_rel=1e-12, tol_gap_abs=1e-12, tol_feas=1e-12)
    return np.asarray(cost.value).item(), z.value[u]


@pytest.mark.parametrize(
    ("blocks", "held"), [([1, 3], [2, 3]), ([2, 1, 1], [1]), ([4], [1, 2, 3]), ([1] * 4, [])]
)
def test_the_plan_of_blocks_is_that_of_equal_actions(blocks, held):
    mpc, free = blocked(blocks), blocked([])
    for s in random_states(6):
        value, u = dense(free, s, held)
        solution = mpc.solve(s)
        assert abs(solution.value.item() - value) < 1e-6 * (1 + abs(value))
        assert np.allclose(mpc.predicted(solution.z)[1].detach()[:, 0], u, atol=1e-5)


@pytest.mark.parametrize("row", [3, 10], ids=["u_1", "D in stage 1"])
def test_a_hard_bound_of_one_stage_binds_its_block(row):
    mpc = QPMPC.of(
        1,
        1,
        4,
        A=[[1.2]],
        B=[[1.0]],
        stage_weight=[1.0, 0.01],
        action_bounds=([-1.0], [1.0]),
        constraints=([[0.0, 1.0]], [-2.0], [2.0]),
        constraint_slack=torch.inf,
        blocks=[2, 2],
    )
    lb = mpc.lb.clone()
    lb[row] = -0.3
    mpc.lb = lb
    u = mpc.predicted(mpc.solve(torch.tensor([9.0])).z)[1].squeeze(-1)
    assert_close(u, u.new_tensor([-0.3, -0.3, -1.0, -1.0]))


def test_blocks_leave_fewer_variables_and_rows():
    free, held = (make_tables(blocked(blocks)) for blocks in ([], [1, 3]))
    assert (free.R.shape[1], held.R.shape[1]) == (4, 2)
    # Bounds and a row of D for each of two stages.
    assert len(free.Q) - len(held.Q) == 4


def test_residuals_and_copies_keep_blocks(tmp_path):
    mpc, s = blocked([1, 3]), random_states(3)
    mpc.save(tmp_path / "mine.qpmpc")
    twin = QPMPC.load(tmp_path / "mine.qpmpc")
    assert torch.equal(twin.value(s), mpc.value(s))
    qp = mpc.quadratic_program({"A": torch.zeros(3, *mpc.coordinates()["A"].shape)})
    assert_close(mpc.value(s, qp), mpc.value(s))
    message = r"got a state_dict with blocks = \[1, 3\], expected this module's \[2, 2\]"
    with pytest.raises(QPError, match=message):
        blocked([2, 2]).load_state_dict(mpc.state_dict())
