from typing import Any

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose
from torch import Tensor

from tests.campaign.families import Draw, zero_H
from tests.problems import programs_of, times
from torch_qpmpc import QPMPC, SolveLog
from torch_qpmpc.qp.pipeline.arrays import SoftQPs
from torch_qpmpc.qp.solvers import BackendSolution, interior_point

MAX_ITERATIONS = interior_point.LIMIT
COUNT = 32


# The paper's QP


def paper_mpc(*, perturb: float = 0.05, stage: float = 1.0, velocity: float = 1.0, **options: Any):
    """Make the paper's QP with a dense C, horizon 10, soft states and hard actions."""
    random = np.random.default_rng(0)
    A = np.eye(4) + 0.1 * np.eye(4, k=2)
    B = np.vstack([0.005 * np.eye(2), 0.1 * np.eye(2)])
    weights = stage * random.uniform(0.5, 5, 4) * [1, 1, velocity, velocity]
    bounds = np.array(options.pop("bounds", [2.0, 2.0, 10.0, 10.0]))
    settings: dict[str, Any] = {
        "state_bounds": (-bounds, bounds),
        "action_bounds": ([-1.0, -1.0], [1.0, 1.0]),
        "stage_weight": np.r_[weights, 0, 0],
        "solver": "torch",
    }
    mpc = QPMPC.from_model(A, B, 10, **(settings | options))
    with torch.no_grad():
        mpc.C += perturb * torch.from_numpy(random.standard_normal(tuple(mpc.C.shape)))
    return mpc


def paper_inputs(far: float = 1.0, *, seed: int = 1) -> tuple[torch.Tensor, torch.Tensor]:
    """Draw states, ``far`` times the experiment's starts, and actions, some at their bounds."""
    random = np.random.default_rng(seed)
    positions, speeds = random.uniform(-1.5, 1.5, (COUNT, 2)), random.uniform(-0.5, 0.5, (COUNT, 2))
    actions = np.clip(random.standard_normal((COUNT, 2)), -1, 1)
    return torch.from_numpy(far * np.hstack([positions, speeds])), torch.from_numpy(actions)


HOSTILE: dict[str, tuple[dict[str, Any], float]] = {
    "as in the paper": ({}, 1.0),
    "w = 1": ({"state_slack": 1.0}, 1.0),
    "w = 1e4": ({"state_slack": 1e4}, 1.0),
    "w = 1e6": ({"state_slack": 1e6}, 1.0),
    "no weight on velocities": ({"velocity": 0.0}, 1.0),
    "no stage weights": ({"stage": 0.0}, 1.0),
    "no cost but of slack": ({"stage": 0.0, "terminal_weight": np.zeros(4)}, 1.0),
    "C off by 0.1": ({"perturb": 0.1}, 1.0),
    "C off by 0.3": ({"perturb": 0.3}, 1.0),
    "x_0 far outside": ({}, 5.0),
    "x_0 far outside, w = 1e6": ({"state_slack": 1e6}, 5.0),
    "x_0 far beyond": ({}, 100.0),
    "all rows soft": ({"action_slack": 100.0}, 1.0),
    "all rows soft, far": ({"action_slack": 100.0}, 5.0),
    "all rows hard": ({"state_slack": torch.inf, "bounds": [50.0] * 4}, 1.0),
    "rows of no weight": ({"state_slack": 0.0}, 1.0),
}


@pytest.mark.parametrize("kind", ["V", "Q"])
@pytest.mark.parametrize("case", HOSTILE)
def test_hostile_cases_are_solved_to_rounding_and_agree_with_daqp(case, kind):
    options, far = HOSTILE[case]
    mpc = paper_mpc(**options)
    s, a = paper_inputs(far)
    with SolveLog() as log:
        solution = mpc.solve(s, a if kind == "Q" else None)
    assert log.fallback == 0
    assert solution.residual.max() <= 1e-9
    assert solution.iterations.max() <= 40
    mpc.solver = "daqp"
    reference = mpc.solve(s, a if kind == "Q" else None)
    difference = (solution.value - reference.value).abs() / (1 + reference.value.abs())
    assert (difference <= reference.residual.clamp(min=1e-8)).all()


@pytest.mark.parametrize("seed", [1001, 2002])
def test_linear_programs_with_bounds_that_are_far_away(seed):
    """Bounds of 1e3 to 1e20 beside others: no length follows from a cost without curvature."""
    programs = programs_of(zero_H(Draw(seed), 128).known).scaled()
    found = programs.recover(interior_point.solve(programs.reduced_qps()))
    answer = programs.recalled(found.active)
    assert (answer.status == 0).all()


def test_multipliers_of_inactive_rows_are_zero():
    solution = paper_mpc().solve(paper_inputs()[0])
    lam = solution.eta - solution.upsilon
    assert 0 < (lam != 0).sum(-1).double().mean() < 20
    assert ((lam == 0) | (lam.abs() > 1e-8)).all()


# Programs with a known answer


def residual(qps: SoftQPs, answer: BackendSolution) -> Tensor:
    qps, (v, lam) = SoftQPs._make(map(torch.from_numpy, qps)), map(torch.from_numpy, answer[:2])
    hard = qps.w.isinf()
    Hv, y = torch.einsum("bde,be->bd", qps.H[qps.group], v), times(qps.G[qps.group], v)
    forces = torch.stack((Hv, qps.g, torch.einsum("brd,br->bd", qps.G[qps.group], lam)))
    outside = (y - y.clip(qps.l, qps.u)).abs()
    charge = outside * qps.w.masked_fill(hard, 0)
    up, down = qps.u.nan_to_num(posinf=0) - y, qps.l.nan_to_num(neginf=0) - y
    gap = (charge + lam.clamp(min=0) * up + lam.clamp(max=0) * down).abs().sum(-1)
    cost = (v * (Hv / 2 + qps.g)).sum(-1) + charge.sum(-1)
    slope = forces.sum(0).abs().amax(-1) / (1 + forces.abs().amax((0, -1)))
    over = ((lam.abs() - qps.w).clamp(min=0) / (1 + qps.w.masked_fill(hard, 0))).amax(-1)
    errors = slope, (outside * hard / (1 + y.abs())).amax(-1), over, gap / (1 + cost.abs())
    return torch.stack(errors).amax(0)


def random_qps(
    seed: int, *, count: int = 16, d: int = 6, rank: int | None = None, twice: bool = True
) -> SoftQPs:
    """Draw feasible and bounded QPs with repeated rows; half of their bounds meet in a vertex."""
    random = np.random.default_rng(seed)
    factor = random.standard_normal((1, d, d if rank is None else rank))
    G = random.standard_normal((1, 6, d))
    G = np.concatenate([G, G if twice else random.standard_normal((1, 6, d)), np.eye(d)[None]], 1)
    v = random.standard_normal((count, d))
    y = v @ G[0].T
    room = random.uniform(0, 1, (2, *y.shape)) * (random.random((2, *y.shape)) < 0.5)
    w = 10.0 ** random.choice([-1, 0, 2], y.shape)
    w[random.random(y.shape) < 0.3] = np.inf
    room[:, :, -d:], w[:, -d:] = 3.0, np.inf
    return SoftQPs(
        H=factor @ factor.transpose(0, 2, 1) / d,
        G=G,
        group=np.zeros(count, dtype=np.int64),
        g=random.standard_normal((count, d)) * 10 ** random.uniform(-1, 2, (count, 1)),
        l=y - room[0],
        u=y + room[1],
        w=w,
    )


@pytest.mark.parametrize("rank", [None, 0, 2], ids=["convex", "linear", "rank 2"])
@pytest.mark.parametrize("d", [1, 6])
def test_vertices_dependent_rows_and_flat_costs(d, rank):
    for seed in range(6):
        qps = random_qps(seed, d=d, rank=rank)
        answer = interior_point.solve(qps)
        assert residual(qps, answer).max() <= 1e-7
        assert answer.iterations.max() <= 40


# Degenerate shapes


@pytest.mark.parametrize("matrices", [0, 1, 3])
def test_an_empty_batch(matrices):
    none, group = np.zeros((0, 4)), np.zeros(0, dtype=np.int64)
    H, G = np.zeros((matrices, 2, 2)), np.zeros((matrices, 4, 2))
    answer = interior_point.solve(
        SoftQPs(H=H, G=G, group=group, g=np.zeros((0, 2)), l=none, u=none, w=none)
    )
    assert [x.shape for x in answer] == [(0, 2), (0, 4), (0,)]


def three(first: float, second: float) -> np.ndarray:
    return np.tile([float(first), float(second)], (3, 1))


def one_row(count: int = 3, **changes: Any) -> SoftQPs:
    """Make min 1/2 |v|^2 + (9, 9)'v with v_1 in [-1, 1], a hard row, and a soft row of zeros."""
    ones = np.ones((count, 2))
    arrays: dict[str, np.ndarray] = {
        "H": np.eye(2)[None],
        "G": np.array([[[1.0, 0.0], [0.0, 0.0]]]),
        "group": np.zeros(count, dtype=np.int64),
        "g": 9 * ones,
        "l": -ones,
        "u": ones,
        "w": np.tile([np.inf, 5.0], (count, 1)),
    }
    return SoftQPs(**(arrays | changes))


def test_without_variables_the_rows_are_only_checked():
    answer = interior_point.solve(
        one_row(H=np.zeros((1, 0, 0)), G=np.zeros((1, 2, 0)), g=np.zeros((3, 0)))
    )
    assert_allclose(answer.lam, np.zeros((3, 2)), atol=1e-9)


@pytest.mark.parametrize(
    ("changes", "v_1", "lam_1"),
    [
        ({}, -1, -8),
        ({"w": three(5, 5)}, -4, -5),
        ({"w": three(0, 0)}, -9, 0),
        ({"l": np.full((3, 2), -np.inf)}, -9, 0),
        ({"l": np.full((3, 2), -1e30), "u": np.full((3, 2), 1e30)}, -9, 0),
        ({"l": np.full((3, 2), -np.inf), "u": np.full((3, 2), np.inf)}, -9, 0),
        ({"l": np.zeros((3, 2)), "u": np.zeros((3, 2))}, 0, -9),
        ({"l": np.zeros((3, 2)), "u": np.zeros((3, 2)), "w": np.full((3, 2), 5.0)}, -4, -5),
    ],
    ids=["hard", "soft", "weightless", "one-sided", "far bounds", "free", "equal", "soft equal"],
)
def test_one_row(changes, v_1, lam_1):
    answer = interior_point.solve(one_row(**changes))
    assert_allclose(answer.v, np.tile([v_1, -9.0], (3, 1)), atol=1e-9)
    assert_allclose(answer.lam, np.tile([lam_1, 0.0], (3, 1)), atol=1e-9)


# QPs without a solution

ALIKE, HARD = np.ones((1, 2, 2)), three(np.inf, np.inf)
FLAT = np.zeros((1, 2, 2))
HOPELESS = {
    "infeasible": one_row(G=ALIKE, l=three(-np.inf, 2), u=three(1, np.inf), w=HARD),
    "equalities that conflict": one_row(G=ALIKE, l=three(1, 2), u=three(1, 2), w=HARD),
    "unbounded": one_row(H=FLAT),
    "unbounded beyond soft rows": one_row(H=FLAT, w=np.ones((3, 2))),
}


@pytest.mark.parametrize("case", HOPELESS)
def test_without_a_solution_the_answer_is_finite_and_soon(case):
    qps = HOPELESS[case]
    answer = interior_point.solve(qps)
    assert np.isfinite(answer.v).all()
    assert np.isfinite(answer.lam).all()
    assert answer.iterations.max() <= MAX_ITERATIONS
    assert residual(qps, answer).min() > 1e-3


# One code for all devices
