from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from tests.problems import known_qp, normal
from torch_qpmpc import Status, solve_qp
from torch_qpmpc.qp.pipeline import condensing
from torch_qpmpc.qp.pipeline.arrays import Theta
from torch_qpmpc.qp.solve import solve

# Rows of C for the problems below, with 3 of 8 entries fixed.
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
MIXED = torch.stack((torch.cat((INDEPENDENT, normal(3, 8, seed=5))), REPEATED))


def theta_of(H: Tensor, C: Tensor, G: Tensor) -> Theta:
    none = np.zeros((1, 0))
    return Theta(H.numpy(), C.numpy(), G.numpy(), *[none] * 6)


@pytest.mark.parametrize("name", [*REGULAR, *DEFICIENT, "mixed"])
@pytest.mark.parametrize("n_f", [0, 1, 3])
def test_equalities_of_any_rank_are_solved(name, n_f):
    C = (REGULAR | DEFICIENT | {"mixed": MIXED})[name]
    batch = (4, 2) if name == "mixed" else (5,)
    known = known_qp(4, n_z=8, n_f=n_f, C=C, batch=batch, hard=("inside",))
    solution = solve_qp(known.qp, known.fixed, solver="daqp")
    assert_close(solution.value, known.value)
    assert_close(solution.z, known.z, rtol=1e-5, atol=1e-6)


def test_a_rank_lost_to_the_kept_columns_is_regained_by_keeping_fewer():
    # Only entries 0 to 2 can satisfy row 0, so an elimination that keeps them cannot.
    C = INDEPENDENT.clone()
    C[0, 3:] = 0
    known = known_qp(5, n_z=8, n_f=1, C=C, batch=(3,), hard=())
    solution = solve(known.qp, known.fixed, 3, "daqp", "raise", None)
    assert_close(solution.z, known.z, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("name", ["dependent", "repeated", "many", "zero", "fixed only"])
def test_inconsistent_equalities_are_infeasible(name):
    known = known_qp(6, n_z=8, n_f=3, C=DEFICIENT[name], batch=(2,), hard=())
    b = known.qp.b + torch.tensor([[0.0], [1.0]]).double() * normal(known.qp.b.shape[-1])
    solution = solve_qp(replace(known.qp, b=b), known.fixed, solver="daqp", on_failure="mask")
    assert solution.status.tolist() == [Status.SOLVED, Status.INFEASIBLE]
    assert_close(solution.value[0], known.value[0])


def test_a_row_of_any_scale_counts():
    """Scaling rows of C z = b does not change it."""
    known = known_qp(4)
    scale = torch.tensor([1.0, 1e-11, 1e9]).double()
    C, b = scale[:, None] * known.qp.C, scale * known.qp.b
    solution = solve_qp(replace(known.qp, C=C, b=b), known.fixed, solver="daqp")
    assert_close(solution.z, known.z, rtol=1e-4, atol=1e-4)


def test_only_proximal_steps_shift_what_a_small_curvature_makes_definite():
    G = np.eye(2)[None]
    H = np.diag([1e4, 0.0])[None]
    assert condensing.dual(H, G).shift == pytest.approx(1e4 * condensing.PROXIMAL)
    searched = condensing.dual(H, G, 1e-8)  # not definite up to rounding
    assert searched.shift == pytest.approx(1e4 * condensing.SHIFT)
    assert condensing.dual(H, G, 1e-6).shift == 0


def test_steps_are_the_lengths_of_rows():
    G = torch.tensor([[[1.0, 0.0], [1.2, 1.6]]]).double()
    theta = theta_of(torch.eye(2)[None].double(), torch.zeros(1, 0, 2).double(), G)
    theta = theta._replace(w=np.full((1, 2), np.inf))
    found = condensing.sizes(condensing.condense(theta, 0), theta, 0)
    np.testing.assert_allclose(found.steps, [[1, 2]])
