"""The compiled loops against their torch forms, and the certificate against a short reference."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from tests.problems import CPU, KnownQP, known_qp, programs_of, random_mpc, random_states
from torch_qpmpc import QuadraticProgram
from torch_qpmpc.qp.pipeline.arrays import BatchSolution, to_tensor
from torch_qpmpc.qp.pipeline.batch import Programs
from torch_qpmpc.qp.pipeline.solve import solve_programs
from torch_qpmpc.qp.program import UNKNOWN
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


def both(known: KnownQP) -> tuple[Programs, Programs]:
    """Run the test for the compiled loops and for their torch forms on the CPU."""
    return programs_of(known, None), programs_of(known)


def reference(known: KnownQP, **candidate: Tensor) -> float:
    """Compute the certificate's residual of one QP by the formulas of its docstring."""
    H, q, _, C, b, G, lb, ub, w = (x.numpy() for x in known.qp.tensors())
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
        largest(short) / (1 + largest(b) + largest(z)),
        largest(z[:n_f] - known.fixed.numpy()),
        largest((outside / (1 + np.abs(y)))[hard]),
        largest(np.maximum((np.abs(lam) - soft_w) / (1 + soft_w), 0)[~hard]),
        largest(lam[(lam > 0) & np.isinf(ub)], lam[(lam < 0) & np.isinf(lb)]),
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
        for p in both(replace(known, fixed=known.fixed.unsqueeze(0))):
            given = {n: x.numpy() if p.prepared.device is None else x for n, x in batch.items()}
            residual = to_tensor(p.certify(**given)[1])
            assert_close(residual.item(), float(expected), rtol=1e-9, atol=1e-13)


@pytest.mark.parametrize("matrices", [(), (BATCH,)])
@pytest.mark.parametrize("name", SPOILERS)
def test_the_certificate_is_that_of_torch(name, matrices):
    for seed in range(3):
        known = known_qp(seed, batch=(BATCH,), matrices=matrices)
        candidate = {n: getattr(known, n).clone() for n in ("z", "lam", "chi", "xi")}
        SPOILERS[name](candidate)
        assert_certified_alike(known, candidate)


def assert_certified_alike(known: KnownQP, candidate: dict[str, Tensor]) -> Tensor:
    compiled, in_torch = both(known)
    found = compiled.certify(**{n: x.numpy() for n, x in candidate.items()})
    value, residual, error = map(to_tensor, found)
    of_torch = in_torch.certify(**candidate)
    assert_close(residual, of_torch[1], rtol=1e-9, atol=1e-13)
    assert_close(error, of_torch[2], rtol=1e-9, atol=1e-13)
    fine = residual.isfinite()
    assert_close(value[fine], of_torch[0][fine])
    return residual


def assert_recovered_alike(
    compiled: Programs, in_torch: Programs, found: BackendSolution, passes: int = 0
) -> None:
    ours = compiled.recover(found.like(np.empty(0)), passes)
    others = in_torch.recover(found.like(torch.empty(0)), passes)
    for name in BatchSolution._fields:
        one, other = to_tensor(getattr(ours, name)), getattr(others, name)
        if name == "active":
            solved = others.residual < 1e-3
            one, other = one[solved], other[solved]
        assert_close(
            one, other, rtol=1e-9, atol=1e-9, equal_nan=True, msg=lambda m, n=name: f"{n} {m}"
        )


@pytest.mark.parametrize("passes", [0, 2])
@pytest.mark.parametrize("matrices", [(), (BATCH,)])
@pytest.mark.parametrize("wrong", [0.0, 0.1, torch.nan])
def test_the_full_solution_is_that_of_torch(wrong, matrices, passes):
    for seed in range(4):
        compiled, in_torch = both(known_qp(seed, batch=(BATCH,), matrices=matrices))
        found = daqp.solve(compiled.reduced_qps())
        found = found._replace(v=found.v + wrong, lam=(1 + wrong) * found.lam)
        assert_recovered_alike(compiled, in_torch, found, passes)


def mpc_programs(device: torch.device | None) -> Programs:
    mpc, s = random_mpc(4, horizon=6), random_states(48, size=0.7).double()
    return Programs.of(*mpc.quadratic_program().tensors(), s, device=device)[0]


def test_the_full_solution_of_diagonal_matrices_is_that_of_torch():
    compiled, in_torch = mpc_programs(None), mpc_programs(CPU)
    H, _, G, *_ = compiled.prepared.sizes(compiled.n_f).spans
    assert all((np.diff(spans) <= 1).all() for spans in (H, G))
    assert_recovered_alike(compiled, in_torch, daqp.solve(compiled.reduced_qps()))


def assert_settled_alike(compiled: Programs, in_torch: Programs, active: Tensor) -> int:
    """Compare the QPs that settle in both; return their number."""
    given = np.ascontiguousarray(active.numpy())
    ours, others = compiled.recalled(given), in_torch.recalled(active)
    done = others.residual.isfinite()  # linearly dependent sets of rows have no solution
    assert torch.equal(to_tensor(ours.residual).isfinite(), done)
    for name in ("value", "z", "chi", "lam", "xi", "status", "iterations", "active"):
        one, other = to_tensor(getattr(ours, name))[done], getattr(others, name)[done]
        assert_close(one, other, rtol=1e-6, atol=1e-9)
    return int(done.sum())


@pytest.mark.parametrize("changes", [1, 2, 3])
def test_active_sets_are_corrected_as_by_torch(changes):
    compiled, in_torch = mpc_programs(None), mpc_programs(CPU)
    active = to_tensor(solve_programs(compiled, "daqp").active)
    generator = torch.Generator().manual_seed(changes)
    for codes in active:
        held = codes.nonzero().squeeze(-1)
        codes[held[torch.randperm(len(held), generator=generator)[:changes]]] = 0
    active[:4, changes] = UNKNOWN
    assert assert_settled_alike(compiled, in_torch, active) >= 12


@pytest.mark.parametrize("start", [False, True])
@pytest.mark.parametrize("spoilt", [False, True])
@pytest.mark.parametrize("matrices", [(), (BATCH,)])
def test_the_whole_pipeline_in_tensors_is_that_in_arrays(matrices, spoilt, start):
    """Run the other devices' path on the CPU, for invalid, infeasible and solvable QPs."""
    known = known_qp(2, batch=(BATCH,), matrices=matrices)
    q, lb = known.qp.q.clone(), known.qp.lb.clone()
    if spoilt:
        q[1] = torch.nan
        lb[2] = known.qp.ub[2].where(known.qp.ub[2].isfinite(), lb[2])
    tensors: dict[str, Any] = vars(known.qp) | {"q": q, "lb": lb}
    qp = QuadraticProgram(**tensors, check_values=False)
    compiled, in_torch = both(replace(known, qp=qp))
    active = torch.zeros_like(known.lam, dtype=torch.int8) if start else None
    ours = solve_programs(compiled, "torch", None if active is None else active.numpy())
    others = solve_programs(in_torch, "torch", active)
    for name in BatchSolution._fields:
        one, other = to_tensor(getattr(ours, name)), to_tensor(getattr(others, name))
        if name not in ("iterations", "residual"):
            assert_close(one, other, rtol=1e-6, atol=1e-6, msg=lambda m, n=name: f"{n} {m}")
    assert (to_tensor(ours.status) == 0).sum() >= (BATCH - 2 if spoilt else BATCH)
