import copy
import math
import warnings
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.optim.lr_scheduler import LambdaLR
from torch.testing import assert_close

from tests.gauss_newton import Reference, penalty
from tests.problems import MIXED, normal, random_mpc, random_states
from tests.refused import refused
from torch_qpmpc import QPMPC, GaussNewton, SystemIdentificationPenalty
from torch_qpmpc.learning.gauss_newton import FALL, FIRST, RISE
from torch_qpmpc.learning.td_error import inverse_variance
from torch_qpmpc.qp.pipeline.solve import SolveLog

COUNT, DAMPING = 7, 0.2
ALL = ("H", "H_f", "q", "c", "C", "b", "G", "lb", "ub", "w")
PARTS = {
    "default": {},
    "no C": {"learn": ("H", "c", "b")},
    "C alone": {"learn": ("C",)},
    "everything": {"learn": ALL, "free": 0.01},
    "block": {"hessian": "block", "stage_weight": torch.eye(3), "learn": ("H", "H_f", "C")},
    "projected": {"step": "projection", "hessian": "block", "learn": ("H", "w"), "free": 0.01},
    "tied": {"structure": "tied", "learn": ("c", "q", "C", "b", "lb", "ub", "w"), "free": 0.01},
    "mixed": {"structure": "tied", "learn": ("C", "G"), **MIXED},
    "blocks": {"blocks": [1, 2], "learn": ("H", "c", "C")},
    "preview": {"n_d": 1, "learn": ("H", "q", "c", "C", "b")},
}


def pairs(count: int = COUNT, n_p: int = 2) -> tuple[Tensor, Tensor]:
    return random_states(count, n_p, size=0.9), random_states(count, 1, size=0.45, seed=1)


def targets(mpc: QPMPC, size: float = 0.1) -> Tensor:
    s, a = pairs(n_p=mpc.n_p)
    return mpc.action_value(s, a).detach() + size * normal(COUNT, seed=2)


def assert_steps(
    optimizer: GaussNewton,
    reference: Reference,
    s: Tensor,
    a: Tensor,
    target: Tensor,
    weight: Tensor | None = None,
    **own: Any,
) -> None:
    before = reference.theta()
    expected = reference.step(s, a, target, own.get("penalty"), weight)
    report = optimizer.step(s, a, target, **own)
    assert report.accepted
    assert expected.abs().max() > 1e-5
    assert_close(reference.theta() - before, expected, rtol=1e-5, atol=1e-9)


def compared(**options: Any) -> tuple[QPMPC, GaussNewton, Reference]:
    mpc = random_mpc(2, **options)
    optimizer = GaussNewton(mpc, damping=DAMPING)
    return mpc, optimizer, Reference(mpc, optimizer)


@pytest.mark.parametrize("name", PARTS)
def test_the_step_is_the_damped_least_squares_step(name):
    mpc, optimizer, reference = compared(**PARTS[name])
    for size in (0.1, 0.02):
        assert_steps(optimizer, reference, *pairs(n_p=mpc.n_p), targets(mpc, size))


@pytest.mark.parametrize("name", ["default", "C alone", "tied"])
@pytest.mark.parametrize("given", ["none", "inverse variance", "priorities"])
def test_weights_are_those_of_the_squared_errors(name, given):
    """With more pairs than entries of theta, too."""
    mpc, optimizer, reference = compared(**PARTS[name])
    count = 100 if given == "none" else 40
    s, a = random_states(count, mpc.n_p, size=0.9), random_states(count, 1, size=0.45, seed=1)
    value = mpc.action_value(s, a).detach()
    error = 0.1 * a[:, 0] * normal(count, seed=2)
    own, weight = {}, None
    if given == "inverse variance":
        own = {"weighted": True}
        weight = inverse_variance(s, a, value, error, torch.ones(count).bool())
    elif given == "priorities":
        own = {"weights": normal(count, seed=3).square()}
        weight = own["weights"] / own["weights"].mean()
    if weight is None:
        assert count > len(reference.theta())
    else:
        assert weight.max() > 1.1 * weight.min()
    assert_steps(optimizer, reference, s, a, value + error, weight, **own)


@pytest.mark.parametrize("learn", [("H", "c", "C"), ("C", "b")])
def test_the_si_penalty_is_part_of_the_step(learn):
    mpc, optimizer, reference = compared(learn=learn)
    S = SystemIdentificationPenalty(1e-2).curvature(normal(5, mpc.n_z))
    assert_steps(optimizer, reference, *pairs(), targets(mpc), penalty=S)


def test_the_sizes_are_part_of_the_state():
    mpc = random_mpc(2, learn=("c", "C", "b"))
    optimizer = GaussNewton(mpc)
    s, a = pairs()
    optimizer.step(2 * s, a, mpc.action_value(2 * s, a).detach())  # larger than those that follow
    state = copy.deepcopy(optimizer.state_dict())
    twins = [copy.deepcopy(mpc) for _ in range(2)]
    resumed, fresh = (GaussNewton(twin) for twin in twins)
    resumed.load_state_dict(state)
    target = targets(mpc)
    for other in (optimizer, resumed, fresh):
        other.step(0.5 * s, a, target)
    assert_close(twins[0].state_dict(), mpc.state_dict(), rtol=0, atol=0)
    assert not torch.allclose(twins[1].C, mpc.C)


def test_a_step_that_raises_the_errors_is_taken_back():
    mpc = random_mpc(5)
    target = targets(mpc, 300.0)
    optimizer = GaussNewton(mpc, damping=1e-9)
    before = copy.deepcopy(mpc.state_dict())
    report = optimizer.step(*pairs(), target)
    assert not report.accepted
    assert not report.ratio > 0
    assert_close(mpc.state_dict(), before, rtol=0, atol=0)
    assert optimizer.param_groups[0]["damping"] == RISE * report.damping


def test_steps_that_stall_are_warned_of_and_cost_few_qps():
    """x_1 <= 1 is hard: from x_0 = 1 it is infeasible with any larger A, which targets ask for."""
    A, B = torch.ones(1, 1), torch.ones(1, 1)
    hard = {"state_bounds": ([-1.0], [1.0]), "state_slack": math.inf, "on_failure": "mask"}
    mpc = QPMPC.from_model(A, B, 1, stage_weight=[1.0, 0.1], learn=("C",), structure="tied", **hard)
    optimizer, before = GaussNewton(mpc), copy.deepcopy(mpc.state_dict())
    s = torch.tensor([1.0, -1.0]).repeat(40).unsqueeze(-1)
    a, target = torch.zeros(80, 1), torch.full((80,), 3.0)
    counts = []
    for step in range(5):
        with SolveLog() as log, warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            report = optimizer.step(s, a, target)
        counts.append(log.solves)
        assert (report.accepted, report.ratio) == (False, -math.inf)
        assert len(caught) == (step == 4)
    assert counts == [160, *[80 + FIRST] * 4]
    assert "5 steps in a row that were taken back, because they left QPs" in str(caught[0].message)
    assert "make hard rows soft" in str(caught[0].message)
    assert_close(mpc.state_dict(), before, rtol=0, atol=0)
    s, a = torch.full((4, 1), 0.5), torch.zeros(4, 1)
    assert optimizer.step(s, a, mpc.action_value(s, a).detach() + 1e-3).accepted
    assert optimizer.state_dict()["param_groups"][0]["rejected"] == 0


def test_the_damping_comes_back_to_its_least():
    mpc = random_mpc(6)
    target = targets(mpc, 1e-3)
    optimizer = GaussNewton(mpc, damping=0.05)
    for group in optimizer.param_groups:
        group["damping"] = 0.06 / FALL
    used = [optimizer.step(*pairs(), target).damping for _ in range(3)]
    assert used == [0.06 / FALL, 0.06, 0.05]


def test_the_trust_region_counts_the_penalty():
    """Where the targets are met, only the penalty moves C, and it decreases."""
    mpc = random_mpc(7)
    S = SystemIdentificationPenalty(1e-3).curvature(normal(5, mpc.n_z))
    before = penalty(mpc, S)
    report = GaussNewton(mpc).step(*pairs(), targets(mpc, 0.0), penalty=S)
    assert report.accepted
    assert penalty(mpc, S) < before


def test_pairs_without_a_solution_or_a_target_are_left_out():
    mpc = random_mpc(8, on_failure="mask")
    twin = copy.deepcopy(mpc)
    s, a = pairs()
    target = targets(mpc)
    bad_a, bad_target = a.clone(), target.clone()
    bad_a[1], bad_target[3] = 9.0, torch.inf  # beyond a hard bound; no value of s+
    keep = [0, 2, 4, 5, 6]
    one, other = GaussNewton(mpc), GaussNewton(twin)
    one.step(s, bad_a, bad_target)
    for group in other.param_groups:  # the mean of the kernel's diagonal counts all seven
        group["damping"] *= len(keep) / COUNT
    other.step(s[keep], a[keep], target[keep])
    assert_close(mpc.state_dict(), twin.state_dict(), rtol=1e-6, atol=1e-9)


def test_a_clipped_error_moves_theta_as_far_as_the_clip():
    mpc = random_mpc(9)
    twin = copy.deepcopy(mpc)
    s, a = pairs(1)
    value = mpc.action_value(s, a).detach()
    GaussNewton(mpc).step(s, a, value + 5.0, clip=0.1)
    GaussNewton(twin).step(s, a, value + 0.1)
    assert_close(mpc.state_dict(), twin.state_dict(), rtol=1e-9, atol=1e-12)


def test_schedulers_change_the_part_of_the_step_that_is_taken():
    mpc = random_mpc(10)
    optimizer = GaussNewton(mpc, lr=1.0)
    schedule = LambdaLR(optimizer, lambda update: 1 / (1 + update))
    target = targets(mpc)
    before = mpc.C.detach().clone()
    twin = copy.deepcopy(mpc)
    optimizer.step(*pairs(), target)
    whole = mpc.C.detach() - before
    schedule.step()
    with torch.no_grad():
        mpc.load_state_dict(twin.state_dict())
    optimizer.step(*pairs(), target)
    assert_close(mpc.C.detach() - before, whole / 2)


def test_a_warm_start_saves_time_only():
    mpc = random_mpc(12, solver="proxqp")
    twin, s_a, target = copy.deepcopy(mpc), pairs(), targets(mpc)
    first = GaussNewton(mpc).step(*s_a, target)
    again = GaussNewton(twin).step(*s_a, target, warm_start=first.solution.active)
    assert again.solution.iterations.sum() < first.solution.iterations.sum()
    assert_close(mpc.state_dict(), twin.state_dict(), rtol=1e-5, atol=1e-7)


@refused(
    ({"lr": 0.0}, {}, r"lr: got 0.0, expected a number in \(0, 1\]"),
    ({"lr": 1.1}, {}, r"lr: got 1.1, expected a number in \(0, 1\]"),
    ({"damping": -1.0}, {}, "damping: got -1.0, expected a finite number > 0"),
    ({"scales": {"A": 1.0}}, {}, r"rates: got \['A'\], expected names among"),
    ({}, {"clip": math.inf}, "clip: got inf, expected a finite number > 0"),
    ({}, {"weights": torch.full((7,), math.nan)}, "weights: got NaN, inf or below 0, exp"),
)
def test_numbers_out_of_range_are_named(options, of_step):
    GaussNewton(mpc := random_mpc(2), **options).step(*pairs(), targets(mpc), **of_step)


def test_the_trust_region_counts_weighted_errors():
    """The predicted decrease is that of the weighted objective: a small step meets it."""
    mpc = random_mpc(2)
    s, a = random_states(40, 2, size=0.9), random_states(40, 1, size=0.45, seed=1)
    target = mpc.action_value(s, a).detach() + 1e-4 * a[:, 0] * normal(40, seed=2)
    report = GaussNewton(mpc, damping=1.0).step(s, a, target, weighted=True)
    assert report.ratio == pytest.approx(1, abs=0.01)
