from __future__ import annotations

import copy
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from torch.testing import assert_close

from tests.problems import known_qp, normal, programs_of, random_mpc, random_states
from torch_qpmpc.qp.pipeline.batch import ContentMemo, FlatPrograms
from torch_qpmpc.qp.program import EVENT_SHAPES


def test_a_memo_finds_equal_tensors_and_nothing_else():
    memo, made = ContentMemo(), []

    def get(x, options=None):
        return memo.get((x,), options, lambda own: made.append(own) or len(made))

    x = normal(3)
    assert [get(x), get(x.clone()), get(x + 1), get(x, "other"), get(x.float())] == [1, 1, 2, 3, 4]
    x[0] += 1
    assert [get(x), get(x[None])] == [5, 6]


def test_a_memo_keeps_copies():
    memo, x = ContentMemo(), normal(3)
    kept = memo.get((x,), None, lambda own: own)
    before = x.clone()
    x += 1
    assert_close(torch.from_numpy(kept), before)
    assert memo.get((before,), None, lambda own: own) is kept


def test_a_memo_forgets_the_oldest():
    memo = ContentMemo()
    keys = [normal(2, seed=i) for i in range(ContentMemo.SIZE + 1)]
    for i, key in enumerate(keys):
        memo.get((key,), None, lambda own, i=i: i)
    assert len(memo.entries) == ContentMemo.SIZE
    assert memo.get((keys[0],), None, lambda own: "made again") == "made again"
    assert memo.get((keys[-1],), None, lambda own: "made again") == len(keys) - 1


def test_a_theta_shared_by_the_batch_is_prepared_once():
    known = known_qp(0)
    fixed = normal(5, 2)
    one, _ = FlatPrograms.of(*known.qp.tensors(), fixed)
    two, _ = FlatPrograms.of(*known.qp.tensors(), fixed[:2])
    assert one.known("x", lambda: 1) == two.known("x", lambda: 2) == 1
    other, _ = FlatPrograms.of(*known_qp(1).qp.tensors(), fixed)
    assert other.known("x", lambda: 3) == 3


def test_programs_that_differ_in_vectors_share_nothing():
    known = known_qp(0, batch=(4,))
    one, two = programs_of(known), programs_of(known)
    assert one.known("x", lambda: 1) == 1
    assert two.known("x", lambda: 2) == 2
    assert one.take(torch.tensor([0])).known("x", lambda: 3) == 3


def test_an_update_in_place_and_back_is_followed():
    mpc, s = random_mpc(1), random_states(4)
    before, C = mpc.value(s), mpc.C.detach().clone()
    twin = copy.deepcopy(mpc)
    with torch.no_grad():
        mpc.C += 0.1 * normal(*C.shape)
    assert (mpc.value(s) - before).abs().min() > 1e-6
    assert_close(twin.value(s), before, rtol=0, atol=0)
    mpc.C.data.copy_(C)  # unseen by version counters
    assert_close(mpc.value(s), before, rtol=0, atol=0)


def test_threads_prepare_for_themselves():
    known = known_qp(0)
    here, _ = FlatPrograms.of(*known.qp.tensors(), known.fixed)
    assert here.known("thread", lambda: "here") == "here"
    with ThreadPoolExecutor(1) as pool:
        there, _ = pool.submit(FlatPrograms.of, *known.qp.tensors(), known.fixed).result()
    assert there.known("thread", lambda: "there") == "there"


def test_diagonal_matrices_are_multiplied_as_such():
    known = known_qp(0)
    H = torch.diag(torch.arange(12.0).double())
    programs, _ = FlatPrograms.of(H, *known.qp.tensors()[1:], known.fixed)
    z, lam = normal(3, 12), normal(3, 13)
    assert_close(programs.times_H(z), z @ H)
    assert_close(programs.times_G(z), z @ known.qp.G.mT)
    assert_close(programs.times_G(lam, transposed=True), lam @ known.qp.G)


@pytest.mark.parametrize("matrices", [(), (4,)])
@pytest.mark.parametrize("batch", [(), (4,)])
def test_what_is_no_data_is_found_in_every_tensor(batch, matrices):
    known = known_qp(2, batch=batch, matrices=matrices)
    parts = dict(zip(EVENT_SHAPES, known.qp.tensors(), strict=True))
    fixed = known.fixed.expand(4, -1)
    assert FlatPrograms.of(*parts.values(), fixed)[0].valid() is None
    spoilt = dict.fromkeys(("H", "q", "c", "C", "b", "G"), (torch.nan, torch.inf))
    spoilt |= {"lb": (torch.nan, torch.inf), "ub": (torch.nan, -torch.inf), "w": (torch.nan, -1.0)}
    for name, values in spoilt.items():
        for value in values:
            bad = parts[name].clone()
            of_one = bad[2] if bad.ndim > len(EVENT_SHAPES[name]) else bad
            of_one.view(-1)[-1] = value
            valid = FlatPrograms.of(*(parts | {name: bad}).values(), fixed)[0].valid()
            assert valid is not None
            alone = bad.ndim > len(EVENT_SHAPES[name])
            assert valid.expand(4).tolist() == [alone, alone, False, alone], (name, value)
    bad = fixed.clone()
    bad[1, 0] = torch.nan
    valid = FlatPrograms.of(*parts.values(), bad)[0].valid()
    assert valid is not None
    assert valid.tolist() == [True, False, True, True]


def test_a_diagonal_is_one_of_a_single_square_matrix():
    known = known_qp(0)
    H = torch.diag(torch.arange(12.0).double())
    theta = known.qp.tensors()[1:]
    one, _ = FlatPrograms.of(H, *theta, known.fixed)
    assert one.is_diagonal("H")
    assert not one.is_diagonal("G")  # of 13 rows
    assert one.diagonal("G") is None
    assert_close(one.diagonal("H"), H.diagonal())
    H[3, 5] = H[5, 3] = 1e-300
    assert not FlatPrograms.of(H, *theta, known.fixed)[0].is_diagonal("H")
    many, _ = FlatPrograms.of(torch.eye(12).double().expand(3, 12, 12), *theta, known.fixed)
    assert not many.is_diagonal("H")
