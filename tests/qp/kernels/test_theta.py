"""The preparation of theta against NumPy."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from tests.problems import expanded, known_qp, normal, programs_of, reduced_of, times
from torch_qpmpc.qp.kernels import theta as loops

BATCH = 6


@pytest.mark.parametrize("shift", [0.0, -1.0])
@pytest.mark.parametrize("r", [0, 3, 9])
def test_forces_solve_the_unconstrained_qp(r, shift):
    root, G = normal(2, 5, 5), normal(2, r, 5, seed=1)
    H = root @ root.mT
    H[1] += shift * torch.linalg.eigvalsh(H[1])[-1] * torch.eye(5).double()
    rise, push = map(torch.from_numpy, loops.forces(H.numpy(), G.numpy()))
    g, lam = normal(5, seed=2), normal(r, seed=3)
    for m in range(1 if shift else 2):
        v = torch.linalg.solve(H[m], -g - G[m].mT @ lam)
        assert_close(-g @ rise[m] - lam @ push[m], torch.cat((v, G[m] @ v)))
    assert not shift or rise[1].isnan().all()


@pytest.mark.parametrize("n_g", [0, 4, 8])
@pytest.mark.parametrize("n_c", [0, 1, 3, 5])
@pytest.mark.parametrize("M", [1, 4])
def test_a_theta_is_condensed(M, n_c, n_g):
    H, C, G = (normal(M, n, 8, seed=n).numpy() for n in (8, n_c, n_g))
    T, Y_neg, regular = loops.eliminate(C, 3, 1e-10)
    assert regular
    assert T.shape == (M, 8, 8 - n_c)
    np.testing.assert_allclose(C @ T, 0, atol=1e-10)
    np.testing.assert_allclose(-C @ Y_neg, np.eye(n_c) + np.zeros((M, 1, 1)), atol=1e-10)
    np.testing.assert_allclose(T[:, :3, :3], np.eye(3) + np.zeros((M, 1, 1)))
    for matrix, convex in ((H + H.swapaxes(1, 2), False), (H @ H.swapaxes(1, 2), True)):
        H_y, G_y, H_b, G_b, surely_convex = loops.condense(matrix, G, T, Y_neg, 1e-9)
        assert surely_convex == convex
        T_T = T.swapaxes(1, 2)
        np.testing.assert_allclose(H_y, T_T @ matrix @ T, atol=1e-9)
        np.testing.assert_allclose(H_b, -T_T @ matrix @ Y_neg, atol=1e-9)
        np.testing.assert_allclose(G_y, G @ T, atol=1e-9)
        np.testing.assert_allclose(G_b, -G @ Y_neg, atol=1e-9)


def test_diagonal_matrices_are_condensed_as_such():
    H, C = np.diag(np.arange(8.0))[None], normal(1, 3, 8).numpy()
    T, Y_neg, _ = loops.eliminate(C, 3, 1e-10)
    H_y, G_y, _, _, convex = loops.condense(H, np.eye(8)[None], T, Y_neg, 1e-9)
    np.testing.assert_allclose(H_y, T.swapaxes(1, 2) @ H @ T, atol=1e-10)
    np.testing.assert_allclose(G_y, T)
    assert convex


@pytest.mark.parametrize("M", [1, 2])
def test_dependent_rows_are_found(M):
    C = normal(M, 3, 8)
    C[-1, 2] = C[-1, 0] - C[-1, 1]
    assert not loops.eliminate(C.numpy(), 2, 1e-10)[2]
    assert not loops.eliminate(normal(M, 7, 8).numpy(), 2, 1e-10)[2]


def test_no_theta_at_all_is_condensed():
    T, Y_neg, regular = loops.eliminate(np.zeros((0, 3, 8)), 2, 1e-10)
    assert regular
    assert loops.condense(np.zeros((0, 8, 8)), np.zeros((0, 4, 8)), T, Y_neg, 1e-9)[4]


@pytest.mark.parametrize("matrices", [(), (BATCH,), (1,)])
@pytest.mark.parametrize("batch", [(), (BATCH,)])
def test_the_reduced_problem_is_the_problem_in_fewer_variables(batch, matrices):
    """Its cost differs by a constant; the rows' distances to their bounds are equal."""
    for seed in range(4):
        known = known_qp(seed, batch=batch, matrices=matrices if batch else ())
        p, reduced = programs_of(known), reduced_of(known)
        data, qps = p.theta, p.reduced_qps()
        H, G = data.H[p.group], data.G[p.group]
        v = normal(2, len(p), reduced.H.shape[-1], seed=seed)
        z = torch.stack([expanded(p, one) for one in v])
        assert_close(times(data.C[p.group], z), data.b.expand(2, len(p), -1))
        cost = 0.5 * (z * times(H, z)).sum(-1) + (data.q * z).sum(-1)
        reduced_cost = 0.5 * (v * times(qps.H[p.group], v)).sum(-1) + (qps.g * v).sum(-1)
        assert_close(cost[0] - cost[1], reduced_cost[0] - reduced_cost[1])
        y, Gv = times(G, z), times(qps.G[p.group], v)
        rows, others = reduced.rows, reduced.others
        assert sorted([*rows.tolist(), *others.tolist()]) == list(range(G.shape[-2]))
        assert_close(y[..., rows] - data.lb[..., rows], Gv - qps.l)
        assert_close(data.ub[..., rows] - y[..., rows], qps.u - Gv)
        assert_close(qps.w, data.w[..., rows].expand(len(p), -1))
        bounded = torch.isfinite(torch.maximum(data.lb, -data.ub))[..., others].any(0)
        assert_close(y[0][..., others][:, bounded], y[1][..., others][:, bounded])
