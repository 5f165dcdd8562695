from __future__ import annotations

import copy
import io
import pickle
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.func import jacfwd, jacrev
from torch.testing import assert_close

from tests.problems import MIXED, random_mpc, random_states, step
from torch_qpmpc import QPMPC, QPError, QPSolution, SolverError, Status, solve_qp
from torch_qpmpc.mpc.validation import CONSTRAINTS, COST

A = torch.tensor([[1.0, 0.2], [0.0, 0.9]]).double()
B = torch.tensor([[0.0], [0.3]]).double()
EVERYTHING = (*COST, *CONSTRAINTS)
SETTINGS: dict[str, dict[str, Any]] = {
    "diagonal": {"hessian": "diagonal"},
    "block": {"hessian": "block"},
    "full": {"hessian": "full"},
    "all soft": {"action_slack": 50.0},
    "weak slack": {"state_slack": 0.5, "action_slack": 0.1},
    "discounted slack": {"discount_slack": True, "action_slack": 50.0},
    "hard states": {"state_slack": torch.inf, "state_bounds": ([-9.0, -9.0], [9.0, 9.0])},
    "no bounds": {"state_bounds": None, "action_bounds": None},
    "everything learned": {"learn": EVERYTHING, "hessian": "block", "action_slack": 50.0},
    "of one stage": {"horizon": 1},
    "tied": {"structure": "tied", "learn": {*EVERYTHING} - {"G"}, "action_slack": 50.0},
    "varying, mixed": {"structure": "varying", "learn": ("C", "G", "w"), **MIXED},
    "tied, mixed": {"structure": "tied", "learn": ("C", "G", "b"), "horizon": 4, **MIXED},
    "free, mixed": {"learn": ("C", "G", "w"), "action_slack": 50.0, **MIXED},
    "undiscounted": {"gamma": 1.0},
    "projected": {"step": "projection", "learn": EVERYTHING, "action_slack": 50.0},
    "projected block": {"step": "projection", "hessian": "block", "learn": ("H", "H_f", "C", "w")},
}


def round_trip(mpc: QPMPC) -> QPMPC:
    return pickle.loads(pickle.dumps(mpc))


# V, Q and the policy


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("name", SETTINGS)
def test_the_value_is_the_action_value_of_the_policy(name, seed):
    mpc, s = random_mpc(seed, **SETTINGS[name]), random_states(12)
    assert_close(mpc.action_value(s, mpc.policy(s).detach()), mpc.value(s), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("name", SETTINGS)
def test_no_action_is_better_than_the_policys(name, seed):
    mpc, s = random_mpc(seed, **SETTINGS[name]), random_states(12)
    a = random_states(12, 1, size=0.5, seed=seed)
    advantage = mpc.action_value(s, a) - mpc.value(s)
    assert (advantage >= -1e-6).all()
    assert advantage.max() > 1e-3


@pytest.mark.parametrize("hessian", ["diagonal", "block", "full"])
def test_these_hold_with_the_default_solver_too(hessian):
    mpc, s = random_mpc(2, hessian=hessian, solver="proxqp"), random_states(6)
    assert_close(mpc.action_value(s, mpc.policy(s).detach()), mpc.value(s), rtol=1e-6, atol=1e-6)
    a = random_states(6, 1, size=0.5)
    assert (mpc.action_value(s, a) >= mpc.value(s) - 1e-6).all()


@pytest.mark.parametrize("free", [0.0, 0.3])
def test_the_policy_keeps_within_hard_action_bounds(free):
    a = random_mpc(3, free=free).policy(random_states(40, size=4.0))
    assert a.abs().max() <= 0.5 + 1e-8
    assert a.abs().max() > 0.5 - 1e-6  # reaches them, too


def test_the_policy_exceeds_soft_action_bounds_where_that_pays():
    mpc = random_mpc(3, free=0.0, A=A, B=B, action_slack=1e-3, state_slack=1e3)
    assert mpc.policy(random_states(40, size=4.0)).abs().max() > 0.6


def test_without_bounds_it_is_the_discounted_linear_quadratic_regulator():
    gamma, N = 0.9, 6
    Q, R = torch.diag(torch.tensor([2.0, 0.5])).double(), torch.tensor([[0.1]]).double()
    Q_f = torch.tensor([[3.0, 0.5], [0.5, 1.0]]).double()
    mpc = QPMPC.from_model(
        A,
        B,
        N,
        gamma=gamma,
        hessian="block",
        stage_weight=torch.block_diag(Q, R),
        terminal_weight=Q_f,
        solver="daqp",
    )
    P = Q_f
    K = torch.zeros(1, 2).double()
    for _ in range(N):
        K = torch.linalg.solve(R + gamma * B.mT @ P @ B, gamma * B.mT @ P @ A)
        P = Q + K.mT @ R @ K + gamma * (A - B @ K).mT @ P @ (A - B @ K)
    s = random_states(5)
    assert_close(mpc.value(s), 0.5 * ((s @ P) * s).sum(-1))
    assert_close(mpc.policy(s), -s @ K.mT)


#: Schemes with a state at which rows meet without a multiplier, or many rows have one.
STRUCTURED: dict[str, tuple[dict[str, Any], list[float]]] = {
    "set-point": ({"terminal_constraints": ([[1, 0], [0, 1]], [0, 0], [0, 0])}, [0, 0]),
    "opposite": ({"terminal_constraints": ([[1, 0], [-2, 0]], [-9, -9], [0, 0])}, [0, 0]),
    "no power": (
        {"constraints": ([[0, 0, 1, 1], [0, 0, 3, 0], [0, 0, 0, 1]], [-9, 0, 0], [0, 9, 9])},
        [0, 0],
    ),
    "pinned": ({"action_bounds": ([-9, 0], [9, 0])}, [0, 0]),
    "pinned, away": ({"action_bounds": ([-9, 0], [9, 0])}, [0.5, -0.3]),
    "saturated": ({"action_bounds": ([-0.2, -0.1], [0.2, 0.1])}, [4, -1]),
}


@pytest.mark.parametrize("solver", ["proxqp", "daqp", "torch"])
@pytest.mark.parametrize("name", STRUCTURED)
def test_derivatives_where_a_controller_spends_its_life(name, solver):
    options, s = STRUCTURED[name]
    mpc = QPMPC.from_model(
        A,
        torch.cat((B, torch.tensor([[0.1], [0.2]]).double()), 1),
        4,
        stage_weight=torch.diag(torch.tensor([1.0, 0.2, 0.1, 0.3])) + 0.01,
        constraint_slack=torch.inf,
        **options,
    )
    program, towards = mpc.quadratic_program(), random_states(*mpc.C.shape)

    def solution(p: Tensor) -> QPSolution:
        C = program.C.detach() + p[2] * towards
        return solve_qp(replace(program, C=C, check_values=False), p[:2], solver=solver)

    def policy(p: Tensor) -> Tensor:
        return solution(p).z[2:4]

    def slope(p: Tensor) -> Tensor:
        return jacrev(lambda p: solution(p).value)(p)

    at = torch.tensor([*s, 0.0]).double()
    for f in (policy, slope):
        steps = 1e-4 * torch.eye(3).double()
        differences = torch.stack([(f(at + d) - f(at - d)) / 2e-4 for d in steps], -1)
        for derivative in (jacrev(f)(at), jacfwd(f)(at)):
            assert_close(derivative, differences, rtol=1e-4, atol=1e-4)


def test_the_solution_of_a_banded_scheme_is_a_trajectory_with_its_cost():
    weights = torch.tensor([2.0, 0.5, 0.1]).double()
    mpc = random_mpc(0, free=0.0, A=A, B=B, stage_weight=weights, horizon=5)
    s = random_states(7)
    solution = mpc.solve(s)
    x, u = mpc.predicted(solution.z)
    assert x.shape == (7, 6, 2)
    assert u.shape == (7, 5, 1)
    assert_close(x[:, 0], s)
    assert_close(u[:, 0], mpc.policy(s))
    assert_close(x[:, 1:], x[:, :-1] @ A.mT + u @ B.mT)
    powers = 0.9 ** torch.arange(6).double()
    stages = torch.cat((x[:, :-1], u), -1).square() @ weights
    cost = 0.5 * (stages @ powers[:5] + powers[5] * x[:, 5].square().sum(-1))
    violation = (x.abs() - 1).clamp(min=0).sum((-2, -1))
    assert_close(solution.value, cost + 100 * violation, rtol=1e-6, atol=1e-6)


def test_forward_is_the_value_or_the_action_value():
    mpc, s, a = random_mpc(4), random_states(3), random_states(3, 1, size=0.5)
    assert_close(mpc(s), mpc.value(s))
    assert_close(mpc(s, a), mpc.action_value(s, a))


def test_an_action_beyond_a_hard_bound_is_infeasible():
    s, a = random_states(2), torch.tensor([[0.4], [0.6]]).double()
    with pytest.raises(SolverError, match=r"1 of 2 .* 1 INFEASIBLE, first at batch index \(1,\)"):
        random_mpc(4).action_value(s, a)
    mpc = random_mpc(4, on_failure="mask")
    assert mpc.action_value(s, a).isinf().tolist() == [False, True]
    assert mpc.solve(s, a).status.tolist() == [Status.SOLVED, Status.INFEASIBLE]


def test_a_warm_start_leads_to_the_same_solution(solver):
    mpc, s, a = random_mpc(5, solver=solver), random_states(6), random_states(6, 1, size=0.5)
    start = mpc.solve(s)
    with torch.no_grad():
        mpc.C *= 1.001
        mpc.C[:, 5] += 0.01
    for action in (None, a):
        cold, warm = mpc.solve(s, action), mpc.solve(s, action, warm_start=start)
        assert_close(warm.value, cold.value, rtol=1e-6, atol=1e-6)


# Shapes and dtypes


@pytest.mark.parametrize("batch", [(), (0,), (1,), (5,), (2, 3)])
def test_outputs_have_the_batch_of_the_inputs(batch):
    mpc = random_mpc(6)
    s, a = torch.zeros(*batch, 2), torch.zeros(*batch, 1)
    assert mpc.value(s).shape == batch
    assert mpc.action_value(s, a).shape == batch
    assert mpc.policy(s).shape == (*batch, 1)


def test_states_and_actions_broadcast():
    mpc, s, a = random_mpc(6), random_states(3), random_states(4, 1, size=0.5)
    grid = mpc.action_value(s.unsqueeze(1), a)
    assert grid.shape == (3, 4)
    assert_close(grid[2, 1], mpc.action_value(s[2], a[1]))


@pytest.mark.parametrize("dtype", [torch.float16, torch.float32, torch.float64])
def test_outputs_have_the_dtype_of_the_state(dtype):
    mpc = random_mpc(6)
    s, a = random_states(3).to(dtype), random_states(3, 1, size=0.5)
    for out in (mpc.value(s), mpc.action_value(s, a), mpc.policy(s)):
        assert out.dtype == dtype
    assert mpc.C.dtype == torch.float64
    assert_close(mpc.value(s), mpc.value(s.double()).to(dtype))


def test_a_module_in_single_precision_works_too():
    mpc, s = random_mpc(6), random_states(3)
    expected = mpc.value(s)
    assert_close(mpc.float().value(s.float()), expected.float(), rtol=1e-4, atol=1e-4)
    assert all(part.dtype == torch.float32 for part in mpc.parameters())


# theta


@pytest.mark.parametrize("discounted", [False, True])
def test_the_program_is_discounted_by_stage(discounted):
    mpc = random_mpc(
        7,
        free=0.0,
        horizon=2,
        gamma=0.5,
        learn=("q",),
        discount_slack=discounted,
        stage_weight=[2.0, 3.0, 4.0],
        terminal_weight=[5.0, 6.0],
    )
    with torch.no_grad():
        mpc.q.fill_(1.0)
    qp = mpc.quadratic_program()
    power = torch.tensor([1, 1, 1, 0.5, 0.5, 0.5, 0.25, 0.25]).double()
    assert_close(qp.q.detach(), power)
    assert_close(qp.H, torch.diag(power * torch.tensor([2, 3, 4, 2, 3, 4, 5, 6])))
    weight = 100 * (power if discounted else torch.ones(8).double())
    weight[[2, 5]] = torch.inf
    assert_close(qp.w, weight)
    assert_close(qp.lb, torch.tensor([-1, -1, -0.5, -1, -1, -0.5, -1, -1]).double())
    assert_close(qp.ub, -qp.lb)
    assert_close(qp.G, torch.eye(8).double())
    assert_close(qp.b, torch.zeros(4).double())


def test_value_and_action_value_may_share_a_quadratic_program():
    mpc, s, a = random_mpc(8), random_states(5).double(), random_states(5, 1, size=0.5).double()
    alone = mpc.value(s).sum() + mpc.action_value(s, a).sum()
    qp = mpc.quadratic_program()
    shared = mpc.value(s, qp).sum() + mpc.action_value(s, a, qp).sum()
    assert shared == alone
    gradients = [torch.autograd.grad(total, [*mpc.parameters()]) for total in (alone, shared)]
    assert_close(*gradients)


def test_stages_may_have_weights_and_models_of_their_own():
    weights = torch.arange(1.0, 7.0).reshape(2, 3)
    mpc = QPMPC.from_model(
        torch.stack((A, 2 * A)), torch.stack((B, 3 * B)), 2, gamma=1.0, stage_weight=weights
    )
    assert_close(mpc.quadratic_program().H.diagonal()[:6], weights.flatten().double())
    assert_close(mpc.C[2:, 3:6], torch.cat((2 * A, 3 * B), 1))
    assert_close(mpc.C, mpc.C_0)


def test_the_model_may_have_an_offset():
    cost = {"stage_weight": [1.0, 1.0, 0.1]}
    mpc = QPMPC.from_model(A, B, 2, offset=[0.1, -0.2], solver="daqp", **cost)
    s, a = random_states(3), random_states(3, 1)
    states, _ = mpc.predicted(mpc.solve(s, a).z)
    assert_close(states[:, 1], s @ A.mT + a @ B.mT + torch.tensor([0.1, -0.2]).double())


@pytest.mark.parametrize("hessian", ["block", "full"])
@pytest.mark.parametrize("horizon", [2, 3])
def test_a_dense_stage_weight_is_one_block_whatever_the_horizon(hessian, horizon):
    weight = torch.tensor([[2.0, 0.5, 0.1], [0.5, 1.0, 0.2], [0.1, 0.2, 0.3]]).double()
    options = {"stage_weight": weight, "terminal_weight": [1.0, 1.0]}
    mpc = QPMPC.of(2, 1, horizon, gamma=1.0, hessian=hessian, **options)
    H = mpc.quadratic_program().H
    assert_close(H, torch.block_diag(*[weight] * horizon, torch.eye(2).double()))


def test_the_same_start_gives_the_same_program_whatever_the_hessian():
    options = {"free": 0.0, "A": A, "B": B, "stage_weight": [2.0, 0.0, 0.1]}
    options["terminal_weight"] = [1.0, 1.0]
    programs = [
        random_mpc(0, hessian=hessian, **options).quadratic_program()
        for hessian in ("diagonal", "block", "full")
    ]
    for other in programs[1:]:
        assert_close(other.tensors(), programs[0].tensors())


@pytest.mark.parametrize("hessian", ["diagonal", "block", "full"])
def test_the_hessian_is_semidefinite_whatever_the_factor(hessian):
    learn = ("H",) if hessian == "full" else ("H", "H_f")
    mpc = random_mpc(8, free=5.0, hessian=hessian, learn=learn)
    H = mpc.quadratic_program().H.detach()
    assert_close(H, H.mT, rtol=1e-12, atol=1e-12)
    assert torch.linalg.eigvalsh(H)[0] > -1e-9
    stages = H[:3, 3:6].abs().sum() + H[:9, 9:].abs().sum()
    assert (stages > 0) == (hessian == "full")


def test_slack_weights_stay_non_negative_whatever_the_factor():
    w = random_mpc(8, free=20.0, learn=("w",)).quadratic_program().w
    assert (w >= 0).all()
    assert w.isinf().sum() == 3


@pytest.mark.parametrize("part", EVERYTHING)
def test_every_part_can_be_learned_alone(part):
    mpc = random_mpc(9, learn=(part,), action_slack=50.0)
    assert mpc.learned == (part,)
    assert len(list(mpc.parameters())) == 1
    before, s = mpc.value(random_states(6)), random_states(6)
    mpc.value(s).sum().backward()
    (parameter,) = mpc.parameters()
    assert parameter.grad is not None
    assert parameter.grad.isfinite().all()
    assert (parameter.grad != 0).any()
    step(mpc)
    assert (mpc.value(s) - before).abs().max() > 1e-6


def test_hard_rows_and_missing_bounds_leave_the_gradient_finite():
    mpc = random_mpc(
        9, free=0.0, learn=("w", "lb", "ub"), state_bounds=([-1.0, -torch.inf], [1, 1])
    )
    mpc.value(random_states(6)).sum().backward()
    for name, parameter in mpc.named_parameters():
        assert parameter.grad is not None
        assert parameter.grad.isfinite().all(), name


def test_learning_nothing_is_allowed():
    mpc = random_mpc(9, learn=())
    assert list(mpc.parameters()) == []
    assert not mpc.value(random_states(3)).requires_grad


def test_random_starts_are_those_of_the_seed():
    first, again, other = (QPMPC.of(2, 1, 3, seed=seed).state_dict() for seed in (0, 0, 1))
    assert_close(first, again, rtol=0, atol=0)
    assert (first["C"] - other["C"]).abs().max() > 1e-3


def test_random_starts_do_not_touch_the_global_generator():
    torch.manual_seed(0)
    before = torch.get_rng_state()
    QPMPC.of(2, 1, 3, seed=5)
    assert torch.equal(torch.get_rng_state(), before)


def test_parameter_groups_have_a_rate_for_each_part():
    mpc = random_mpc(10, learn=("H", "H_f", "c", "C", "b"))
    groups = mpc.parameter_groups({"cost": 0.1, "constraints": 0.01, "C": 0.02})
    assert {group["name"]: group["lr"] for group in groups} == {
        "H": 0.1,
        "H_f": 0.1,
        "c": 0.1,
        "C": 0.02,
        "b": 0.01,
    }
    owned = [parameter for group in groups for parameter in group["params"]]
    assert {id(parameter) for parameter in owned} == {id(part) for part in mpc.parameters()}
    optimizer = torch.optim.SGD(groups)
    before = {name: part.detach().clone() for name, part in mpc.named_parameters()}
    mpc.value(random_states(4)).sum().backward()
    optimizer.step()
    rates = {group["name"]: group["lr"] for group in groups}
    for name, part in mpc.named_parameters():
        key = name.split(".")[1] if "." in name else name
        assert part.grad is not None
        assert_close(before[name] - part.detach(), rates[key] * part.grad)


@pytest.mark.parametrize(
    ("rates", "message"),
    [
        ({"cost": 0.1}, "rates: got nothing for C, expected a rate for every learned part"),
        ({"cost": 0.1, "constraint": 1.0}, r"rates: got \['constraint'\], expected names among"),
    ],
)
def test_rates_that_do_not_fit_are_named(rates, message):
    with pytest.raises(QPError, match=message):
        random_mpc(10).parameter_groups(rates)


# Copies, pickles and checkpoints


@pytest.mark.parametrize("name", SETTINGS)
def test_resetting_returns_to_the_start(name):
    start = random_mpc(11, free=0.0, **SETTINGS[name])
    mpc = random_mpc(11, **SETTINGS[name])
    step(mpc)
    mpc.reset_parameters()
    assert_close(mpc.state_dict(), start.state_dict(), rtol=0, atol=0)


@pytest.mark.parametrize("copied", [copy.deepcopy, round_trip], ids=["deepcopy", "pickle"])
@pytest.mark.parametrize("name", SETTINGS)
def test_a_copy_gives_the_same_answers_and_is_independent(copied, name):
    mpc, s = random_mpc(12, **SETTINGS[name]), random_states(4)
    step(mpc)
    twin = copied(mpc)
    before = mpc.value(s)
    assert_close(twin.value(s), before, rtol=0, atol=0)
    assert_close(twin.state_dict(), mpc.state_dict(), rtol=0, atol=0)
    step(twin, rate=0.1)
    assert (twin.value(s) - before).abs().max() > 1e-6
    assert_close(mpc.value(s), before, rtol=0, atol=0)
    twin.reset_parameters()


@pytest.mark.parametrize("name", SETTINGS)
def test_a_qp_without_values_is_pickled(name):
    """TorchRL sends policies to workers on the meta device, with separate weights."""
    mpc = random_mpc(12, **SETTINGS[name])
    step(mpc)
    twin = round_trip(copy.deepcopy(mpc).to("meta")).to_empty(device="cpu")
    twin.load_state_dict(mpc.state_dict())
    assert_close(twin.C, mpc.C, rtol=0, atol=0)


@pytest.mark.parametrize("copied", [copy.deepcopy, round_trip], ids=["deepcopy", "pickle"])
@pytest.mark.parametrize("learn", [("H", "C"), ("C",), ()])
def test_a_copy_keeps_mode_dtype_and_what_is_frozen(copied, learn):
    mpc = random_mpc(12, learn=learn).float().eval()
    mpc.requires_grad_(False)
    twin = copied(mpc)
    assert not twin.training
    assert not any(part.requires_grad for part in twin.parameters())
    assert all(part.dtype == torch.float32 for part in twin.parameters())
    s = random_states(4).float()
    assert_close(twin.value(s), mpc.value(s), rtol=0, atol=0)
    assert repr(twin) == repr(mpc)


@pytest.mark.parametrize("name", SETTINGS)
def test_a_checkpoint_restores_a_module_from_another_seed(name):
    mpc, other = random_mpc(13, **SETTINGS[name]), random_mpc(14, **SETTINGS[name])
    step(mpc)
    file = io.BytesIO()
    torch.save(mpc.state_dict(), file)
    file.seek(0)
    other.load_state_dict(torch.load(file, weights_only=True))
    s = random_states(4)
    assert_close(other.value(s), mpc.value(s), rtol=0, atol=0)


def test_repr():
    text = repr(random_mpc(15))
    assert (
        "n_x=2, n_u=1, horizon=3, hessian='diagonal', structure='free', learned=('H', 'c', 'C')"
        in text
    )


# Bad input


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"learn": "HC"}, "learn: got 'HC', expected a collection of names among H, H_f, q"),
        ({"learn": ["H", "D"]}, r"learn: got \['H', 'D'\], expected a collection of names"),
        (
            {"learn": ["H", "H_f"], "hessian": "full"},
            "learn: got 'H_f' with hessian='full', expected 'H' alone. A full H contains",
        ),
        ({"structure": "banded"}, "structure: got 'banded', expected one of free, varying, tied"),
        (
            {"structure": "tied", "learn": ["G"]},
            "learn: got 'G' without constraints, expected other parts. Pass constraints, or ",
        ),
        (
            {"structure": "tied", "A": torch.eye(2) * torch.ones(3, 1, 1).cumsum(0)},
            "C: got entries that break the structure of a linear MPC scheme, expected entries",
        ),
        ({"on_failure": "skip"}, "on_failure: got 'skip', expected one of raise, warn, mask"),
        ({"solver": "proxq"}, r"solver: got 'proxq', expected one of .* Did you mean 'proxqp'\?"),
        ({"solver": None}, "solver: got None, expected one of proxqp, daqp"),
    ],
)
def test_bad_arguments_are_named(options, message):
    arguments = {"n_x": 2, "n_u": 1, "horizon": 3, "A": torch.eye(2), "B": torch.ones(2, 1)}
    with pytest.raises(QPError, match=message):
        QPMPC.of(**(arguments | options))


@pytest.mark.parametrize(("A", "B"), [([1.0], [[1.0]]), (1.0, 1.0), ([[1.0]], [1.0])])
def test_a_model_without_matrices_is_named(A, B):
    with pytest.raises(QPError, match=r"A, B: got shapes .*, expected matrices \(n_x, n_x\) and"):
        QPMPC.from_model(A, B, 3)


S = torch.zeros(4, 2)


@pytest.mark.parametrize(
    ("inputs", "message"),
    [
        (([0.0, 0.0],), r"s: got list, expected .* Convert it: torch.as_tensor\(s\).float\(\)"),
        ((S.long(),), "s: got torch.int64, expected a floating-point torch.Tensor"),
        ((torch.tensor(1.0),), r"s: got shape \(\), expected shape \(\*batch, 2\)"),
        ((torch.ones(2, 3),), r"s: got shape \(2, 3\), expected shape \(\*batch, 2\)"),
        ((S, S), r"a: got shape \(4, 2\), expected shape \(\*batch, 1\)"),
        ((S, [0.0]), r"a: got list, expected .* Convert it: torch.as_tensor\(a\)"),
        ((S, torch.ones(3, 1)), r"a: got shape \(3, 1\), .* broadcast with those of s, \(4,\)"),
    ],
)
def test_bad_inputs_are_named(inputs, message):
    with pytest.raises(QPError, match=message):
        random_mpc(0)(*inputs)


@pytest.mark.parametrize("bad", [torch.nan, torch.inf])
def test_invalid_states_are_named(bad):
    s: Tensor = torch.zeros(3, 2)
    s[1, 0] = bad
    with pytest.raises(QPError, match=r"1 INVALID_DATA, first at batch index \(1,\).*the state"):
        random_mpc(0).value(s)


@pytest.mark.parametrize("part", ["c", "C", "parametrizations.H.original"])
def test_invalid_parameters_are_named(part):
    mpc = random_mpc(0)
    with torch.no_grad():
        mpc.get_parameter(part).view(-1)[0] = torch.nan
    with pytest.raises(QPError, match=r"3 of 3 .* 3 INVALID_DATA, .*: NaN or inf in the data"):
        mpc.value(torch.zeros(3, 2))
