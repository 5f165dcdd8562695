"""MPC of the mean model with a heavier action, tuned by hand."""

from __future__ import annotations

from functools import partial
from typing import Any

from torch_qpmpc.experiment.rivals.rival import Policy, Rival
from torch_qpmpc.mpc.bounds import Bounds
from torch_qpmpc.mpc.cost import Cost
from torch_qpmpc.mpc.layout import Layout
from torch_qpmpc.mpc.model import Model
from torch_qpmpc.mpc.module import QPMPC
from torch_qpmpc.mpc.scheme import Scheme


def heavier(*factors: float) -> dict[str, Rival]:
    """Return rivals by name, whose weights of the action are these factors times the plant's."""
    return {f"{x:g} times the action's weight": Rival(partial(_policy, factor=x)) for x in factors}


def _policy(plant: Any, factor: float) -> Policy:
    """Make MPC of the plant's horizon, without discount."""
    seen = [*range(plant.n_y), -1]  # of the states and the action
    W = plant.W[seen][:, seen]  # a copy
    W[-1, -1] *= factor
    terminal = None if plant.past == 1 else W[:-1, :-1]
    layout = Layout(plant.n_y, 1, plant.horizon, plant.past)
    bounds = Bounds(action_bounds=(plant.lb_a, plant.ub_a))
    cost = Cost(W, terminal, hessian="block")
    A, B, _ = plant.true_model()
    scheme = Scheme(layout, Model(A, B), cost, bounds, gamma=1.0)
    return QPMPC(scheme, learn=(), solver="daqp").policy
