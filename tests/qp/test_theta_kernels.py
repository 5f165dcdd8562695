"""What is worked out once for a theta: by kernels as by LAPACK, and equal to what it stands for."""

from __future__ import annotations

from dataclasses import fields

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from tests.problems import known_qp, normal, programs_of, random_mpc, reduced_of, times
from torch_qpmpc.qp.kernels import per_sample
from torch_qpmpc.qp.pipeline import condensing as condense_module
from torch_qpmpc.qp.pipeline.condensing import Condensed, _condense

BATCH = 6


def assert_condensed_alike(monkeypatch, H: Tensor, C: Tensor, G: Tensor, keep: int) -> Condensed:
    given = per_sample.arrays(H, C, G), H.device, keep
    ours = _condense(*given)
    with monkeypatch.context() as patch:
        patch.setattr(condense_module, "SMALL", -1)
        of_lapack = _condense(*given)
    for field in fields(Condensed):
        one, other = getattr(ours, field.name), getattr(of_lapack, field.name)
        if isinstance(one, Tensor):
            assert_close(one, other, rtol=1e-10, atol=1e-10)
        else:
            assert one == other, field.name
    return ours


@pytest.mark.parametrize("n_g", [0, 4, 8])
@pytest.mark.parametrize("n_c", [0, 1, 3, 5])
@pytest.mark.parametrize("M", [1, 4])
def test_a_theta_is_condensed_as_by_lapack(monkeypatch, M, n_c, n_g):
    H, C, G = normal(M, 8, 8), normal(M, n_c, 8, seed=1), normal(M, n_g, 8, seed=2)
    condensed = assert_condensed_alike(monkeypatch, H + H.mT, C, G, 3)
    assert not condensed.deficient
    assert not condensed.surely_convex
    assert assert_condensed_alike(monkeypatch, H @ H.mT, C, G, 3).surely_convex


def test_an_mpc_scheme_is_condensed_as_by_lapack(monkeypatch):
    for seed in range(4):
        qp = random_mpc(seed, horizon=6).quadratic_program()
        H, C, G = (matrix.detach().unsqueeze(0) for matrix in (qp.H, qp.C, qp.G))
        assert torch.equal(H[0], torch.diag(H[0].diagonal()))
        assert_condensed_alike(monkeypatch, H, C, G, 3)


@pytest.mark.parametrize("M", [1, 2])
def test_dependent_rows_are_left_to_lapack(monkeypatch, M):
    C = normal(M, 3, 8)
    C[-1, 2] = C[-1, 0] - C[-1, 1]
    H, G = torch.eye(8).double().repeat(M, 1, 1), normal(M, 4, 8)
    assert assert_condensed_alike(monkeypatch, H, C, G, 2).deficient


def test_no_theta_at_all_is_condensed(monkeypatch):
    of_none = assert_condensed_alike(
        monkeypatch, normal(0, 8, 8), normal(0, 3, 8), normal(0, 4, 8), 2
    )
    assert of_none.T.shape == (0, 8, 5)


@pytest.mark.parametrize("matrices", [(), (BATCH,), (1,)])
@pytest.mark.parametrize("batch", [(), (BATCH,)])
def test_the_reduced_problem_is_the_problem_in_fewer_variables(batch, matrices):
    """Its cost differs by a constant, its rows' distances to their bounds not at all."""
    for seed in range(4):
        known = known_qp(seed, batch=batch, matrices=matrices if batch else ())
        p, reduced = programs_of(known), reduced_of(known)
        qps, H, G = reduced.at(p), p.H[p.group], p.G[p.group]
        v = normal(2, len(p), reduced.H.shape[-1], seed=seed)
        z = torch.stack([reduced.expand(p, one) for one in v])
        assert_close(times(p.C[p.group], z), p.b.expand(2, len(p), -1))
        cost = 0.5 * (z * times(H, z)).sum(-1) + (p.q * z).sum(-1)
        reduced_cost = 0.5 * (v * times(qps.H[p.group], v)).sum(-1) + (qps.g * v).sum(-1)
        assert_close(cost[0] - cost[1], reduced_cost[0] - reduced_cost[1])
        y, Gv = times(G, z), times(qps.G[p.group], v)
        rows, others = reduced.rows, reduced.others
        assert sorted([*rows.tolist(), *others.tolist()]) == list(range(G.shape[-2]))
        assert_close(y[..., rows] - p.lb[..., rows], Gv - qps.l)
        assert_close(p.ub[..., rows] - y[..., rows], qps.u - Gv)
        assert_close(qps.w, p.w[..., rows].expand(len(p), -1))
        bounded = (p.lb.isfinite() | p.ub.isfinite())[..., others].any(0)
        assert_close(y[0][..., others][:, bounded], y[1][..., others][:, bounded])
