"""The tables: multipliers move rows and actions as they say, and bad costs are refused."""

import pytest
import torch

from tests.problems import drawn_mpc
from tests.refused import refused
from torch_qpmpc import QPError
from torch_qpmpc.export.tables import make_tables


def test_a_cost_that_is_singular_on_the_plan_is_refused():
    mpc = drawn_mpc(1, 2, 3, B=[[1.0, 1.0]], stage_weight=[1.0, 0.0, 0.0])
    match = r"H: got eigenvalues from .*, expected a cost that is positive definite.*Give the"
    with pytest.raises(QPError, match=match):
        make_tables(mpc)


@refused(
    *(
        (
            x,
            torch.nan,
            f"{x}: got NaN or inf, expected a finite theta. Export a theta that mpc.value",
        )
        for x in ("q", "C", "b", "lb")
    ),
    ("lb", 2.0, "lb: got entries above ub, expected lb <= ub in every row"),
)
def test_a_theta_with_nan_or_crossed_bounds_is_refused(part, value):
    mpc = drawn_mpc(1, 1, 2, stage_weight=[1.0, 1.0], action_bounds=([-1.0], [1.0]))
    with torch.no_grad():
        getattr(mpc, part).fill_(value)
    make_tables(mpc)
