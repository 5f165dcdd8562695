"""A QP with a window of the past and a preview: its form, its gradients, and the paper's form."""

from __future__ import annotations

import copy
import io
import pickle
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.func import grad, jacrev, vmap
from torch.testing import assert_close

from tests.problems import normal, random_mpc, random_states
from torch_qpmpc import QPMPC, QPError, QuadraticProgram, solve_qp
from torch_qpmpc.mpc.riccati import riccati_weight
from torch_qpmpc.mpc.validation import CONSTRAINTS, COST

N, N_X, N_U, N_D, L = 3, 2, 1, 2, 3
n = N_X + N_U
N_P = (N + 1) * N_D + (L - 1) * n + N_X
LAST_U = N_P - N_X - N_U  # u_{-1} in p
PRICE, REFERENCE, U = 0, 1, N_D + N_X  # entries of (d_k, x_k, u_k)
GAMMA = 0.9

A = 0.2 * normal(N_X, L * N_X, seed=1) + 0.5 * torch.eye(N_X, L * N_X)
B, E = 0.5 * normal(N_X, L * N_U, seed=2), 0.3 * normal(N_X, N_D, seed=3)
W, W_F = torch.zeros(N_D + n, N_D + n).double(), torch.zeros(N_D + N_X, N_D + N_X).double()
W[N_D:, N_D:] = torch.tensor([[1.0, 0.1, 0.0], [0.1, 2.0, 0.1], [0.0, 0.1, 0.5]])
W_F[N_D:, N_D:] = torch.eye(N_X)
W[PRICE, U] = W[U, PRICE] = 0.7
for weight in (W, W_F):  # of a reference of x's first entry, less the square of the reference
    weight[REFERENCE, N_D] = weight[N_D, REFERENCE] = -1.0
W[PRICE, PRICE] = -3.0
#: A bound of x's second entry that is an entry of d_k, with some u_k.
ROWS = ([[0.0, 1.0, 0.0, 1.0, 0.5]], [-0.6], [0.5])
LAST_ROWS = ([[0.0, 0.5, 1.0, 0.0]], [-0.4], [0.4])
SETTINGS: dict[str, Any] = {
    "E": E,
    "gamma": GAMMA,
    "hessian": "block",
    "stage_weight": W,
    "terminal_weight": W_F,
    "constraints": ROWS,
    "terminal_constraints": LAST_ROWS,
    "state_bounds": ([-1.0] * N_X, [1.0] * N_X),
    "action_bounds": ([-0.6], [0.6]),
    "rate_bounds": ([-0.4], [0.4]),
    "constraint_slack": 2.0,
    "state_slack": 3.0,
    "solver": "daqp",
    "learn": (*COST, *CONSTRAINTS),
}


def make(seed: int = 0, free: float = 0.05, **options: Any) -> QPMPC:
    """Make a QP with past=3 and n_d=2, and shift theta by up to ``free``."""
    settings = SETTINGS | options
    if settings["hessian"] == "diagonal":
        settings |= {"stage_weight": [1.0, 2.0, 0.5], "terminal_weight": [1.0, 1.0]}
    if settings["hessian"] == "full" and "learn" not in options:
        settings["learn"] = [part for part in settings["learn"] if part != "H_f"]
    mpc = QPMPC.from_model(A, B, N, **settings)
    with torch.no_grad():
        for i, parameter in enumerate(mpc.parameters()):
            parameter += free * normal(*parameter.shape, seed=10 * seed + i).tanh()
    mpc.project_()
    return mpc


def known(count: int = 6, seed: int = 5) -> tuple[Tensor, Tensor]:
    """Draw p and actions that keep the hard bounds of u_0 and of its change."""
    p, share = normal(count, N_P, seed=seed), normal(count, 1, seed=seed + 1).tanh()
    p[:, LAST_U] = 0.3 * p[:, LAST_U].tanh()
    return p, p[:, LAST_U : LAST_U + 1] + 0.15 * share


def functions(mpc: QPMPC, a: Tensor) -> dict[str, Callable[[Tensor], Tensor]]:
    return {
        "value": mpc.value,
        "action value": lambda p: mpc.action_value(p, a),
        "solution": lambda p: mpc.solve(p).z @ normal(mpc.n_z, seed=9),
    }


# The form


def test_sizes_and_the_parts_of_z():
    mpc = make()
    assert (mpc.past, mpc.n_d, mpc.n_p, mpc.n_z) == (L, N_D, N_P, N_P + N * n)
    assert "past=3, n_d=2" in repr(mpc)
    p, a = known()
    assert_close(mpc.solve(p).z[:, :N_P], p)
    assert_close(mpc.solve(p, a).z[:, : N_P + N_U], torch.cat((p, a), -1))
    assert_close(mpc.policy(p), mpc.solve(p).z[:, N_P : N_P + N_U])
    assert [tuple(part.shape) for part in make(structure="tied").model()] == [
        (2, 6),
        (2, 3),
        (2, 2),
    ]


@pytest.mark.parametrize("hessian", ["block", "full"])
def test_the_plan_follows_the_model_keeps_the_bounds_and_has_its_cost(hessian):
    mpc, (p, _) = make(free=0.0, hessian=hessian), known()
    solution = mpc.solve(p)
    x, u = mpc.predicted(solution.z.detach())
    d, window = p[:, : (N + 1) * N_D].unflatten(-1, (N + 1, N_D)), p[:, (N + 1) * N_D :]
    pairs = window[:, :-N_X].unflatten(-1, (L - 1, n))
    past_x, past_u = torch.cat((pairs[..., :N_X], x), 1), torch.cat((pairs[..., N_X:], u), 1)
    cost, slack = torch.zeros(len(p)).double(), torch.zeros(len(p)).double()
    rows, last_rows = (torch.tensor(part[0]).double() for part in (ROWS, LAST_ROWS))
    for k in range(N):
        lags_x, lags_u = (y[:, k : k + L].flip(1).flatten(1) for y in (past_x, past_u))
        following = lags_x @ A.mT + lags_u @ B.mT + d[:, k] @ E.mT
        assert_close(x[:, k + 1], following, rtol=0, atol=1e-9)
        stage = torch.cat((d[:, k], x[:, k], u[:, k]), -1)
        cost += 0.5 * GAMMA**k * ((stage @ W) * stage).sum(-1)
        y = stage @ rows.mT
        slack += 2.0 * ((y - 0.5).relu() + (-0.6 - y).relu()).sum(-1)
    last = torch.cat((d[:, N], x[:, N]), -1)
    cost += 0.5 * GAMMA**N * ((last @ W_F) * last).sum(-1)
    slack += 2.0 * ((last @ last_rows.mT).abs() - 0.4).relu().sum(-1)
    slack += 3.0 * (x.abs() - 1).relu().sum((-1, -2))
    assert_close(solution.value.detach(), cost + slack, rtol=1e-7, atol=1e-7)
    change = past_u[:, L - 1 :] - past_u[:, L - 2 : -1]
    assert u.abs().max() < 0.6 + 1e-8
    assert 0.4 - 1e-6 < change.abs().max() < 0.4 + 1e-8


@pytest.mark.parametrize("structure", ["free", "tied", "varying"])
@pytest.mark.parametrize("hessian", ["diagonal", "block", "full"])
def test_the_value_is_the_least_action_value(structure, hessian):
    mpc, (p, a) = make(1, structure=structure, hessian=hessian), known()
    V = mpc.value(p)
    assert_close(mpc.action_value(p, mpc.policy(p).detach()), V, rtol=1e-7, atol=1e-7)
    advantage = mpc.action_value(p, a) - V
    assert advantage.min() > -1e-7
    assert advantage.max() > 1e-3


def test_a_rate_that_the_window_makes_impossible_is_infeasible():
    mpc, (p, _) = make(on_failure="mask"), known()
    p[2, LAST_U] = 5.0
    assert mpc.value(p).isinf().tolist() == [i == 2 for i in range(6)]


# Gradients


@pytest.mark.parametrize("function", ["value", "action value", "solution"])
@pytest.mark.parametrize(
    ("structure", "hessian", "step", "solver"),
    [
        *(
            (s, h, "cholesky", "daqp")
            for s in ("free", "tied", "varying")
            for h in ("block", "full")
        ),
        ("free", "diagonal", "cholesky", "daqp"),
        ("tied", "diagonal", "projection", "daqp"),
        ("free", "block", "sdp", "daqp"),
        ("varying", "full", "projection", "daqp"),
        ("tied", "block", "projection", "proxqp"),
        ("free", "block", "cholesky", "torch"),
    ],
)
def test_gradients_in_theta_and_p_agree_with_differences(
    structure, hessian, step, solver, function
):
    mpc = make(2, structure=structure, hessian=hessian, step=step, solver=solver)
    p, a = known(4)
    p.requires_grad_()
    total = functions(mpc, a)[function]
    total(p).sum().backward()
    step_size = 1e-6 if solver == "daqp" else 1e-5
    leaves = (*mpc.named_parameters(), ("p", p))
    assert len(leaves) > len(mpc.learned)
    for i, (name, leaf) in enumerate(leaves):
        direction = normal(*leaf.shape, seed=i)
        if name.removeprefix("parametrizations.")[:2] in ("lb", "ub") and structure != "free":
            learned = mpc.soft  # those of hard rows are no parameters
            if structure == "tied":
                learned = learned[mpc.get_buffer(f"{name.removesuffix('original')}0.first")]
            direction = direction * learned
        values = []
        with torch.no_grad():
            for sign in (1, -2):
                leaf += sign * step_size * direction
                values.append(total(p).sum())
            leaf += step_size * direction
        difference = (values[0] - values[1]) / (2 * step_size)
        found = torch.zeros(()) if leaf.grad is None else (leaf.grad * direction).nan_to_num().sum()
        assert_close(
            found.double(), difference, rtol=1e-4, atol=1e-4, msg=lambda m, i=name: f"{i} {m}"
        )


def test_the_slope_in_prices_and_references_is_that_of_the_plan():
    plain = {"E": 0 * E, "constraints": None, "terminal_constraints": None}
    mpc, (p, _) = make(free=0.0, **plain), known()
    solution = mpc.solve(p)
    x, u = mpc.predicted(solution.z.detach())
    slope = grad(lambda p: mpc.value(p).sum())(p)
    assert_close(slope, -solution.xi.detach())
    d = p[:, : (N + 1) * N_D].unflatten(-1, (N + 1, N_D))
    stages = torch.cat((d[:, :N], x[:, :N], u), -1) @ W[:, :N_D]
    last = torch.cat((d[:, N], x[:, N]), -1) @ W_F[:, :N_D]
    expected = torch.cat((stages, last.unsqueeze(1)), 1)
    expected = expected * GAMMA ** torch.arange(N + 1).double().unsqueeze(-1)
    assert_close(slope[:, : (N + 1) * N_D], expected.flatten(1), rtol=1e-7, atol=1e-7)


# The paper's form


@pytest.mark.parametrize("hessian", ["diagonal", "block", "full"])
@pytest.mark.parametrize("explicit", [{}, {"past": 1, "n_d": 0}])
def test_without_a_past_and_a_preview_it_is_the_papers_qp_to_the_last_bit(hessian, explicit):
    A, B = normal(N_X, N_X, seed=1), normal(N_X, N_U, seed=2)
    weights, last = torch.tensor([1.0, 0.5, 0.1]).double(), torch.tensor([2.0, 3.0]).double()
    D, D_f = normal(2, n, seed=3), normal(1, N_X, seed=4)
    mpc = QPMPC.from_model(
        A, B, N, gamma=GAMMA, hessian=hessian, stage_weight=weights, terminal_weight=last,
        offset=[0.1, 0.2], constraints=(D, [-1.0, -2.0], [1.0, 2.0]), discount_slack=True,
        terminal_constraints=(D_f, [-3.0], [3.0]), state_bounds=([-4.0] * 2, [5.0] * 2),
        action_bounds=([-6.0], [7.0]), state_slack=8.0, constraint_slack=9.0, learn=(), **explicit,
    )  # fmt: skip
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
        "q": torch.zeros(n_z).double(),
        "c": torch.zeros(()).double(),
        "C": C,
        "b": -torch.tensor([0.1, 0.2] * N, dtype=torch.float64),
        "G": G,
        "lb": torch.tensor([*[-4.0, -4.0, -6.0] * N, -4, -4, *[-1, -2] * N, -3]).double(),
        "ub": torch.tensor([*[5.0, 5.0, 7.0] * N, 5, 5, *[1, 2] * N, 3]).double(),
        "w": slack * powers[stage],
    }
    for name, value in expected.items():
        assert torch.equal(getattr(qp, name), value), name
    assert (mpc.n_p, mpc.n_z) == (N_X, n_z)
    assert "past" not in repr(mpc)


def test_a_window_and_a_preview_that_do_not_matter_change_no_value():
    one = random_mpc(free=0.0, learn=())
    A, B = one.C[:2, :2], one.C[:2, 2:3]
    settings = {"state_bounds": ([-1.0] * 2, [1.0] * 2), "action_bounds": ([-0.5], [0.5])}
    more = QPMPC.from_model(
        torch.cat((A, 0 * A), -1), torch.cat((B, 0 * B), -1), 3, n_d=2,
        stage_weight=[1.0, 0.5, 0.1], terminal_weight=[1.0, 1.0], solver="daqp", **settings,
    )  # fmt: skip
    s = random_states(8)
    p = torch.cat((normal(8, more.n_p - 2), s), -1)
    assert_close(more.value(p), one.value(s), rtol=1e-9, atol=1e-9)
    assert_close(more.policy(p), one.policy(s), rtol=1e-7, atol=1e-7)


def test_with_a_preview_of_zeros_it_is_the_linear_quadratic_regulator():
    A_1, B_1 = A[:, :N_X], B[:, :N_U]
    mpc = QPMPC.linear_mpc(A_1, B_1, 5, E=E, stage_weight=[1.0] * n, gamma=GAMMA, solver="daqp")
    P, s = riccati_weight(A_1, B_1, torch.eye(n).double(), GAMMA), random_states(4)
    p = torch.cat((torch.zeros(4, 6 * N_D), s), -1)
    assert_close(mpc.value(p).detach(), 0.5 * ((s @ P) * s).sum(-1))
    assert "G" not in mpc.learned
    assert tuple(mpc.H.shape) == (N_D + n, N_D + n)


# The module


@pytest.mark.parametrize("hessian", ["block", "full"])
@pytest.mark.parametrize("way", [("free",), ("varying", "free")])
def test_a_release_changes_no_value(way, hessian):
    mpc, (p, a) = make(3, structure="tied", hessian=hessian), known()
    before = [x.detach() for x in (mpc.value(p), mpc.action_value(p, a), mpc.policy(p))]
    program = [x.detach() for x in mpc.quadratic_program().tensors()]
    count = sum(x.numel() for x in mpc.parameters())
    for structure in way:
        mpc.release(structure)
        after = [x.detach() for x in (mpc.value(p), mpc.action_value(p, a), mpc.policy(p))]
        assert_close(after, before, rtol=0, atol=1e-9)
        assert_close([x.detach() for x in mpc.quadratic_program().tensors()], program)
        assert (count := count) < (count := sum(x.numel() for x in mpc.parameters()))
    assert mpc.C.shape == mpc.C_0.shape


def test_readable_parts_are_the_model_and_the_rows():
    parts = make(free=0.0, structure="tied").readable()
    for name, expected in (("A", A), ("B", B), ("E", E), ("H", W), ("H_f", W_F)):
        assert_close(parts[name], expected)
    assert_close(parts["D"], torch.tensor(ROWS[0]).double())
    assert_close(parts["D_f"], torch.tensor(LAST_ROWS[0]).double())


@pytest.mark.parametrize("structure", ["free", "tied", "varying"])
def test_copies_and_saved_states_have_the_same_values(structure):
    mpc, (p, _) = make(4, structure=structure), known()
    V = mpc.value(p)
    file = io.BytesIO()
    torch.save(mpc.state_dict(), file)
    file.seek(0)
    other = make(5, structure=structure)
    other.load_state_dict(torch.load(file))
    for twin in (pickle.loads(pickle.dumps(mpc)), copy.deepcopy(mpc), other):
        assert (twin.past, twin.n_d, twin.n_p) == (L, N_D, N_P)
        assert_close(twin.value(p), V, rtol=0, atol=0)
    mpc.reset_parameters()
    assert_close(mpc.value(p), make(free=0.0, structure=structure).value(p), rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("sizes", "message"),
    [
        ({"past": 2, "n_d": 0}, "state_dict: got a state_dict with past = 2, .* this module's 1"),
        ({"past": 1, "n_d": 1}, "state_dict: got a state_dict with n_d = 1, .* this module's 0"),
    ],
)
def test_a_state_of_another_prefix_is_refused(sizes, message):
    with pytest.raises(QPError, match=message):
        QPMPC.of(2, 1, 3).load_state_dict(QPMPC.of(2, 1, 3, **sizes).state_dict())


def test_only_the_entries_of_a_mask_are_learned():
    start = make(free=0.0)
    masks = {"C": start.C_0 != 0, "q": torch.arange(start.n_z) >= N_P}
    mpc, (p, _) = make(free=0.0, learn=masks), known()
    optimizer = torch.optim.SGD(mpc.parameters(), lr=0.01)
    mpc.value(p).sum().backward()
    optimizer.step()
    for part, mask in masks.items():
        moved = getattr(mpc, part) != getattr(start, part)
        assert not moved[~mask].any()
        assert moved[mask].any()


def test_a_mask_of_a_tied_model_is_the_same_for_all_stages():
    start = make(free=0.0)
    band = start.C_0 != 0
    tied = make(free=0.0, structure="tied", learn={"C": band})
    assert tied.learned == ("C",)
    band[0, : (N + 1) * N_D] = False  # E of the first stage alone
    with pytest.raises(QPError, match=r"learn\['C'\]: got a mask that differs between stages"):
        make(structure="tied", learn={"C": band})


@pytest.mark.parametrize("step", ["projection", "sdp"])
@pytest.mark.parametrize("hessian", ["block", "full"])
def test_a_projection_changes_the_block_of_the_plan_alone(step, hessian):
    mpc, (p, _) = make(free=0.0, step=step, hessian=hessian), known()
    leaf = mpc.leaves("H")[0]
    with torch.no_grad():
        leaf -= 1.5 * torch.eye(leaf.shape[-1])
        before = leaf.clone()
        mpc.project_()
    free = N_P - N_X if hessian == "full" else N_D
    assert torch.equal(leaf[:free], before[:free])
    assert torch.equal(leaf[:, :free], before[:, :free])
    assert torch.linalg.eigvalsh(before[free:, free:])[0] < -0.5
    assert torch.linalg.eigvalsh(leaf[free:, free:])[0] > -1e-9
    assert mpc.value(p).isfinite().all()


def test_single_precision_inputs():
    mpc, (p, a) = make(6), known()
    for function in (mpc.value, mpc.policy, lambda p: mpc.action_value(p, a.float())):
        found = function(p.float())
        assert found.dtype == torch.float32
    assert_close(mpc.value(p.float()), mpc.value(p).float(), rtol=1e-5, atol=1e-5)
    assert_close(mpc.float().policy(p.float()), make(6).policy(p).float(), rtol=1e-4, atol=1e-4)


def test_vmap_equals_the_batch():
    mpc, (p, a) = make(7), known()
    assert_close(vmap(mpc.value)(p), mpc.value(p))
    assert_close(vmap(mpc.action_value)(p, a), mpc.action_value(p, a))
    assert_close(vmap(mpc.policy)(p), mpc.policy(p))
    leaf = p.clone().requires_grad_()
    (slope,) = torch.autograd.grad(mpc.value(leaf).sum(), leaf)
    assert_close(vmap(grad(mpc.value))(p), slope)
    assert vmap(jacrev(mpc.policy))(p).shape == (6, N_U, N_P)


# An H that is indefinite on what is known


def program(H: Tensor, n_known: int) -> QuadraticProgram:
    """Make a QP in two variables without constraints."""
    none, one = torch.zeros(0).double(), torch.zeros(()).double()
    zeros = torch.zeros(0, 2).double()
    return QuadraticProgram(
        H, torch.zeros(2).double(), one, zeros, none, zeros, none, none, none, n_known=n_known
    )


def test_an_indefinite_block_of_what_is_known_is_accepted():
    assert torch.linalg.eigvalsh(make(free=0.0).quadratic_program().H)[0] < -1
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
    mpc, (p, _) = make(step="projection"), known()
    with torch.no_grad():
        mpc.leaves("H")[0][-1, -1] = -5.0
    with pytest.raises(QPError, match="6 INVALID_DATA"):
        mpc.value(p)


# Bad arguments


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"past": 1, "rate_bounds": ([-1.0], [1.0])},
            r"rate_bounds: got bounds with past=1, expected past >= 2. The window then holds u_",
        ),
        ({"past": 2, "rate_bounds": ([-1.0] * 2, [1.0] * 2)}, r"rate_bounds: got shape \(2,\)"),
        (
            {"past": 2, "rate_bounds": ([-1.0], [1.0]), "rate_slack": -1.0},
            "rate_slack: got -1.0, expected a non-negative weight",
        ),
        (
            {"past": 2, "rate_slack": 2.0},
            "rate_slack: got 2.0, expected inf without rate_bounds. It is the price of violating",
        ),
        (
            {"past": 3, "A": torch.eye(2)},
            r"A, B: got shapes \(2, 2\) and .*, expected \(2, 6\) and \(2, 3\). \[A_1, .., A_L\]",
        ),
        (
            {"past": 2, "B": torch.ones(2, 1)},
            r"A, B: got .* \(2, 1\), expected \(2, 4\) and \(2, 2\)",
        ),
        (
            {"E": torch.ones(2, 1)},
            r"E: got shape \(2, 1\), expected \(2, 0\). It multiplies the prev",
        ),
        ({"n_d": 2, "E": torch.ones(1, 2)}, r"E: got shape \(1, 2\), expected \(2, 2\)"),
        ({"n_d": 1, "E": [[torch.nan], [1.0]]}, "E: got NaN or inf, expected finite entries"),
        (
            {"past": 2, "hessian": "block", "terminal_weight": "riccati"},
            "terminal_weight: got 'riccati' with past > 1, expected past=1. Pass a matrix",
        ),
        (
            {"n_d": 2, "hessian": "block", "stage_weight": -W},
            "stage_weight: got smallest eigenvalue -2.* expected a positive semidefinite weight",
        ),
        (
            {"n_d": 2, "hessian": "block", "stage_weight": W.triu()},
            r"stage_weight: got asymmetry 1, expected a symmetric matrix",
        ),
        (
            {"n_d": 2, "stage_weight": W},
            r"stage_weight: got shape \(5, 5\), expected shape \(3,\) or \(3, 3\)",
        ),
        (
            {"n_d": 2, "hessian": "block", "terminal_weight": -W_F},
            "terminal_weight: got smallest eigenvalue -1",
        ),
        (
            {"n_d": 1, "constraints": ([[1.0, 1.0, 1.0]], [0.0], [1.0])},
            r"constraints: got D of shape \(1, 3\), expected shape \(m, 4\)",
        ),
        (
            {"n_d": 1, "terminal_constraints": ([[1.0, 1.0]], [0.0], [1.0])},
            r"terminal_constraints: got D of shape \(1, 2\), expected shape \(m, 3\)",
        ),
    ],
)
def test_bad_arguments_are_named(options, message):
    with pytest.raises(QPError, match=message):
        QPMPC.of(2, 1, 3, **options)


def test_inputs_of_another_size_are_named():
    mpc, (p, _) = make(), known()
    with pytest.raises(QPError, match=r"s: got shape \(6, 2\), expected shape \(\*batch, 16\)"):
        mpc.value(p[:, -2:])
    with pytest.raises(QPError, match=r"a: got shape \(6, 16\), expected shape \(\*batch, 1\)"):
        mpc.action_value(p, p)
    with pytest.raises(QPError, match=r"z: got shape \(6, 16\), expected shape \(\*batch, 25\)"):
        mpc.predicted(p)
    with pytest.raises(QPError, match="A, B: got shapes"):
        QPMPC.from_model(A[:, :5], B, N)
