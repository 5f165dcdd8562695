"""Refinement in twice the working precision, and the QPs that only it solves."""

import functools
import json
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from tests.campaign.families import Case, Draw, parallel_rows
from tests.problems import known_qp, programs_of
from torch_qpmpc import QPMPC, QuadraticProgram, solve_qp
from torch_qpmpc.qp.pipeline import refinement
from torch_qpmpc.qp.pipeline.batch import Programs
from torch_qpmpc.qp.pipeline.refinement import products, refine
from torch_qpmpc.qp.pipeline.solve import solve_programs
from torch_qpmpc.qp.program import EVENT_SHAPES


@pytest.mark.parametrize("unit", [1.0, 1e4, 1e6, 1e8])
def test_the_value_does_not_depend_on_the_plants_unit(solver, unit):
    # The terminal weight of one holds x_N at zero in small units: V is the same from 1e4 on.
    mpc = QPMPC.from_model(
        [[0.9]],
        [[0.3 * unit]],
        20,
        stage_weight=[unit**-2, 0.1],
        terminal_weight=[1.0],
        action_bounds=([-1.0], [1.0]),
        solver=solver,
    )
    solution = mpc.solve(torch.tensor([0.1 * unit], dtype=torch.float64))
    assert_close(solution.value.item(), 0.007462864406944, rtol=1e-9, atol=0)
    assert_close(solution.z[1].item(), -0.164190960463, rtol=1e-6, atol=0)
    assert solution.value_error <= 1e-6


def test_a_cost_of_zero_with_actuators_to_spare_is_right_to_rounding(solver):
    """Two actuators hold one output at its set-point: V = 0, and H is flat in the others' plans."""
    A, B = [[0.8, 0.1, 0.0], [0.05, 0.7, 0.0], [0.0, 0.0, 1.0]], [[0.3, 0.17], [0.11, 0.4], [0, 0]]
    error = torch.tensor([0.73, 0.41, -1.0, 0.0, 0.0], dtype=torch.float64)  # y - r
    options: dict[str, Any] = {"stage_weight": error.outer(error), "hessian": "block"}
    options |= {"action_bounds": ([-9.0] * 2, [9.0] * 2), "solver": solver}
    mpc = QPMPC.from_model(A, B, 5, **options)
    x = torch.tensor([[0.3, -0.7], [1.1, 0.9], [0.47, 0.13]], dtype=torch.float64)
    s = torch.cat((x, x @ error[:2, None]), -1)
    assert_close(mpc.value(s), torch.zeros(3).double(), rtol=0, atol=1e-12)


@functools.cache
def parallel(seed: int) -> Case:
    return parallel_rows(Draw(seed), 16)


@pytest.mark.parametrize("seed", range(8))
def test_nearly_parallel_rows_have_the_value_of_exact_arithmetic(solver, seed):
    case = parallel(seed)
    solution = solve_qp(case.known.qp, solver=solver)
    assert_close(solution.value, case.known.value, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("case", [0, 1])
def test_a_flat_direction_has_its_solution_of_least_norm(solver, case):
    text = (Path(__file__).parent / "flat_directions.json").read_text(encoding="utf-8")
    data = {k: torch.tensor(v, dtype=torch.float64) for k, v in json.loads(text)[case].items()}
    n = len(data["q"])
    data |= {"C": data["C"].reshape(-1, n), "b": data["b"].reshape(-1)}
    parts: dict[str, Any] = {name: data[name] for name in EVENT_SHAPES}
    qp = QuadraticProgram(**parts, n_known=len(data["fixed"]))
    solution = solve_qp(qp, data["fixed"], solver=solver)
    assert_close(solution.value, data["value"], rtol=1e-9, atol=0)
    assert solution.z.abs().max() < 2


@pytest.mark.parametrize("held", [False, True])
def test_a_solution_that_ran_along_a_flat_direction_comes_back(held):
    """At 1e5 times its length, the rounding of H alone is worth more than the tolerance.

    ``held``: a row has its far bound there, with a multiplier of rounding size.
    """
    inf, rng = np.inf, np.random.default_rng(0)
    factor = rng.normal(size=(3, 6))
    G, z = rng.normal(size=(2, 6)), rng.normal(size=6)
    lam = np.array([1.0, 1e-14 if held else 0.0])
    far = 1e5 * np.linalg.svd(np.vstack((factor, G[:1])))[2][-1]
    ub = np.array([G[0] @ z, G[1] @ (z + far) if G[1] @ far > 0 else inf])
    q = -factor.T @ factor @ z - G[0]
    G = G * [[1], [np.sign(G[1] @ far)]]
    data = {"H": factor.T @ factor, "q": q, "G": G, "ub": ub}
    parts: Any = {name: torch.as_tensor(x, dtype=torch.float64) for name, x in data.items()}
    p, _ = Programs.of(*QuadraticProgram(**parts).tensors(), torch.zeros(1, 0))
    ran = p.unsolved(0)._replace(z=(z + far)[None], lam=lam[None], active=np.sign(lam)[None])
    refine(p, ran, np.arange(1))
    assert ran.value_error.item() < 1e-12
    assert np.abs(ran.z).max() < 10


@pytest.mark.parametrize("size", [1.0, 1e-150, 1e150])
def test_products_have_twice_the_working_precision(size):
    """Sums of terms that cancel to 1e-20 of their size, some with zeros, beside fractions."""
    rng = np.random.default_rng(0)
    matrix, high = rng.normal(size=(5, 40)) * (rng.uniform(size=(5, 40)) < 0.8), rng.normal(size=40)
    matrix, high, low = matrix * size, high / size, 1e-17 * rng.normal(size=40) / size
    matrix[:, 1], high[:2], low[:2] = -matrix[:, 0], 1e20 * high[2], 0.0
    exact = [
        sum(
            Fraction(a) * (Fraction(x) + Fraction(y))
            for a, x, y in zip(row, high, low, strict=True)
        )
        for row in matrix
    ]
    sums, errors = products(matrix, high, low)
    for i, value in enumerate(exact):
        assert abs(Fraction(sums[i]) + Fraction(errors[i]) - value) < 1e-28 * 1e20


def test_products_with_infinite_numbers_have_no_value():
    assert np.isnan(products(np.zeros((1, 2)), np.array([1.0, np.inf]), np.zeros(2))[0])


@pytest.mark.parametrize("off", [0.0, 1e-6, 1e-3])
def test_a_solution_that_is_nearly_right_becomes_exact(off, monkeypatch):
    known = known_qp(3, batch=(6,))
    p = programs_of(known)
    solution = solve_programs(p, "daqp")
    generator = np.random.default_rng(0)
    for part in (solution.z, solution.lam):
        part += off * generator.standard_normal(part.shape) * (part != 0)
    candidate = solution.at(np.arange(6))
    with monkeypatch.context() as patch:  # a large QP waits for the other ways to fail
        patch.setattr(refinement, "MAX_WORK", 1)
        refine(p, solution, np.arange(6))
        assert (solution.z == candidate.z).all()
        refine(p, candidate, np.arange(6), last=True)
        assert candidate.residual.max() < 1e-14
    refine(p, solution, np.arange(6))
    assert_close(solution.value, known.value.numpy(), rtol=1e-12, atol=1e-12)
    assert_close(solution.z, known.z.numpy(), rtol=1e-9, atol=1e-9)
    assert_close(solution.lam, known.lam.numpy(), rtol=1e-9, atol=1e-9)
    assert solution.residual.max() < 1e-14


def test_only_the_chosen_solutions_change():
    known = known_qp(3, batch=(6,))
    p = programs_of(known)
    solution = solve_programs(p, "daqp")
    before = solution.at(np.arange(6))
    solution.z[2] += 1e-4
    refine(p, solution, np.array([2]))
    others = [0, 1, 3, 4, 5]
    assert_close(solution.z[others], before.z[others], rtol=0, atol=0)
    assert_close(solution.z[2], before.z[2], rtol=1e-5, atol=1e-6)


def test_what_has_no_solution_is_left_as_it_was():
    known = known_qp(0, batch=(2,))
    b = known.qp.b.clone()
    C = torch.cat((known.qp.C, known.qp.C[..., :1, :]), dim=-2)
    qp = replace(known.qp, C=C, b=torch.cat((b, b[..., :1] + 1), dim=-1))
    solution = solve_programs(programs_of(known), "daqp")
    chi = np.pad(solution.chi, ((0, 0), (0, 1)))
    p = programs_of(replace(known, qp=qp))
    candidate = solution._replace(chi=chi)
    refine(p, candidate, np.arange(2))
    assert_close(candidate.z, solution.z, rtol=0, atol=0)


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize("held", [1, 2, 3])
def test_soft_rows_that_the_equations_put_beyond_their_bounds_are_saturated(held, side):
    """An output that rested at its bound, 3e-7 beyond it, left the plan's QP unsolved."""
    bound = (1 - 3e-7) * torch.tensor([1.0, 0.5, 0.25], dtype=torch.float64)[:held]
    G, C = torch.eye(4, dtype=torch.float64)[:held], torch.zeros(3, 4, dtype=torch.float64)
    C[0, 0] = 1.0  # x_0 = 1, x_1 = x_0 / 2, x_2 = x_1 / 2
    C[1, :2] = C[2, 1:3] = torch.tensor([-0.5, 1.0])
    b, far = torch.tensor([side, 0, 0], dtype=torch.float64), torch.full((held,), torch.inf)
    lb, ub = (-far, bound) if side > 0 else (-bound, far)
    f: Any = {"ub": ub.double(), "lb": lb.double(), "w": torch.full((held,), 5.0).double()}
    qp = QuadraticProgram(H=torch.eye(4).double(), q=torch.ones(4).double(), C=C, b=b, G=G, **f)
    p, _ = Programs.of(*qp.tensors(), torch.empty(1, 0, dtype=torch.float64))
    right = solve_programs(p, "daqp")
    start = right.at(np.arange(1))
    start.lam[:] *= 0.4
    start.status[:] = 3
    refine(p, start, np.arange(1))
    assert start.status[0] == 0
    assert_close(start.lam, right.lam, rtol=1e-12, atol=0)
    assert_close(start.value, right.value, rtol=1e-12, atol=0)
