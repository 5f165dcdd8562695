"""The compiled loops against their torch forms, and the certificate against a short reference."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from tests.problems import (
    KnownQP,
    certified,
    in_torch,
    known_qp,
    programs_of,
    random_mpc,
    random_states,
    within,
)
from torch_qpmpc.qp.kernels import sample, sample_torch
from torch_qpmpc.qp.kernels.sample import CLOSE
from torch_qpmpc.qp.pipeline.arrays import BatchSolution, to_tensor
from torch_qpmpc.qp.pipeline.batch import Programs
from torch_qpmpc.qp.solvers import BackendSolution, daqp

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


def reference(known: KnownQP, **candidate: Tensor) -> float:
    """Compute the certificate's residual of one QP by the formulas of its docstring."""
    H, q, _, C, b, G, lb, ub, w = (x.numpy() for x in known.qp.tensors())
    candidate["lam"] = within(candidate["lam"], *known.qp.tensors()[-3:])
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
        known = known_qp(seed)
        candidate = {n: getattr(known, n).clone() for n in ("z", "lam", "chi", "xi")}
        SPOILERS[name](candidate)
        expected = reference(known, **candidate)
        batch = {n: x.unsqueeze(0) for n, x in candidate.items()}
        p = programs_of(replace(known, fixed=known.fixed.unsqueeze(0)))
        ours, others = (certified(p, *batch.values(), compiled=c)[1] for c in (True, False))
        assert_close(others.item(), float(expected), rtol=1e-9, atol=1e-13)
        # A bound of the terms of a row, until they are summed.
        near = 0.0 if expected > CLOSE else CLOSE
        assert_close(ours.item(), float(expected), rtol=1e-9, atol=max(near, 1e-13))


@pytest.mark.parametrize("matrices", [(), (BATCH,)])
@pytest.mark.parametrize("name", SPOILERS)
def test_the_certificate_is_that_of_torch(name, matrices):
    for seed in range(3):
        known = known_qp(seed, batch=(BATCH,), matrices=matrices)
        candidate = {n: getattr(known, n).clone() for n in ("z", "lam", "chi", "xi")}
        SPOILERS[name](candidate)
        assert_certified_alike(known, candidate)


def assert_certified_alike(known: KnownQP, candidate: dict[str, Tensor]) -> Tensor:
    compiled = programs_of(known)
    value, residual, error = certified(compiled, *candidate.values())
    of_torch = certified(compiled, *candidate.values(), compiled=False)
    assert_close(residual, of_torch[1], rtol=1e-9, atol=CLOSE)
    known_to_both = of_torch[2].isfinite()
    assert_close(error[known_to_both], of_torch[2][known_to_both], rtol=1e-9, atol=1e-13)
    fine = residual.isfinite()
    assert_close(value[fine], of_torch[0][fine])
    return residual


def assert_recovered_alike(compiled: Programs, found: BackendSolution) -> None:
    ours, of_torch = (
        compiled.recover(found),
        sample_torch.recover(*map(to_tensor, found), *in_torch(compiled)),
    )
    others = dict(zip(BatchSolution._fields, of_torch, strict=True))
    near = others["value_error"].isinf()  # without the close look at several hard rows
    for name, other in others.items():
        one = to_tensor(getattr(ours, name))
        if name == "active":
            solved = others["residual"] < 1e-3
            one, other = one[solved], other[solved]
        if name in ("value_error", "status"):
            one = one.where(~near, other)
        atol = CLOSE if name == "residual" else 1e-9
        assert_close(
            one, other, rtol=1e-9, atol=atol, equal_nan=True, msg=lambda m, n=name: f"{n} {m}"
        )


@pytest.mark.parametrize("matrices", [(), (BATCH,)])
@pytest.mark.parametrize("wrong", [0.0, 0.1, torch.nan])
def test_the_full_solution_is_that_of_torch(wrong, matrices):
    for seed in range(4):
        compiled = programs_of(known_qp(seed, batch=(BATCH,), matrices=matrices))
        found = daqp.solve(compiled.reduced_qps())
        found = found._replace(v=found.v + wrong, lam=(1 + wrong) * found.lam)
        assert_recovered_alike(compiled, found)


def test_the_full_solution_of_diagonal_matrices_is_that_of_torch():
    mpc, s = random_mpc(4, horizon=6), random_states(48, size=0.7).double()
    compiled = Programs.of(*mpc.quadratic_program().tensors(), s)[0]
    H, _, G, *_ = compiled.prepared.sizes(compiled.n_f).spans
    assert all((np.diff(spans) <= 1).all() for spans in (H, G))
    assert_recovered_alike(compiled, daqp.solve(compiled.reduced_qps()))


def test_rounding_makes_no_more_rows_independent_than_there_are_variables(monkeypatch):
    """Rows of an unstable plant over 50 steps once wrote beyond the array of the basis."""
    monkeypatch.setattr(sample, "DEPENDENT", 0.0)  # all of rounding counts
    units, n = np.random.default_rng(0).standard_normal((9, 3)), 9
    y, scratch = units @ np.ones(3), (np.empty((4, 3)), np.empty(4), np.empty(4))
    rows = y, np.zeros(n), y - 2.0, y, np.full(n, np.inf), np.ones(n)
    assert sample._repair.py_func(rows, np.arange(n), np.ones(3), units, units, *scratch) > 0
