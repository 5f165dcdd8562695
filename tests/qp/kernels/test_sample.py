"""The compiled loops against known solutions, and the certificate against a short reference."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from tests import problems
from torch_qpmpc.qp.kernels import sample
from torch_qpmpc.qp.kernels.sample import CLOSE
from torch_qpmpc.qp.pipeline import batch
from torch_qpmpc.qp.pipeline.batch import Programs
from torch_qpmpc.qp.solvers import daqp

BATCH = 6
SPOILERS = {
    "nothing": lambda parts: None,
    "z": lambda parts: parts["z"].mul_(1.1),
    "lam": lambda parts: parts["lam"].mul_(-3.0),
    "chi": lambda parts: parts["chi"].add_(0.1),
    "xi": lambda parts: parts["xi"].sub_(0.1),
    "large": lambda parts: parts["lam"].mul_(1e9),
    "NaN in z": lambda parts: parts["z"][1:3].fill_(torch.nan),
    "NaN in lam": lambda parts: parts["lam"][2, 3:].fill_(torch.nan),
    "NaN in chi": lambda parts: parts["chi"][0].fill_(torch.nan),
    "inf in lam": lambda parts: parts["lam"][4, 1].fill_(torch.inf),
    "inf in z": lambda parts: parts["z"][4, 5].fill_(-torch.inf),
    "overflow": lambda parts: parts["z"].mul_(1e200),
}


def reference(known: problems.KnownQP, **candidate: Tensor) -> float:
    """Compute the certificate's residual of one QP by the formulas of its docstring."""
    H, q, _, C, b, G, lb, ub, w = (x.numpy() for x in known.qp.tensors())
    candidate["lam"] = problems.within(candidate["lam"], *known.qp.tensors()[-3:])
    z, lam, chi, xi = (candidate[n].numpy() for n in ("z", "lam", "chi", "xi"))
    n_f = len(xi)

    def largest(*vectors: np.ndarray) -> float:
        return max(np.abs(x).max(initial=0.0) for x in vectors)

    left = H @ z + q + G.T @ lam + C.T @ chi
    left[:n_f] += xi
    short, y, hard = C @ z - b, G @ z, np.isinf(w)
    soft_w = np.where(hard, 0, w)
    outside = np.maximum(np.maximum(lb - y, y - ub), 0)
    charge = soft_w * outside
    conjugate = np.where(lam > 0, lam * np.where(np.isinf(ub), 0, ub), 0)
    conjugate = conjugate + np.where(lam < 0, lam * np.where(np.isinf(lb), 0, lb), 0)
    gap = charge + conjugate - lam * y
    cost = q @ z + 0.5 * z @ H @ z + charge.sum()
    slip = np.abs(short) @ np.abs(chi) + np.abs(gap).sum()
    return max(
        largest(left) / (1 + largest(H @ z, q, G.T @ lam, C.T @ chi)),
        largest(short / (1 + np.abs(b) + np.abs(C) @ np.abs(z))),
        largest(z[:n_f] - known.fixed.numpy()),
        largest((outside / (1 + np.abs(G) @ np.abs(z)))[hard]),
        slip / (1 + abs(cost)),
    )


@pytest.mark.parametrize("name", ["nothing", "z", "lam", "chi", "xi", "large"])
def test_the_residual_is_the_certificates(name):
    for seed in range(4):
        known = problems.known_qp(seed)
        candidate = {n: getattr(known, n).clone() for n in ("z", "lam", "chi", "xi")}
        SPOILERS[name](candidate)
        expected = reference(known, **candidate)
        claim = (x.unsqueeze(0) for x in candidate.values())
        p = problems.programs_of(replace(known, fixed=known.fixed.unsqueeze(0)))
        residual = problems.certified(p, *claim)[1]
        # A bound of the terms of a row, until they are summed.
        near = 0.0 if expected > CLOSE else CLOSE
        assert_close(residual.item(), float(expected), rtol=1e-9, atol=max(near, 1e-13))


@pytest.mark.parametrize("matrices", [(), (BATCH,)])
@pytest.mark.parametrize("name", SPOILERS)
def test_qps_of_a_batch_are_certified_as_each_alone(name, matrices):
    """Also beside claims with NaN and inf, whose residuals and errors are infinite."""
    for seed in range(3):
        known = problems.known_qp(seed, batch=(BATCH,), matrices=matrices)
        claim = {n: getattr(known, n).clone() for n in ("z", "lam", "chi", "xi")}
        SPOILERS[name](claim)
        p = problems.programs_of(known)
        value, residual, error = problems.certified(p, *claim.values())
        for i in range(BATCH):
            one = problems.certified(p.take(np.array([i])), *(x[i : i + 1] for x in claim.values()))
            assert_close(residual[i : i + 1], one[1], rtol=1e-9, atol=CLOSE)
            if residual[i].isfinite():
                assert_close(value[i : i + 1], one[0])
                assert_close(error[i : i + 1], one[2], rtol=1e-6, atol=1e-13)
            else:
                assert error[i].isinf()
        lost = torch.stack([x.isnan().any(-1) for x in claim.values()]).any(0)
        lost |= claim["z"].isinf().any(-1)
        assert residual[lost].isinf().all()


def test_many_qps_are_completed_and_recalled_in_threads_as_in_one(monkeypatch):
    mpc, s = problems.random_mpc(4, horizon=6), problems.random_states(48, size=0.7).double()
    p = Programs.of(*mpc.quadratic_program().tensors(), s)[0]
    found = daqp.solve(p.reduced_qps())
    expected = p.recover(found)
    monkeypatch.setattr(batch, "MANY", 10)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 3)
    recalled = p.recalled(expected.active)
    assert (recalled.iterations == 1).all()
    for answer in (p.recover(found), recalled._replace(iterations=found.iterations)):
        for one, other in zip(answer, expected, strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-6, atol=1e-6)


def test_rounding_makes_no_more_rows_independent_than_there_are_variables(monkeypatch):
    """Rows of an unstable plant over 50 steps once wrote beyond the array of the basis."""
    monkeypatch.setattr(sample, "DEPENDENT", 0.0)  # all of rounding counts
    units, n = np.random.default_rng(0).standard_normal((9, 3)), 9
    y, scratch = units @ np.ones(3), (np.empty((4, 3)), np.empty(4), np.empty(4))
    rows = y, np.zeros(n), y - 2.0, y, np.full(n, np.inf), np.ones(n)
    assert sample._repair.py_func(rows, np.arange(n), np.ones(3), units, units, *scratch) > 0
