"""QPMPC: what holds for each row of one table of settings, and what it refuses."""

import copy
import io
import itertools
import pickle
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from tests.mpc.settings import (
    A_D,
    B_D,
    GAMMA,
    LAST_ROWS,
    LINEAR,
    N_D,
    N_P,
    N_U,
    N_X,
    PREVIEWED,
    ROWS,
    SETTINGS,
    W_D,
    W_F,
    A,
    B,
    E,
    N,
    W,
    inputs,
    linear,
    made,
    n,
    previewed,
    stepped,
)
from tests.problems import (
    MIXED,
    central_difference,
    drawn_mpc,
    normal,
    random_mpc,
    random_states,
    step,
)
from tests.refused import refused
from torch_qpmpc import QPMPC, GaussNewton, QPError, QuadraticProgram, SolverError, Status, solve_qp
from torch_qpmpc.mpc.riccati import riccati_weight

# V, Q and the policy


@pytest.mark.parametrize("name", SETTINGS)
def test_the_value_is_the_least_action_value_and_that_of_the_policy(name):
    mpc = made(name)
    s, a = inputs(mpc, 12)
    V, Q = mpc(s), mpc(s, a)
    assert torch.equal(V, mpc.value(s))
    assert torch.equal(Q, mpc.action_value(s, a))
    bound = 1e-7 if name in PREVIEWED else 1e-6
    assert_close(mpc.action_value(s, mpc.policy(s).detach()), V, rtol=bound, atol=bound)
    assert (Q - V).min() > -bound
    assert (Q - V).max() > 1e-3


@pytest.mark.parametrize("horizon", [1, 3, 8])
@pytest.mark.parametrize("n_d", [0, N_D])
def test_without_active_bounds_it_is_the_linear_quadratic_regulator(horizon, n_d):
    options = {"E": E} if n_d else {}
    options |= {"gamma": 0.9, "hessian": "block", "solver": "daqp"}
    mpc = QPMPC.from_model(A, B, horizon, stage_weight=W, **options)
    P, s = riccati_weight(A, B, W, 0.9), random_states(5)
    p = torch.cat((torch.zeros(5, (horizon + 1) * n_d), s), -1)
    assert_close(mpc.value(p).detach(), 0.5 * ((s @ P) * s).sum(-1), rtol=1e-7, atol=1e-9)
    R = W[2:, 2:] + 0.9 * B.mT @ P @ B
    gain = torch.linalg.solve(R, W[2:, :2] + 0.9 * B.mT @ P @ A)
    assert_close(mpc.policy(p).detach(), -s @ gain.mT, rtol=1e-6, atol=1e-7)


def test_the_plan_follows_the_model_keeps_the_bounds_and_has_its_cost():
    mpc = previewed(free=0.0)
    p, _ = inputs(mpc)
    solution = mpc.solve(p)
    x, u = mpc.predicted(solution.z.detach())
    d = p[:, :-N_X].unflatten(-1, (N + 1, N_D))
    cost, slack = torch.zeros(len(p)).double(), torch.zeros(len(p)).double()
    rows, last_rows = (torch.tensor(part[0]).double() for part in (ROWS, LAST_ROWS))
    for k in range(N):
        following = x[:, k] @ A_D.mT + u[:, k] @ B_D.mT + d[:, k] @ E.mT
        assert_close(x[:, k + 1], following, rtol=0, atol=1e-9)
        stage = torch.cat((d[:, k], x[:, k], u[:, k]), -1)
        cost += 0.5 * GAMMA**k * ((stage @ W_D) * stage).sum(-1)
        y = stage @ rows.mT
        slack += 2.0 * ((y - 0.5).relu() + (-0.6 - y).relu()).sum(-1)
    last = torch.cat((d[:, N], x[:, N]), -1)
    cost += 0.5 * GAMMA**N * ((last @ W_F) * last).sum(-1)
    slack += 2.0 * ((last @ last_rows.mT).abs() - 0.4).relu().sum(-1)
    slack += 3.0 * (x.abs() - 1).relu().sum((-1, -2))
    assert_close(solution.value.detach(), cost + slack, rtol=1e-7, atol=1e-7)
    assert 0.6 - 1e-6 < u.abs().max() < 0.6 + 1e-8


def test_an_action_beyond_a_hard_bound_is_infeasible():
    s, a = random_states(2), torch.tensor([[0.4], [0.6]]).double()
    with pytest.raises(SolverError, match=r"1 of 2 .* 1 INFEASIBLE, first at batch index \(1,\)"):
        random_mpc(4).action_value(s, a)
    mpc = random_mpc(4, on_failure="mask")
    assert mpc.action_value(s, a).isinf().tolist() == [False, True]
    assert mpc.solve(s, a).status.tolist() == [Status.SOLVED, Status.INFEASIBLE]


# Derivatives

FUNCTIONS: dict[str, Callable[[QPMPC, Tensor, Tensor], Tensor]] = {
    "value": lambda mpc, p, _: mpc.value(p),
    "action value": lambda mpc, p, a: mpc.action_value(p, a),
    "solution": lambda mpc, p, _: mpc.solve(p).z @ normal(mpc.n_z, seed=9),
}


@pytest.mark.parametrize(
    ("name", "function"),
    [
        *itertools.product(PREVIEWED, ("action value", "solution")),
        *zip((*LINEAR, *PREVIEWED), itertools.cycle(("value", "action value")), strict=False),
        ("masked", "value"),
    ],
)
def test_gradients_in_theta_and_p_agree_with_differences(name, function):
    mpc = made(name, 2)
    p, a = inputs(mpc, 6 if name in LINEAR else 4)
    p.requires_grad_()
    FUNCTIONS[function](mpc, p, a).sum().backward()
    size = 1e-6 if mpc.solver == "daqp" and name in PREVIEWED else 1e-5
    atol = 1e-5 if name in LINEAR else 1e-4
    leaves = (*mpc.named_parameters(), ("p", p))
    assert len(leaves) > len(mpc.learned)
    for i, (leaf_name, leaf) in enumerate(leaves):
        direction = normal(*leaf.shape, seed=i)
        part = leaf_name.removeprefix("parametrizations.")[:2]
        if part in ("lb", "ub") and mpc.structure == "tied":  # those of hard rows are fixed
            first = mpc.get_buffer(f"{leaf_name.removesuffix('original')}0.first")
            direction = direction * mpc.soft[first]
        difference = central_difference(
            lambda: FUNCTIONS[function](mpc, p, a).sum(), leaf, direction, size
        )
        found = torch.zeros(()) if leaf.grad is None else (leaf.grad * direction).nan_to_num().sum()
        assert_close(
            found.double(), difference, rtol=1e-4, atol=atol, msg=lambda m, x=leaf_name: f"{x} {m}"
        )


# Shapes and dtypes


@pytest.mark.parametrize("dtype", [torch.float16, torch.float32, torch.float64])
@pytest.mark.parametrize("batch", [(), (0,), (2, 3)])
def test_outputs_have_the_batch_and_the_dtype_of_the_states(batch, dtype):
    mpc, s, a = random_mpc(6), 0.1 * torch.ones(*batch, 2, dtype=dtype), torch.zeros(1).double()
    outputs = mpc.value(s), mpc.action_value(s, a), mpc.policy(s)
    assert [out.shape for out in outputs] == [batch, batch, (*batch, 1)]
    assert {out.dtype for out in outputs} == {dtype}
    assert_close(outputs[0], mpc.value(s.double()).to(dtype))


# The program


@pytest.mark.parametrize("discounted", [False, True])
@pytest.mark.parametrize("hessian", ["diagonal", "block"])
def test_without_a_past_and_a_preview_it_is_the_papers_qp_to_the_last_bit(hessian, discounted):
    A, B = normal(N_X, N_X, seed=1), normal(N_X, N_U, seed=2)
    weights, last = torch.tensor([1.0, 0.5, 0.1]).double(), torch.tensor([2.0, 3.0]).double()
    D, D_f = normal(2, n, seed=3), normal(1, N_X, seed=4)
    mpc = QPMPC.from_model(
        A, B, N, gamma=GAMMA, hessian=hessian, stage_weight=weights, terminal_weight=last,
        offset=[0.1, 0.2], constraints=(D, [-1.0, -2.0], [1.0, 2.0]), discount_slack=discounted,
        terminal_constraints=(D_f, [-3.0], [3.0]), state_bounds=([-4.0] * 2, [5.0] * 2),
        action_bounds=([-6.0], [7.0]), state_slack=8.0, constraint_slack=9.0, learn=("q",),
    )  # fmt: skip
    with torch.no_grad():
        mpc.q.fill_(1.0)
    n_z = N * n + N_X
    shapes = (n_z,), (N * N_X, n_z), (n_z + 2 * N + 1, n_z)
    H, C, G = (torch.zeros(shape, dtype=torch.float64) for shape in shapes)
    powers = GAMMA ** torch.arange(N + 1).double()
    G[:n_z] = torch.eye(n_z)
    H[-N_X:], G[-1:, -N_X:] = last, D_f
    for k in range(N):
        rows, columns = slice(N_X * k, N_X * (k + 1)), slice(n * k, n * (k + 1))
        H[columns] = weights
        C[rows, columns] = torch.cat((A, B), -1)
        C[rows, n * (k + 1) : n * (k + 1) + N_X] = -torch.eye(N_X)
        G[n_z + 2 * k : n_z + 2 * k + 2, columns] = D
    stage = [*[0] * n, *[1] * n, *[2] * n, *[3] * N_X, 0, 0, 1, 1, 2, 2, 3]
    slack = torch.tensor([*[8.0, 8.0, torch.inf] * N, 8.0, 8.0, *[9.0] * 7]).double()
    discount = powers[stage[:n_z]]
    qp = mpc.quadratic_program()
    dense = discount.sqrt().unsqueeze(-1) * torch.diag(H) * discount.sqrt()
    expected = {
        "H": torch.diag(discount * H) if hessian == "diagonal" else dense,
        "q": discount,
        "c": torch.zeros(()).double(),
        "C": C,
        "b": -torch.tensor([0.1, 0.2] * N, dtype=torch.float64),
        "G": G,
        "lb": torch.tensor([*[-4.0, -4.0, -6.0] * N, -4, -4, *[-1, -2] * N, -3]).double(),
        "ub": torch.tensor([*[5.0, 5.0, 7.0] * N, 5, 5, *[1, 2] * N, 3]).double(),
        "w": slack * powers[stage] if discounted else slack,
    }
    for name, value in expected.items():
        assert torch.equal(getattr(qp, name), value), name
    assert (mpc.n_p, mpc.n_z) == (N_X, n_z)


def test_sizes_and_the_parts_of_z():
    mpc = previewed()
    p, a = inputs(mpc)
    assert (mpc.n_d, mpc.n_p, mpc.n_z) == (N_D, N_P, N_P + N * n)
    assert_close(mpc.solve(p).z[:, :N_P], p)
    assert_close(mpc.solve(p, a).z[:, : N_P + N_U], torch.cat((p, a), -1))
    assert_close(mpc.policy(p), mpc.solve(p).z[:, N_P : N_P + N_U])
    with pytest.raises(QPError, match=r"z: got shape \(6, 10\), expected shape \(\*batch, 19\)"):
        mpc.predicted(torch.ones(6, N_P))


def test_stages_may_have_weights_and_models_of_their_own():
    weights = torch.arange(1.0, 7.0).reshape(2, 3)
    mpc = QPMPC.from_model(
        torch.stack((A, 2 * A)), torch.stack((B, 3 * B)), 2, gamma=1.0, stage_weight=weights
    )
    assert_close(mpc.quadratic_program().H.diagonal()[:6], weights.flatten().double())
    assert_close(mpc.C[2:, 3:6], torch.cat((2 * A, 3 * B), 1))
    assert_close(mpc.C, mpc.C_0)


def test_readable_parts_are_the_model_and_the_rows():
    mpc = previewed(free=0.0, structure="tied")
    parts = mpc.readable()
    expected = {"A": A_D, "B": B_D, "E": E, "H": W_D, "H_f": W_F, "D": ROWS[0], "D_f": LAST_ROWS[0]}
    for name, value in expected.items():
        assert_close(parts[name], torch.as_tensor(value).double())
    assert_close(mpc.model(), (A_D, B_D, E))


def test_hard_rows_and_missing_bounds_leave_the_gradient_finite():
    mpc = random_mpc(
        9, free=0.0, learn=("w", "lb", "ub"), state_bounds=([-1.0, -torch.inf], [1, 1])
    )
    mpc.value(random_states(6)).sum().backward()
    for name, parameter in mpc.named_parameters():
        assert parameter.grad.isfinite().all(), name


# Learning


def test_parameter_groups_have_a_rate_for_each_part():
    mpc = random_mpc(10, learn=("H", "H_f", "c", "C", "b"))
    groups = mpc.parameter_groups({"cost": 0.1, "constraints": 0.01, "C": 0.02})
    rates = {group["name"]: group["lr"] for group in groups}
    assert rates == {"H": 0.1, "H_f": 0.1, "c": 0.1, "C": 0.02, "b": 0.01}
    owned = [parameter for group in groups for parameter in group["params"]]
    assert {id(parameter) for parameter in owned} == {id(part) for part in mpc.parameters()}
    for rates, message in (
        ({"cost": 0.1}, "rates: got nothing for C, expected a rate for every learned part"),
        ({"cost": 0.1, "constraint": 1.0}, r"rates: got \['constraint'\], expected names among"),
        ({"cost": 0.1, "constraints": 0.1, "dynamics": 0.1}, r"rates: got \['dynamics'\].* module"),
    ):
        with pytest.raises(QPError, match=message):
            mpc.parameter_groups(rates)


@pytest.mark.parametrize("name", LINEAR)
@pytest.mark.parametrize("second_order", [False, True])
def test_it_stays_a_linear_mpc_scheme_while_it_is_learned(name, second_order):
    mpc, s = made(name, 2), random_states(6)
    before = mpc.value(s).detach()
    if second_order:
        a = random_states(6, 1, size=0.2)
        GaussNewton(mpc).step(s, a, mpc.action_value(s, a).detach() + 0.01)
    else:
        step(mpc, rate=0.01)
    assert (mpc.value(s) - before).abs().max() > 1e-4
    A, B = mpc.model()
    row = torch.cat((A, B, -torch.eye(2).double()), 1)
    for k in range(4):
        assert_close(mpc.C[2 * k : 2 * k + 2, 3 * k : 3 * k + 5], row)
        assert mpc.C[2 * k : 2 * k + 2].count_nonzero() == row.count_nonzero()


@pytest.mark.parametrize("structure", ["free", "tied"])
def test_no_optimiser_moves_the_bounds_of_hard_rows(structure):
    """The limits of an actuator, for example."""
    mpc = linear(free=0.0, structure=structure)
    optimizer = torch.optim.AdamW(mpc.parameters(), lr=0.1, weight_decay=1.0)
    hard = torch.arange(mpc.n_z) % 3 == 2
    before = {name: getattr(mpc, name).detach().clone() for name in ("lb", "ub")}
    for _ in range(3):
        optimizer.zero_grad()
        mpc.value(torch.tensor([[3.0, 3.0], [-3.0, -3.0]]).double()).sum().backward()
        optimizer.step()
    for name, bounds in before.items():
        assert_close(getattr(mpc, name)[hard].detach(), bounds[hard], rtol=0, atol=0)
        assert not torch.equal(getattr(mpc, name)[~hard].detach(), bounds[~hard])


@pytest.mark.parametrize("step", ["projection", "sdp"])
def test_a_projection_changes_the_block_of_the_plan_alone(step):
    mpc = previewed(free=0.0, step=step)
    leaf = mpc.leaves("H")[0]
    with torch.no_grad():
        leaf -= 1.5 * torch.eye(leaf.shape[-1])
        before = leaf.clone()
        mpc.project_()
    assert torch.equal(leaf[:N_D], before[:N_D])
    assert torch.equal(leaf[:, :N_D], before[:, :N_D])
    assert torch.linalg.eigvalsh(before[N_D:, N_D:])[0] < -0.5
    assert torch.linalg.eigvalsh(leaf[N_D:, N_D:])[0] > -1e-9
    assert mpc.value(inputs(mpc)[0]).isfinite().all()


# Release


@pytest.mark.parametrize(
    "name", [x for x, (_, o) in SETTINGS.items() if x in LINEAR or "structure" in o]
)
def test_a_release_changes_neither_values_nor_policy(name):
    mpc = stepped(made(name, 3), rate=0.01)
    s, a = inputs(mpc, 50)
    before = [x.detach() for x in (mpc.value(s), mpc.action_value(s, a), mpc.policy(s))]
    program = [x.detach() for x in mpc.quadratic_program().tensors()]
    count = sum(parameter.numel() for parameter in mpc.parameters())
    for _ in range(2):  # the second changes nothing
        mpc.release()
        assert mpc.structure == "free"
        after = [x.detach() for x in (mpc.value(s), mpc.action_value(s, a), mpc.policy(s))]
        assert_close(after, before, rtol=0, atol=1e-9)
        assert_close([x.detach() for x in mpc.quadratic_program().tensors()], program)
    assert sum(parameter.numel() for parameter in mpc.parameters()) > count
    assert mpc.C.shape == mpc.C_0.shape


def test_released_entries_can_change():
    mpc, s = linear(4), random_states(6)
    mpc.release()
    assert dict(mpc.named_parameters())["C"].shape == mpc.C_0.shape
    outside = mpc.C == 0
    step(mpc, rate=0.01)
    assert (mpc.C[outside] != 0).any()
    mpc.value(s).sum().backward()
    assert (mpc.q.grad[:3] - mpc.q.grad[3:6]).abs().max() > 1e-3
    with pytest.raises(QPError, match="structure: got 'free', expected 'tied', which has"):
        mpc.model()


def test_the_parameters_order_survives_a_release_and_a_copy():
    """An optimiser loads its state by that order."""
    mpc = drawn_mpc(1, 1, 3, structure="tied", step="projection", learn=("q", "b", "w", "c"))
    mpc.release()
    twin = copy.deepcopy(mpc)
    assert [name for name, _ in mpc.named_parameters()] == ["q", "c", "b", "w"]
    assert [name for name, _ in twin.named_parameters()] == ["q", "c", "b", "w"]


def test_frozen_parameters_stay_frozen():
    mpc = linear(7)
    for name, parameter in mpc.named_parameters():
        if name.split(".")[1:2] in (["C"], ["q"]):
            parameter.requires_grad_(False)
    mpc.release()
    frozen = {name for name, p in mpc.named_parameters() if not p.requires_grad}
    assert frozen == {"C", "q"}


# Copies, pickles and checkpoints


def pickled(content: Any) -> Any:
    return pickle.loads(pickle.dumps(content))


def without_values(mpc: QPMPC) -> QPMPC:
    """TorchRL sends policies to workers on the meta device, with separate weights."""
    twin = pickled(copy.deepcopy(mpc).to("meta")).to_empty(device="cpu")
    twin.load_state_dict(mpc.state_dict())
    return twin


def from_file(mpc: QPMPC, folder: Path) -> QPMPC:
    mpc.save(folder / "mine.qpmpc")
    return QPMPC.load(str(folder / "mine.qpmpc"))


def from_checkpoint(mpc: QPMPC, name: str) -> QPMPC:
    other, file = made(name, 14), io.BytesIO()
    torch.save(mpc.state_dict(), file)
    file.seek(0)
    other.load_state_dict(torch.load(file, weights_only=True))
    return other


#: Settings that files keep in different ways.
KEPT = ("masked", "tied, mixed", "projected block", "tied, diagonal", "preview, tied", "no bounds")


@pytest.mark.parametrize(
    ("name", "way"),
    [*zip(KEPT, itertools.cycle((copy.deepcopy, pickled, without_values)), strict=False)],
)
def test_twins_give_the_same_answers_and_are_independent(tmp_path, name, way):
    """Files and checkpoints know the settings; the ways of a copy do not."""
    mpc = stepped(made(name, 12))
    s, _ = inputs(mpc)
    before, state = mpc.value(s), mpc.state_dict()
    for twin in (way(mpc), from_file(mpc, tmp_path), from_checkpoint(mpc, name)):
        assert_close(twin.value(s), before, rtol=0, atol=0)
        assert_close(twin.state_dict(), state, rtol=0, atol=0)
        assert (twin.structure, twin.step, twin.learned) == (mpc.structure, mpc.step, mpc.learned)
        assert (twin.n_d, twin.n_p) == (mpc.n_d, mpc.n_p)
        stepped(twin, rate=0.01)
        assert (twin.value(s) - before).abs().max() > 1e-6
        twin.reset_parameters()
    assert_close(mpc.value(s), before, rtol=0, atol=0)
    mpc.reset_parameters()
    assert_close(mpc.state_dict(), made(name, 12, free=0.0).state_dict(), rtol=0, atol=0)


@pytest.mark.parametrize("copied", [copy.deepcopy, pickled])
@pytest.mark.parametrize("learn", [("H", "C"), ("C",), ()])
def test_a_copy_keeps_mode_dtype_and_what_is_frozen(copied, learn):
    mpc, s = random_mpc(12, learn=learn), random_states(4).float()
    expected = mpc.value(s)
    mpc.float().eval().requires_grad_(False)
    twin = copied(mpc)
    assert not twin.training
    assert not any(part.requires_grad for part in twin.parameters())
    assert all(part.dtype == torch.float32 for part in twin.parameters())
    assert_close(twin.value(s), mpc.value(s), rtol=0, atol=0)
    assert_close(mpc.value(s), expected, rtol=1e-4, atol=1e-4)
    assert repr(twin) == repr(mpc)


@pytest.mark.parametrize("copied", [copy.deepcopy, pickled])
@pytest.mark.parametrize("learn", [("H", "C"), ("C",)])
def test_an_optimiser_copied_with_its_qp_moves_the_copy(copied, learn):
    mpc, s = random_mpc(12, learn=learn), random_states(4)
    twin, optimizer = copied((mpc, torch.optim.SGD(mpc.parameters(), lr=0.01)))
    before = twin.value(s)
    before.sum().backward()
    optimizer.step()
    assert (twin.value(s) - before).abs().max() > 1e-6
    assert_close(mpc.value(s), before)


# An H that is indefinite on what is known


def program(H: Tensor, n_known: int) -> QuadraticProgram:
    return QuadraticProgram(H, torch.zeros(2).double(), n_known=n_known)


def test_an_indefinite_block_of_what_is_known_is_accepted():
    assert torch.linalg.eigvalsh(previewed(free=0.0).quadratic_program().H)[0] < -1
    H = torch.tensor([[-2.0, 1.0], [1.0, 4.0]]).double()
    fixed = torch.tensor([[3.0]]).double()
    solution = solve_qp(program(H, 1), fixed, solver="daqp")
    assert_close(solution.z, torch.tensor([[3.0, -0.75]]).double())
    assert_close(solution.value, torch.tensor([-9.0 - 9 / 8]).double())


def test_an_indefinite_block_of_the_plan_is_refused():
    H = torch.tensor([[-2.0, 1.0], [1.0, 4.0]]).double()
    with pytest.raises(QPError, match=r"H: got smallest eigenvalue -2.* pass n_known if the first"):
        program(H, 0)
    with pytest.raises(QPError, match="H: got smallest eigenvalue -2, expected a positive semi"):
        program(H.flip(0, 1), 1)
    with pytest.raises(QPError, match="n_known: got -1, expected a whole number >= 0"):
        program(H, -1)
    mpc = previewed(step="projection")
    with torch.no_grad():
        mpc.leaves("H")[0][-1, -1] = -5.0
    with pytest.raises(QPError, match="6 INVALID_DATA"):
        mpc.value(inputs(mpc)[0])


# Bad input

STAGES = torch.ones(3, 1, 1).cumsum(0)
MODEL: dict[str, Any] = {"A": A, "B": B, "hessian": "block", "stage_weight": W}


@refused(
    ({"learn": "HC"}, "learn: got 'HC', expected a collection of names among H, H_f, q"),
    ({"structure": "banded"}, "structure: got 'banded', expected one of free, tied"),
    ({"structure": "tied", "learn": ["G"]}, "learn: got 'G' without constraints, expected other p"),
    (
        {"structure": "tied", "A": torch.eye(2) * STAGES, "B": torch.ones(2, 1)},
        "C: got entries that break the structure of a linear MPC scheme, expected entries",
    ),
    ({"on_failure": "skip"}, "on_failure: got 'skip', expected one of raise, warn, mask"),
    ({"solver": "proxq"}, r"solver: got 'proxq', expected one of .* Did you mean 'proxqp'\?"),
    (
        {**MODEL, "stage_weight": W.expand(3, 3, 3), "terminal_weight": "riccati"},
        r"stage_weight: got shape \(3, 3, 3\), expected shape \(3, 3\). The Riccati equation",
    ),
    ({"A": torch.eye(3)}, r"A, B: got shapes \(3, 3\) and \(2, 1\), expected \(n_x, n_x\) and \(n"),
    ({"E": B}, r"E: got shape \(2, 1\), expected \(2, 0\). It multiplies the prev"),
    (
        {"n_d": 2, "hessian": "block", "stage_weight": -W_D},
        "stage_weight: got smallest eigenvalue -2.* expected a positive semidefinite weight",
    ),
)
def test_bad_arguments_are_named(options):
    drawn_mpc(2, 1, 3, **options)


@pytest.mark.parametrize(
    ("part", "index"), [("C", (0, 6)), ("b", 0), ("lb", 3), ("G", (-1, 0)), ("G", (0, 1))]
)
def test_assigning_what_the_stages_do_not_share_is_refused(part, index):
    mpc = linear(free=0.0, **MIXED)
    value: Tensor = getattr(mpc, part).detach().clone()
    value[index] = 0.5
    with pytest.raises(QPError, match=rf"{part}: got entries .* Call release\(\) first"):
        setattr(mpc, part, value)


@pytest.mark.parametrize("kind", [">f8", "g", "f4", "i8"])
def test_predict_takes_any_array_of_numbers(kind):
    mpc = QPMPC.from_model([[0.9]], [[0.5]], 3, stage_weight=[1.0, 0.1], solver="daqp")
    s = np.array([[1.0], [2.0], [-3.0]])
    for given in (s[::-1].astype(kind)[::-1], s.astype(kind)):
        given.flags.writeable = False
        with warnings.catch_warnings(action="error"):
            np.testing.assert_allclose(mpc.predict(given), mpc.predict(s), rtol=1e-6)
    with pytest.raises(QPError, match=r"observation: got ndarray, expected real numbers of shape"):
        mpc.predict(s + 1j)
