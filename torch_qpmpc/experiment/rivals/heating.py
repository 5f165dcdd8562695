"""Rivals for the heated houses: thermostat, planners with a fixed model, and the omniscient MPC.

Each is a policy for `plant_loop`: ``begin(plant, x, w)`` starts a batch of days, and a call maps p
``(starts, n_p)``, the forecasts and the last outputs, to heating powers ``(starts, 1)``.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torch_qpmpc.envs.heated_house import (
    CORRELATION,
    DT,
    GAIN,
    LOWER,
    PRICE,
    UPPER,
    HeatedHouse,
)
from torch_qpmpc.qp.program import QuadraticProgram
from torch_qpmpc.qp.solve import solve_qp


def split(plant: HeatedHouse, p: Tensor) -> tuple[Tensor, Tensor]:
    """Return the forecasts ``(starts, N + 1, n_d)`` and the current output ``(starts, n_y)``."""
    n_d = (plant.horizon + 1) * plant.n_d
    return p[:, :n_d].unflatten(-1, (plant.horizon + 1, plant.n_d)), p[:, -plant.n_y :]


class Thermostat:
    """Proportional control of the air to ``offset`` above the lower comfort bound, blind to prices.

    Args:
        offset: in K; it makes up for the droop of proportional control.
        gain: in kW/K.
        ahead: steps by which the setpoint follows a rise of the bound early, like a timer.
    """

    def __init__(self, offset: float, gain: float, ahead: int = 0) -> None:
        self.offset, self.gain, self.ahead = offset, gain, ahead

    def begin(self, plant: HeatedHouse, x: Tensor, w: Tensor) -> None:
        self.plant = plant

    def __call__(self, p: Tensor) -> Tensor:
        d, y = split(self.plant, p)
        setpoint = d[:, : self.ahead + 1, LOWER].amax(1, keepdim=True) + self.offset
        return self.plant.applied(self.gain * (setpoint - y))


class HeatingProgram:
    """The QP of the cheapest heating plan, condensed to the actions u_0, .., u_{N-1}.

        min  sum_k DT (price_weight price_k u_k + regularisation u_k^2) + penalty
        s.t. lower_k + margin - sigma_k <= y_k <= upper_k + sigma_k,   k = 1, .., N

    The penalty is the plant's own, DT sum_k sigma_k, or the tutorial's, DT 50 sum_k sigma_k^2.

    Args:
        plant: bounds of the action.
        model: A, B and E; differentiable, like ``price_weight`` and ``margin``.
        horizon: N.
    """

    def __init__(
        self,
        plant: HeatedHouse,
        model: tuple[Tensor, Tensor, Tensor],
        horizon: int,
        *,
        price_weight: Tensor | float = 1.0,
        margin: Tensor | float = 0.0,
        regularisation: float = 1e-4,
        quadratic: bool = False,
        solver: str = "daqp",
    ) -> None:
        self.plant, self.horizon, self.solver = plant, horizon, solver
        self.A, self.B, self.E = model
        self.price_weight, self.margin = price_weight, margin
        N, one = horizon, torch.eye(horizon, dtype=torch.float64)
        response, responses = self.B, []
        for _ in range(N):
            responses.append(response[0])
            response = self.A @ response
        lag = torch.arange(N).unsqueeze(1) - torch.arange(N)
        gamma = torch.cat(responses)[lag.clamp(min=0)] * (lag >= 0)
        u_rows, y_rows = [one], [gamma]
        ...
