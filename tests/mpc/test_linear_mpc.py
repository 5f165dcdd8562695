from __future__ import annotations

import copy
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from tests.problems import MIXED, normal, random_states, step
from torch_qpmpc import QPMPC, GaussNewton, QPError
from torch_qpmpc.mpc.riccati import riccati_weight

A = torch.tensor([[1.0, 0.2], [0.0, 0.9]]).double()
B = torch.tensor([[0.0], [0.3]]).double()
W = torch.tensor([[2.0, 0.3, 0.1], [0.3, 1.0, 0.2], [0.1, 0.2, 0.5]]).double()
SCHEMES: dict[str, dict[str, Any]] = {
    "tied": {},
    "varying": {"structure": "varying"},
    "mixed": MIXED,
    "mixed, varying": {"structure": "varying", **MIXED},
    "diagonal": {"hessian": "diagonal", "stage_weight": [1.0, 0.5, 0.1]},
    "full": {"hessian": "full"},
    "hard rows": {"constraint_slack": torch.inf, "constraints": ([[0.0, 0, 1]], [-0.4], [0.4])},
}


def scheme(seed: int = 0, *, free: float = 0.05, horizon: int = 4, **options: Any) -> QPMPC:
    """Make a linear MPC scheme; shift its learned entries by up to ``free``."""
    settings = {
        "state_bounds": ([-1.0, -1.0], [1.0, 1.0]),
        "action_bounds": ([-0.5], [0.5]),
        "stage_weight": W,
        "solver": "daqp",
    }
    mpc = QPMPC.linear_mpc(A, B, horizon, **(settings | options))
    with torch.no_grad():
        for i, parameter in enumerate(mpc.parameters()):
            parameter += free * normal(*parameter.shape, seed=100 * seed + i).clamp(-1, 1)
    return mpc


# The program


def test_its_program_is_that_of_the_paper():
    mpc = QPMPC.linear_mpc(
        A, B, 2, gamma=0.5, stage_weight=W, state_bounds=([-1.0, -2.0], [1.0, 2.0]), **MIXED
    )
    with torch.no_grad():
        mpc.q = torch.arange(8.0).double() % 3 + torch.tensor([0.0] * 6 + [5.0, 5.0]).double()
        mpc.b = torch.tensor([0.1, 0.2]).double().repeat(2)
    qp = mpc.quadratic_program()
    unit, zeros = torch.eye(2).double(), torch.zeros
    rows = torch.cat((A, B, -unit, zeros(2, 3)), 1), torch.cat((zeros(2, 3), A, B, -unit), 1)
    C = torch.cat(rows)
    D, D_f = torch.tensor(MIXED["constraints"][0]), torch.tensor([[1.0, 1.0]])
    stages = torch.cat((D, zeros(2, 5)), 1), torch.cat((zeros(2, 3), D, zeros(2, 2)), 1)
    G = torch.cat((torch.eye(8), *stages, torch.cat((zeros(1, 6), D_f), 1))).double()
    assert_close(qp.C, C)
    assert_close(qp.G, G)
    assert_close(qp.b, torch.tensor([0.1, 0.2, 0.1, 0.2]).double())
    assert_close(qp.q, torch.tensor([0, 1, 2, 0, 0.5, 1, 1.25, 1.5]).double())
    assert_close(qp.H, torch.block_diag(W, 0.5 * W, 0.25 * riccati_weight(A, B, W, 0.5)))
    powers = torch.tensor([1, 1, 1, 0.5, 0.5, 0.5, 0.25, 0.25, 1, 1, 0.5, 0.5, 0.25]).double()
    hard = torch.tensor([False, False, True] * 2 + [False] * 7)
    assert_close(qp.w, (100 * powers).masked_fill(hard, torch.inf))
    x, inf = [1.0, 2.0], torch.inf
    assert_close(qp.ub, torch.tensor([*x, inf] * 2 + x + [0.8, 0.6] * 2 + [0.3]).double())
    assert_close(qp.lb[8:], torch.tensor([-0.8, -inf] * 2 + [-0.4]).double())


@pytest.mark.parametrize("horizon", [1, 3, 8])
def test_without_active_bounds_it_is_the_linear_quadratic_regulator(horizon):
    mpc = QPMPC.linear_mpc(A, B, horizon, gamma=0.9, stage_weight=W, solver="daqp")
    P, s = riccati_weight(A, B, W, 0.9), random_states(5)
    assert_close(mpc.value(s).detach(), 0.5 * ((s @ P) * s).sum(-1), rtol=1e-7, atol=1e-9)
    R = W[2:, 2:] + 0.9 * B.mT @ P @ B
    gain = torch.linalg.solve(R, W[2:, :2] + 0.9 * B.mT @ P @ A)
    assert_close(mpc.policy(s).detach(), -s @ gain.mT, rtol=1e-6, atol=1e-7)


def test_the_riccati_weight_solves_its_equation():
    P = riccati_weight(A, B, W, 0.8)
    K = torch.linalg.solve(W[2:, 2:] + 0.8 * B.mT @ P @ B, W[2:, :2] + 0.8 * B.mT @ P @ A)
    closed, gain = A - B @ K, torch.cat((torch.eye(2).double(), -K))
    assert_close(P, gain.mT @ W @ gain + 0.8 * closed.mT @ P @ closed)


def test_mixed_constraints_hold_and_cost_what_they_should():
    rows = ([[1.0, 0.0, 1.0]], [-0.3], [0.3])
    s = torch.tensor([[0.6, -0.2]]).double()
    # u_0 in the first row is free, with or without action bounds.
    hard = scheme(free=0.0, constraints=rows, constraint_slack=torch.inf).solve(s)
    soft = scheme(free=0.0, constraints=rows, constraint_slack=0.01, gamma=1.0).solve(s)
    for solution in (hard, soft):
        z, sigma = solution.z.detach(), solution.sigma.detach()
        y = z[..., :12].unflatten(-1, (4, 3)) @ torch.tensor(rows[0][0]).double()
        excess = (y.abs() - 0.3).clamp(min=0)
        assert_close(sigma[..., -4:], torch.where(solution.qp.w[-4:].isinf(), 0, excess))
    assert excess.max() > 0.01
    assert (hard.z[0, 0] + hard.z[0, 2]).abs() < 0.3 + 1e-6


# Learning


@pytest.mark.parametrize("name", SCHEMES)
@pytest.mark.parametrize("of_pairs", [False, True])
def test_gradients_in_every_part_agree_with_differences(name, of_pairs):
    mpc = scheme(1, **SCHEMES[name])
    s, a = random_states(6), random_states(6, 1, size=0.3)
    inputs = (s, a) if of_pairs else (s,)
    mpc(*inputs).sum().backward()
    step_size = 1e-5
    for i, (part, leaf) in enumerate(mpc.named_parameters()):
        direction = normal(*leaf.shape, seed=i)
        if part.removeprefix("parametrizations.")[:2] in ("lb", "ub"):
            learned = mpc.soft
            if mpc.structure == "tied":
                learned = learned[mpc.get_buffer(f"{part.removesuffix('original')}0.first")]
            direction = direction * learned
        values = []
        with torch.no_grad():
            for sign in (1, -2):
                leaf += sign * step_size * direction
                values.append(mpc(*inputs).sum())
            leaf += step_size * direction
        difference = (values[0] - values[1]) / (2 * step_size)
        assert leaf.grad is not None
        found = (leaf.grad * direction).nan_to_num().sum()
        assert_close(
            found, difference, rtol=1e-4, atol=1e-5, msg=lambda m, part=part: f"{part} {m}"
        )


@pytest.mark.parametrize("name", SCHEMES)
@pytest.mark.parametrize("second_order", [False, True])
def test_it_stays_a_linear_mpc_scheme_while_it_is_learned(name, second_order):
    mpc, s = scheme(2, **SCHEMES[name]), random_states(6)
    before = mpc.value(s).detach()
    if second_order:
        a = random_states(6, 1, size=0.2)
        GaussNewton(mpc).step(s, a, mpc.action_value(s, a).detach() + 0.01)
    else:
        step(mpc, rate=0.01)
    assert (mpc.value(s) - before).abs().max() > 1e-4
    A, B = mpc.model()
    assert A.shape == ((4, 2, 2) if mpc.structure == "varying" else (2, 2))
    for k in range(4):
        columns = slice(3 * k, 3 * k + 5)
        A_k, B_k = (A, B) if A.ndim == 2 else (A[k], B[k])
        row = torch.cat((A_k, B_k, -torch.eye(2).double()), 1)
        assert_close(mpc.C[2 * k : 2 * k + 2, columns], row)
        assert mpc.C[2 * k : 2 * k + 2].count_nonzero() == row.count_nonzero()


@pytest.mark.parametrize("decay", [0.0, 1.0])
@pytest.mark.parametrize("structure", ["tied", "varying"])
def test_no_optimiser_moves_the_bounds_of_hard_rows(structure, decay):
    mpc = scheme(free=0.0, structure=structure)
    optimizer = torch.optim.AdamW(mpc.parameters(), lr=0.1, weight_decay=decay)
    hard = torch.arange(mpc.n_z) % 3 == 2
    before = {name: getattr(mpc, name).detach().clone() for name in ("lb", "ub")}
    for _ in range(3):
        optimizer.zero_grad()
        mpc.value(torch.tensor([[3.0, 3.0], [-3.0, -3.0]]).double()).sum().backward()
        optimizer.step()
    for name, bounds in before.items():
        assert_close(getattr(mpc, name)[hard].detach(), bounds[hard], rtol=0, atol=0)
        assert not torch.equal(getattr(mpc, name)[~hard].detach(), bounds[~hard])


# Release


@pytest.mark.parametrize("name", ["tied", "mixed", "diagonal", "full", "hard rows"])
@pytest.mark.parametrize("way", [("free",), ("varying",), ("varying", "free")])
def test_a_release_changes_neither_values_nor_policy(name, way):
    mpc, s = scheme(3, **SCHEMES[name]), random_states(50)
    step(mpc, rate=0.01)
    a = random_states(50, 1, size=0.3)
    before = [x.detach() for x in (mpc.value(s), mpc.action_value(s, a), mpc.policy(s))]
    program = [x.detach() for x in mpc.quadratic_program().tensors()]
    count = sum(parameter.numel() for parameter in mpc.parameters())
    for structure in way:
        mpc.release(structure)
        assert mpc.structure == structure
        after = [x.detach() for x in (mpc.value(s), mpc.action_value(s, a), mpc.policy(s))]
        assert_close(after, before, rtol=0, atol=1e-9)
        assert_close([x.detach() for x in mpc.quadratic_program().tensors()], program)
        more = sum(parameter.numel() for parameter in mpc.parameters())
        assert more > count
        count = more


def test_released_entries_can_change():
    mpc, s = scheme(4), random_states(6)
    mpc.release()
    assert dict(mpc.named_parameters())["C"].shape == mpc.C_0.shape
    outside = mpc.C == 0
    step(mpc, rate=0.01)
    assert (mpc.C[outside] != 0).any()
    mpc.value(s).sum().backward()
    assert mpc.q.grad is not None
    assert (mpc.q.grad[:3] - mpc.q.grad[3:6]).abs().max() > 1e-3
    with pytest.raises(QPError, match="structure: got 'free', expected 'tied' or 'varying'"):
        mpc.model()


def test_a_released_module_can_be_copied_saved_and_reset():
    mpc, s = scheme(5), random_states(6)
    mpc.release("varying")
    step(mpc)
    twin = copy.deepcopy(mpc)
    assert twin.structure == "varying"
    assert_close(twin.value(s), mpc.value(s), rtol=0, atol=0)
    other = scheme(6, structure="varying")
    other.load_state_dict(mpc.state_dict())
    assert_close(other.value(s), mpc.value(s), rtol=0, atol=0)
    mpc.reset_parameters()
    assert_close(mpc.value(s), scheme(free=0.0).value(s))


def test_a_released_copy_leaves_its_original_tied():
    mpc, s = scheme(5), random_states(6)
    value, names = mpc.value(s), [*mpc.state_dict()]
    twin = copy.deepcopy(mpc)
    twin.release()
    assert type(twin) is not type(mpc)
    assert (mpc.structure, [*mpc.state_dict()]) == ("tied", names)
    assert_close(mpc.value(s), value, rtol=0, atol=0)


def test_frozen_entries_stay_frozen():
    mpc = scheme(7)
    for name, parameter in mpc.named_parameters():
        if name.split(".")[1:2] in (["C"], ["q"]):
            parameter.requires_grad_(False)
    mpc.release()
    frozen = {name for name, p in mpc.named_parameters() if not p.requires_grad}
    assert frozen == {"C", "q"}


@pytest.mark.parametrize(
    ("start", "structure"), [("free", "free"), ("varying", "tied"), ("tied", "loose")]
)
def test_a_release_only_frees(start, structure):
    mpc = scheme(free=0.0, structure=start)
    with pytest.raises(QPError, match=f"structure: got '{structure}', expected .* freer than"):
        mpc.release(structure)


# Bad input


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"terminal_weight": "dare"}, "terminal_weight: got 'dare' with .*, expected a tensor, or"),
        (
            {"terminal_weight": "riccati", "hessian": "diagonal"},
            "terminal_weight: got 'riccati' with hessian='diagonal', .* 'riccati' with hessian=",
        ),
        (
            {"A": 2 * torch.eye(2), "B": [[1.0], [0.0]], "terminal_weight": "riccati"},
            "terminal_weight: got a Riccati equation without a solution .* Give the actions some",
        ),
        (
            {"stage_weight": torch.eye(3).expand(4, 3, 3), "terminal_weight": "riccati"},
            r"stage_weight: got shape \(4, 3, 3\), expected shape \(3, 3\). The Riccati equation",
        ),
        (
            {"A": A.expand(4, 2, 2), "terminal_weight": "riccati"},
            r"A: got shape \(4, 2, 2\), expected shape \(2, 2\). The Riccati equation has one",
        ),
    ],
)
def test_bad_arguments_are_named(options, message):
    arguments = {"A": A, "B": B, "horizon": 4, "stage_weight": W}
    with pytest.raises(QPError, match=message):
        QPMPC.linear_mpc(**(arguments | options))


@pytest.mark.parametrize(
    ("part", "index"), [("C", (0, 6)), ("b", 0), ("lb", 3), ("G", (-1, 0)), ("G", (0, 1))]
)
def test_assigning_what_the_stages_do_not_share_is_refused(part, index):
    mpc = scheme(free=0.0, **MIXED)
    value: Tensor = getattr(mpc, part).detach().clone()
    value[index] = 0.5
    with pytest.raises(QPError, match=rf"{part}: got entries .* Call release\(\) first"):
        setattr(mpc, part, value)
