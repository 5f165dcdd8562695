from __future__ import annotations

import copy
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.func import functional_call
from torch.testing import assert_close

from tests.problems import known_qp, normal, programs_of, random_mpc, random_states, reduced_of
from torch_qpmpc import Status, solve_qp
from torch_qpmpc.mpc.banded import banded_matrix
from torch_qpmpc.qp.pipeline import condensing as condense_module
from torch_qpmpc.qp.pipeline.batch import ContentMemo, FlatPrograms
from torch_qpmpc.qp.pipeline.condensing import condense, other_eliminations


@pytest.fixture
def eliminations(monkeypatch: pytest.MonkeyPatch) -> list[np.ndarray]:
    """The matrices that were factorised since the test began."""
    factorised = []
    condense_anew = condense_module._condense

    def counting(matrices: Sequence[np.ndarray], device: torch.device, keep: int):
        factorised.append(matrices[1])
        return condense_anew(matrices, device, keep)

    monkeypatch.setattr(condense_module, "_condense", counting)
    return factorised


# The rows of C, by the size (3 fixed of 8) of the problems below.
INDEPENDENT = normal(3, 8)
DEPENDENT = normal(5, 3, seed=1) @ normal(3, 8, seed=2)
REPEATED = torch.cat((INDEPENDENT, INDEPENDENT))
MANY = normal(7, 8, seed=3)  # more rows than free entries
AFFECTS_FIXED_ONLY = torch.eye(8, dtype=torch.float64)[:2]
NONE = torch.zeros(0, 8, dtype=torch.float64)
ZERO = torch.zeros(2, 8, dtype=torch.float64)
DEFICIENT = {
    "dependent": DEPENDENT,
    "repeated": REPEATED,
    "many": MANY,
    "fixed only": AFFECTS_FIXED_ONLY,
    "zero": ZERO,
}
REGULAR = {"independent": INDEPENDENT, "none": NONE}


def test_programs_of_any_batch_shapes_are_flattened_alike():
    known = known_qp(0, batch=(3, 4), matrices=(3, 1))
    programs, batch = FlatPrograms.of(*known.qp.tensors(), known.fixed)
    assert batch == (3, 4)
    assert len(programs) == 12
    assert programs.H.shape == (3, 12, 12)  # not repeated for the four that share it
    assert programs.group.tolist() == [0] * 4 + [1] * 4 + [2] * 4
    assert_close(programs.C[programs.group[7]], known.qp.C[1, 0])
    assert_close(programs.q[7], known.qp.q[1, 3])
    assert_close(programs.c[7], known.qp.c[1, 3])


def test_an_asymmetric_hessian_counts_by_its_symmetric_part():
    known = known_qp(0)
    H = known.qp.H + normal(12, 12).triu(1)
    programs, _ = FlatPrograms.of(H, *known.qp.tensors()[1:], known.fixed)
    assert_close(programs.H[0], (H + H.mT) / 2)


def test_taken_programs_keep_their_matrices():
    programs = programs_of(known_qp(0, batch=(6,), matrices=(6,)))
    index = torch.tensor([4, 1])
    part = programs.take(index)
    assert len(part) == 2
    assert_close(part.c, programs.c[index])
    assert_close(part.H[part.group], programs.H[index])
    assert_close(part.multiply(part.G, part.q), programs.multiply(programs.G, programs.q)[index])


@pytest.mark.parametrize("count", [1, 6])
def test_products_are_those_of_each_program(count):
    programs = programs_of(known_qp(0, batch=(6,), matrices=(count,)))
    product = programs.multiply(programs.G, programs.q)
    loop = [programs.G[m] @ q for m, q in zip(programs.group, programs.q, strict=True)]
    assert_close(product, torch.stack(loop))


@pytest.mark.parametrize("name", [*REGULAR, *DEFICIENT])
def test_elimination_spans_the_solutions_of_the_equalities(name):
    C = (REGULAR | DEFICIENT)[name].unsqueeze(0)
    H, G = normal(1, 8, 8), normal(1, 4, 8)
    keep = 3
    condensed = condense(H + H.mT, C, G, keep)
    assert condensed.deficient == (name in DEFICIENT)
    kept = condensed.T[0, :keep]
    assert_close(kept, torch.eye(keep, condensed.T.shape[-1]).double())
    n_free = 8 - keep - int(torch.linalg.matrix_rank(C[0, :, keep:]))
    assert condensed.T.shape[-1] - keep == n_free
    assert_close(C @ condensed.T[:, :, keep:], torch.zeros(1, C.shape[1], n_free).double())
    # A right-hand side that the entries after `keep` can meet is met.
    b = C[:, :, keep:] @ normal(1, 5, 1, seed=4)
    assert_close(-C @ condensed.Y_neg @ b, b)
    assert_close(condensed.H, condensed.T.mT @ (H + H.mT) @ condensed.T)
    assert_close(condensed.G, G @ condensed.T)


def test_ranks_may_differ_within_a_batch():
    C = torch.stack((torch.cat((INDEPENDENT, normal(3, 8, seed=5))), REPEATED))
    condensed = condense(torch.eye(8).double().expand(2, 8, 8), C, normal(2, 4, 8), 1)
    assert condensed.T.shape[-1] == 1 + (7 - 3)
    assert_close(C @ condensed.T[:, :, 1:], torch.zeros(2, 6, 4).double())
    # The columns that the higher rank does without are zero, and their variables pinned.
    unused = (condensed.T[0, :, 1:] == 0).all(0)
    assert int(unused.sum()) == 3
    assert torch.linalg.eigvalsh(condensed.H).min() > 0.5


def test_elimination_of_an_mpc_scheme_is_its_prediction_form():
    n_x, n_u, N = 2, 1, 4
    A, B = torch.tensor([[1.0, 0.1], [0.0, 0.9]]).double(), torch.tensor([[0.0], [0.1]]).double()
    C = banded_matrix(A, B, N).unsqueeze(0)
    n_z = C.shape[-1]
    unit = torch.eye(n_z).double().unsqueeze(0)
    T = condense(unit, C, unit, n_x + n_u).T[0]
    y = normal(n_x + N * n_u)
    z = T @ y
    x = y[:n_x]
    for k in range(N):
        u = y[n_x + k : n_x + k + 1]
        assert_close(z[k * 3 : k * 3 + 3], torch.cat((x, u)))
        x = A @ x + B @ u
    assert_close(z[-n_x:], x)


@pytest.mark.parametrize("name", [*REGULAR, *DEFICIENT])
def test_expanded_variables_satisfy_the_equalities(name):
    C = (REGULAR | DEFICIENT)[name]
    known = known_qp(3, n_z=8, n_f=3, C=C, batch=(5,), hard=())
    programs, reduced = programs_of(known), reduced_of(known)
    v = normal(5, reduced.H.shape[-1])
    z = reduced.expand(programs, v)
    assert_close(z @ C.mT, known.qp.b)
    assert_close(z[:, :3], known.fixed)


@pytest.mark.parametrize("name", [*REGULAR, *DEFICIENT])
@pytest.mark.parametrize("n_f", [0, 3])
def test_equalities_of_any_rank_are_solved(name, n_f):
    C = (REGULAR | DEFICIENT)[name]
    known = known_qp(4, n_z=8, n_f=n_f, C=C, batch=(5,), hard=("inside",))
    solution = solve_qp(known.qp, known.fixed, solver="daqp")
    assert_close(solution.value, known.value)
    assert_close(solution.z, known.z, rtol=1e-5, atol=1e-6)


def test_a_batch_of_mixed_rank_is_solved():
    C = torch.stack((torch.cat((INDEPENDENT, normal(3, 8, seed=5))), REPEATED))
    known = known_qp(4, n_z=8, n_f=1, C=C, batch=(4, 2), matrices=(2,), hard=("inside",))
    solution = solve_qp(known.qp, known.fixed, solver="daqp")
    assert_close(solution.value, known.value)
    assert_close(solution.z, known.z, rtol=1e-5, atol=1e-6)


def test_a_rank_lost_to_the_kept_columns_is_regained_by_keeping_fewer():
    # Row 0 can be met by entries 0 to 2 only, so an elimination that keeps them cannot meet it.
    C = INDEPENDENT.clone()
    C[0, 3:] = 0
    known = known_qp(5, n_z=8, n_f=1, C=C, batch=(3,), hard=())
    solution = solve_qp(known.qp, known.fixed, solver="daqp", keep=3)
    assert_close(solution.z, known.z, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("name", ["dependent", "repeated", "many", "zero", "fixed only"])
def test_inconsistent_equalities_are_infeasible(name):
    known = known_qp(6, n_z=8, n_f=3, C=DEFICIENT[name], batch=(2,), hard=())
    b = known.qp.b + torch.tensor([[0.0], [1.0]]).double() * normal(known.qp.b.shape[-1])
    solution = solve_qp(replace(known.qp, b=b), known.fixed, solver="daqp", on_failure="mask")
    assert solution.status.tolist() == [Status.SOLVED, Status.INFEASIBLE]
    assert_close(solution.value[0], known.value[0])


def test_the_same_matrices_are_eliminated_once(eliminations):
    H, C, G = torch.eye(8).double().unsqueeze(0), normal(1, 3, 8, seed=10), normal(1, 2, 8)
    first = condense(H, C, G, 2)
    assert condense(H.clone(), C.clone(), G.clone(), 2) is first
    assert len(eliminations) == 1
    assert condense(H, C, G, 3) is not first
    assert len(eliminations) == 2


@pytest.mark.parametrize("changed", ["H", "C", "G"])
def test_matrices_changed_in_place_are_eliminated_again(changed):
    matrices = {
        "H": torch.eye(8).double()[None],
        "C": normal(1, 3, 8, seed=11),
        "G": normal(1, 2, 8),
    }
    before = condense(**matrices, keep=2)
    matrices[changed][0, 0, 0] += 1
    after = condense(**matrices, keep=2)
    assert after is not before
    assert_close(after.H, after.T.mT @ matrices["H"] @ after.T)
    assert_close(after.G, matrices["G"] @ after.T)
    assert_close(matrices["C"] @ after.T[:, :, 2:], torch.zeros(1, 3, 3).double())


def test_only_the_latest_eliminations_are_remembered(eliminations):
    H, G = torch.eye(8).double().unsqueeze(0), normal(1, 2, 8)
    C = [normal(1, 3, 8, seed=20 + i) for i in range(ContentMemo.SIZE + 1)]
    for matrix in C:
        condense(H, matrix, G, 2)
    assert len(eliminations) == ContentMemo.SIZE + 1
    condense(H, C[-1], G, 2)
    assert len(eliminations) == ContentMemo.SIZE + 1
    condense(H, C[0], G, 2)
    assert len(eliminations) == ContentMemo.SIZE + 2


def test_threads_do_not_share_what_they_remember(eliminations):
    matrices = torch.eye(8).double()[None], normal(1, 3, 8, seed=30), normal(1, 2, 8), 2
    here = condense(*matrices)
    with ThreadPoolExecutor(1) as pool:
        there = pool.submit(condense, *matrices).result()
    assert there is not here
    assert len(eliminations) == 2


def test_value_action_value_and_policy_share_one_elimination(eliminations):
    mpc = random_mpc(40)
    s, a = random_states(6), random_states(6, 1, size=0.5)
    for solve in (mpc.value, mpc.policy, lambda s: mpc.action_value(s, a)):
        solve(s)
    assert len(eliminations) == 1
    with torch.no_grad():
        mpc.C += 0.01
    mpc.action_value(s, a)
    mpc.value(s)
    assert len(eliminations) == 2


def test_the_answer_follows_parameters_changed_in_place():
    mpc, s = random_mpc(41), random_states(4)
    before = mpc.value(s)
    with torch.no_grad():
        mpc.C += 0.05 * normal(*mpc.C.shape)
    fresh = copy.deepcopy(mpc)
    assert (mpc.value(s) - before).abs().min() > 1e-6
    assert_close(mpc.value(s), fresh.value(s), rtol=0, atol=0)


def test_the_answer_follows_the_module_that_is_asked():
    online, s = random_mpc(42), random_states(4)
    target = copy.deepcopy(online)
    with torch.no_grad():
        online.C += 0.05 * normal(*online.C.shape)
    expected = [online.value(s), target.value(s)]
    assert (expected[0] - expected[1]).abs().min() > 1e-6
    for _ in range(2):
        assert_close([online.value(s), target.value(s)], expected, rtol=0, atol=0)


def test_the_answer_follows_the_parameters_of_a_functional_call():
    mpc, other, s = random_mpc(43), random_mpc(44), random_states(4)
    parameters = {name: part.detach() for name, part in other.named_parameters()}
    own = mpc.value(s)
    called = functional_call(mpc, parameters, (s,))
    assert_close(called, other.value(s), rtol=0, atol=0)
    assert (called - own).abs().min() > 1e-6
    assert_close(mpc.value(s), own, rtol=0, atol=0)


def test_a_row_of_any_scale_counts():
    """C z = b is the same whatever its rows are multiplied by."""
    known = known_qp(4)
    scale = torch.tensor([1.0, 1e-11, 1e9]).double()
    C, b = scale[:, None] * known.qp.C, scale * known.qp.b
    solution = solve_qp(replace(known.qp, C=C, b=b), known.fixed, solver="daqp")
    assert_close(solution.z, known.z, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("matrices", [(), (2,)])
@pytest.mark.parametrize("name", ["independent", "dependent", "zero"])
def test_other_eliminations_solve_the_same_equations(name, matrices):
    C = (REGULAR | DEFICIENT)[name]
    C = C.expand(*matrices, *C.shape)
    programs = programs_of(known_qp(0, batch=(2,), matrices=matrices, n_z=8, n_f=3, C=C))
    found = list(other_eliminations(programs))
    assert len(found) == (2 if name == "independent" else 1)
    for condensed in found:
        T, Y = condensed.T, -condensed.Y_neg
        b = programs.multiply(programs.C, programs.C.new_ones(len(programs), 8))
        assert_close(programs.C @ T, torch.zeros_like(programs.C @ T))
        if name == "independent":
            assert_close(programs.multiply(programs.C, programs.multiply(Y, b)), b)
        assert_close(T[:, :3, :3], torch.eye(3).double().expand(len(T), 3, 3))


def test_without_equations_there_is_nothing_to_eliminate_otherwise():
    known = known_qp(0, batch=(2,), n_z=8, n_f=3, C=NONE)
    assert list(other_eliminations(programs_of(known))) == []


def test_in_the_order_of_its_rows_C_gives_the_prediction_form():
    """However unstable the model is, x_k is that of the recursion, entry by entry."""
    horizon, A, B = 50, torch.tensor([[2.0, 0.1], [0.0, 1.5]]), torch.tensor([[0.3], [5.0]])
    C = banded_matrix(A.double(), B.double(), horizon)
    n_z = C.shape[1]
    qp = known_qp(0, batch=(1,), n_z=n_z, n_f=2, C=C, soft=(), hard=()).qp
    u = normal(horizon, seed=3)
    programs, _ = FlatPrograms.of(*qp.tensors(), torch.tensor([[1.0, -1.0]]).double())
    condensed = list(other_eliminations(programs))[1]
    actions = torch.arange(n_z) % 3 == 2
    assert (condensed.T[0, actions] != 0).sum(-1).eq(1).all()
    z = programs.multiply(condensed.T, torch.cat((programs.fixed, u[None]), -1))[0]
    x = programs.fixed[0]
    for k in range(horizon):
        x = A.double() @ x + B.double()[:, 0] * u[k]
        assert_close(z[3 * k + 3 : 3 * k + 5], x, rtol=1e-11, atol=0)


def test_a_prediction_beyond_float64_has_no_recursion():
    C = banded_matrix(1e20 * torch.eye(1).double(), torch.eye(1).double(), 20)
    known = known_qp(0, batch=(1,), n_z=41, n_f=1, C=C, soft=(), hard=())
    assert len(list(other_eliminations(programs_of(known)))) == 1
