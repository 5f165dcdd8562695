"""leap-c's tuned planner of the house: an MPC scheme of three numbers.

They are the assumed resistance R, the weight of the prices and the margin to the lower comfort
bound. leap-c's tutorial (notebook 08) tunes them through the true simulator, as
``python -m tests.benchmarks.tuned_planner`` does here. Two things differ: the planner's violation
costs what it does in the plant, in place of a steep quadratic, and counts at x_k, not at x_{k+1}.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

from torch import Tensor

from torch_qpmpc.envs.heated_house import DT
from torch_qpmpc.envs.house import House
from torch_qpmpc.experiment.heating import known_model
from torch_qpmpc.experiment.rivals.heating import house_mpc
from torch_qpmpc.mpc.module import QPMPC

#: The tutorial's discount of the planner's cost and of the closed loop's, and weight of u^2.
GAMMA, REGULARISATION = 0.99, 1e-3 * DT


class Knobs(NamedTuple):
    """The tuned numbers: R in K/kW, the weight of the prices, and the margin in K."""

    R: Tensor | float
    price_weight: Tensor | float
    margin: Tensor | float


#: The tutorial's start, which imitates an occupant.
START = Knobs(1.6, 0.0, 0.8)
#: The outcome of ``python -m tests.benchmarks.tuned_planner``.
TUNED = Knobs(2.0368, 0.2831, 0.3263)


def planner(house: House, knobs: Knobs) -> QPMPC:
    """Make the planner with these knobs."""
    return house_mpc(
        house,
        known_model(replace(house, R=float(knobs.R))),
        gamma=GAMMA,
        price_weight=float(knobs.price_weight),
        margin=float(knobs.margin),
        regularisation=REGULARISATION,
    )
