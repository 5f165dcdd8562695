"""A double integrator with steps of 0.2, of which the tests of proofs ask questions."""

from typing import Any

import numpy as np

from torch_qpmpc import QPMPC
from torch_qpmpc.proofs import Polytope

A, B = np.array([[1.0, 0.2], [0.0, 1.0]]), np.array([[0.02], [0.2]])
BOX = Polytope.box([-1.0, -0.5], [1.0, 0.5])


def integrator(horizon: int = 3, **options: Any) -> QPMPC:
    arguments = {"stage_weight": [1.0, 1.0, 0.1], "state_bounds": (BOX.lower, BOX.upper)}
    arguments |= {"action_bounds": ([-1.0], [1.0]), "solver": "daqp"}
    return QPMPC.from_model(A, B, horizon, **arguments | options)
