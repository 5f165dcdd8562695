"""The compiled loops against the torch forms of the same, which serve other devices."""

from __future__ import annotations

from dataclasses import fields, replace

import numba
import numpy as np
import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from tests.problems import (
    known_qp,
    normal,
    programs_of,
    random_mpc,
    random_states,
    reduced_of,
    soft_qps,
)
from torch_qpmpc import solve_qp
from torch_qpmpc.qp import autograd
from torch_qpmpc.qp.autograd import envelope_gradients
from torch_qpmpc.qp.kernels import per_sample, per_theta
from torch_qpmpc.qp.pipeline import certificate
from torch_qpmpc.qp.pipeline import solve as chain
from torch_qpmpc.qp.pipeline import warm_start as recall_module
from torch_qpmpc.qp.pipeline.batch import FlatPrograms, SoftArrays, SoftQPs
from torch_qpmpc.qp.pipeline.certificate import Products, certify
from torch_qpmpc.qp.pipeline.condensing import condensed_for
from torch_qpmpc.qp.pipeline.warm_start import _Forces, _recall, recall
from torch_qpmpc.qp.program import UNKNOWN
from torch_qpmpc.qp.solvers import Answer, daqp

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


@pytest.mark.parametrize("matrices", [(), (BATCH,)])
@pytest.mark.parametrize("name", SPOILERS)
def test_the_certificate_is_that_of_torch(name, matrices):
    for seed in range(3):
        known = known_qp(seed, batch=(BATCH,), matrices=matrices)
        claim = {n: getattr(known, n).clone() for n in ("z", "lam", "chi", "xi")}
        SPOILERS[name](claim)
        programs = programs_of(known)
        products = Products.of(programs, **claim)
        ours = certify(programs, **claim, products=products)
        of_torch = certificate._certify(programs, claim["z"], claim["lam"], claim["chi"], products)
        assert_close(ours.residual, of_torch.residual, rtol=1e-9, atol=1e-13)
        fine = of_torch.residual.isfinite()
        assert_close(ours.value[fine], of_torch.value[fine])
        assert_close(ours.sigma[fine], of_torch.sigma[fine])


@pytest.mark.parametrize("hard", [False, True])
def test_absent_bounds_and_hard_rows_are_judged_as_by_torch(hard):
    known = known_qp(1, batch=(BATCH,))
    qp = known.qp
    lb, ub, w = qp.lb.clone(), qp.ub.clone(), qp.w.clone()
    lb[..., ::3], ub[..., 1::3] = -torch.inf, torch.inf
    if hard:
        w[...] = torch.inf
    tensors = (qp.H, qp.q, qp.c, qp.C, qp.b, qp.G, lb, ub, w)
    programs, _ = FlatPrograms.of(*tensors, known.fixed)
    claim = (known.z, known.lam, known.chi, known.xi)
    products = Products.of(programs, *claim)
    ours = certify(programs, *claim, products=products)
    of_torch = certificate._certify(programs, *claim[:3], products)
    assert ours.residual.max() > 1e-3
    for name in ("residual", "value", "sigma"):
        assert_close(getattr(ours, name), getattr(of_torch, name))


def assert_same_solution(monkeypatch, programs: FlatPrograms, answer: Answer, n_f: int) -> None:
    reduced = condensed_for(programs, n_f).reduced(programs)
    ours = chain._recover(programs, reduced, answer)
    with monkeypatch.context() as patch:
        patch.setattr(chain, "CACHED", -1)
        of_torch = chain._recover(programs, reduced, answer)
    for field in fields(ours):
        one, other = getattr(ours, field.name), getattr(of_torch, field.name)
        assert_close(one, other, rtol=1e-9, atol=1e-9, equal_nan=True)


@pytest.mark.parametrize("matrices", [(), (BATCH,)])
@pytest.mark.parametrize("wrong", [0.0, 0.1, torch.nan])
def test_the_full_solution_is_that_of_torch(monkeypatch, wrong, matrices):
    for seed in range(4):
        known = known_qp(seed, batch=(BATCH,), matrices=matrices)
        _, answer = soft_qps(known)
        answer = replace(answer, v=answer.v + wrong, lam=3 * answer.lam)
        assert_same_solution(monkeypatch, programs_of(known), answer, known.fixed.shape[-1])


def test_the_full_solution_of_diagonal_matrices_is_that_of_torch(monkeypatch):
    mpc, s = random_mpc(4, horizon=6), random_states(48, size=0.7).double()
    programs, _ = FlatPrograms.of(*mpc.quadratic_program().tensors(), s)
    assert programs.diagonal("H") is not None
    assert programs.diagonal("G") is not None
    answer = daqp.solve(condensed_for(programs, 2).reduced(programs).at(programs))
    assert_same_solution(monkeypatch, programs, answer, 2)


def assert_same_recall(qps: SoftQPs, active: Tensor) -> int:
    """How many could be compared: those that come to no end need not be the same."""
    (ours, ended), (of_torch, done) = recall(qps, active), _recall(_Forces(qps), qps, active)
    # Sets of rows that depend on each other have no solution at all.
    done &= of_torch.v.isfinite().all(-1)
    assert torch.equal(ended, done)
    assert torch.equal(ours.iterations[done], of_torch.iterations[done])
    assert_close(ours.v[done], of_torch.v[done])
    assert_close(ours.lam[done], of_torch.lam[done])
    return int(done.sum())


@pytest.mark.parametrize("small", [-1, recall_module.SMALL])
@pytest.mark.parametrize("matrices", [(), (BATCH,)])
def test_recall_is_that_of_torch(monkeypatch, matrices, small):
    monkeypatch.setattr(recall_module, "SMALL", small)
    for seed in range(4):
        known = known_qp(seed, batch=(BATCH,), matrices=matrices)
        active = solve_qp(known.qp, known.fixed, solver="torch").active[:, reduced_of(known).rows]
        assert assert_same_recall(soft_qps(known)[0], active) == BATCH


@pytest.mark.parametrize("changes", [1, 2, 3])
def test_recall_corrects_active_sets_as_torch_does(changes):
    mpc, s = random_mpc(4, horizon=6), random_states(48, size=0.7).double()
    programs, _ = FlatPrograms.of(*mpc.quadratic_program().tensors(), s)
    reduced = condensed_for(programs, s.shape[-1]).reduced(programs)
    active = mpc.solve(s).active[:, reduced.rows]
    generator = torch.Generator().manual_seed(changes)
    for codes in active:
        held = codes.nonzero().squeeze(-1)
        codes[held[torch.randperm(len(held), generator=generator)[:changes]]] = 0
    active[:4, changes] = UNKNOWN
    assert assert_same_recall(reduced.at(programs), active) >= 12


def test_where_nothing_can_be_written_kernels_are_compiled_each_time(monkeypatch):
    njit = numba.njit

    def refuses(*arguments, cache=False, **options):
        if cache:
            raise RuntimeError("cannot cache function: no locator available")
        return njit(*arguments, **options)

    monkeypatch.setattr(numba, "njit", refuses)

    @per_sample.compiled
    def twice(x):
        return 2 * x

    assert twice(3.0) == 6.0


@pytest.mark.parametrize("near", [40, 8])
def test_a_tour_goes_from_neighbour_to_neighbour(near):
    vectors = random_states(40, 3, seed=1).numpy()
    order = per_sample.tour(vectors, near)
    scaled = (vectors - vectors.mean(0)) / vectors.std(0)

    def length(order):
        return np.linalg.norm(np.diff(scaled[order], axis=0), axis=1).sum()

    assert sorted(order) == list(range(40))
    assert length(order) < 0.7 * length(np.arange(40))
    if near == 40:
        left, at = set(range(1, 40)), 0
        for k in order[1:]:
            assert k == min(left, key=lambda j: np.linalg.norm(scaled[j] - scaled[at]))
            left, at = left - {k}, k


@pytest.mark.parametrize("vectors", [np.zeros((0, 3)), np.zeros((4, 0)), np.full((5, 2), np.nan)])
def test_a_tour_visits_each_of_any_vectors_once(vectors):
    for near in (2, 40):
        assert sorted(per_sample.tour(vectors, near)) == list(range(len(vectors)))


@pytest.mark.parametrize("n_qps", [0, 1, 5, 3000])
@pytest.mark.parametrize("unneeded", [(), (3,), (0, 3, 5)])
def test_the_gradient_of_shared_data_is_that_of_torch(n_qps, unneeded):
    n_z, n_c, n_g, n_f = 12, 4, 9, 3
    z, sigma, chi, lam, xi = (normal(n_qps, n, seed=n) for n in (n_z, n_g, n_c, n_g, n_f))
    status, incoming = torch.zeros(n_qps, dtype=torch.int64), normal(n_qps)
    status[3:4] = 2
    weight = torch.where(status == 0, incoming, 0)
    incoming[3:4] = torch.inf
    shapes = ((n_z, n_z), (n_z,), (), (n_c, n_z), (n_c,), (n_g, n_z), *((n_g,),) * 3, z.shape)
    in_torch = envelope_gradients(weight, z, sigma, chi, lam, xi).values()
    given = per_sample.arrays(incoming, z, sigma, chi, lam, xi, status)
    ours = per_sample.envelope(*given, *(i not in unneeded for i in (0, 3, 5)))
    for i, (gradient, of_torch, shape) in enumerate(zip(ours, in_torch, shapes, strict=True)):
        if i in unneeded:
            assert not gradient.size
        else:
            like = z.new_empty(shape) if i < 9 else xi
            assert_close(torch.from_numpy(gradient), of_torch(like))


@pytest.mark.parametrize("shape", [(0,), (), (9,), (per_sample.FIRST + 1,), (3, per_sample.FIRST)])
def test_arrays_are_equal_where_no_entry_differs(shape):
    one = normal(*shape).numpy()
    other = one.copy()
    assert per_sample.are_equal(one, other)
    for at in (0, per_sample.FIRST - 1, per_sample.FIRST, one.size - 1):
        if not 0 <= at < one.size:
            continue
        for value in (one.flat[at] + 1, np.nan):
            other.flat[at] = value
            assert not per_sample.are_equal(one, other)
        other.flat[at] = one.flat[at]


@pytest.mark.parametrize("n", range(10))
def test_a_product_takes_every_row(n):
    x, factors, matrix = normal(5).numpy(), normal(n).numpy(), normal(n, 5, seed=1).numpy()
    expected = x + matrix.T @ factors
    per_sample.add_product(x, factors, matrix)
    np.testing.assert_allclose(x, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("shift", [0.0, -1.0])
@pytest.mark.parametrize("n_r", [0, 3, 9])
def test_the_forces_of_a_theta_are_those_of_torch(n_r, shift):
    root, G = normal(2, 5, 5), normal(2, n_r, 5, seed=1)
    H = root @ root.mT
    H[1] += shift * torch.linalg.eigvalsh(H[1])[-1] * torch.eye(5).double()
    vectors = normal(4, 5), normal(4, n_r), normal(4, n_r), normal(4, n_r)
    qps = SoftQPs(H, G, torch.tensor([0, 1, 1, 0]), *vectors)
    rise, push = map(torch.from_numpy, per_theta.forces(H.numpy(), G.numpy()))
    of_torch = _Forces(qps)
    convex = slice(1 if shift else 2)
    assert_close(rise[convex], of_torch.rise.mT[convex])
    assert_close(push[convex], of_torch.push.mT[convex])
    assert not shift or rise[1].isnan().all()


@pytest.mark.parametrize("large", [False, True])
def test_active_sets_are_those_of_torch(monkeypatch, large):
    mpc, s, a = random_mpc(3, horizon=6), random_states(48).double(), random_states(48, 1)
    s[5, 0] = torch.nan
    mpc.on_failure = "mask"
    if large:
        monkeypatch.setattr(autograd, "CACHED", -1)
    for action in (None, a.double()):
        solution = mpc.solve(s, action)
        value, active = mpc.value_and_active_set(s, action)
        assert torch.equal(value, solution.value)
        assert torch.equal(active, solution.active)
        assert {*active.unique().tolist()} >= {-2, -1, 0, 1, 2, UNKNOWN}
        again, _ = mpc.value_and_active_set(s, action, warm_start=active)
        assert_close(again, value)


@pytest.mark.parametrize("matrices", [(), (BATCH,)])
def test_what_fixed_entries_make_of_the_condensed_problem_is_that_of_torch(matrices):
    known = known_qp(0, batch=(BATCH,), matrices=matrices)
    programs, reduced = programs_of(known), reduced_of(known)
    qps = reduced.at(programs)
    moved = programs.multiply(reduced.matrix, programs.fixed, transposed=True) + reduced.constant
    assert_close(torch.cat((qps.g, qps.l, qps.u), dim=-1), moved)
    again = replace(qps)
    for name in SoftArrays._fields:
        assert np.array_equal(getattr(qps.arrays, name), getattr(again.arrays, name))
