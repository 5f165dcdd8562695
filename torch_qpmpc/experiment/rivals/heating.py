"""Rivals for the heated houses: a thermostat, and MPC that sees more than the learned QP.

Each is a policy for `plant_loop`: ``begin(plant, x, w)`` starts a batch of episodes, and a call
maps p ``(starts, n_p)``, the forecasts and the window, to heating powers ``(starts, 1)``.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torch_qpmpc.envs.heated_house import CORRELATION, GAIN, LOWER, HeatedHouse
from torch_qpmpc.experiment.heating import heating_scheme
from torch_qpmpc.mpc.model import Model
from torch_qpmpc.mpc.module import QPMPC


class Thermostat:
    """Proportional control of the air to ``offset`` above the lower comfort bound, blind to prices.

    Args:
        plant: the house.
        offset: in K; it makes up for the droop of proportional control.
        gain: in kW/K.
        ahead: steps by which the setpoint rises before the bound, like a timer's.
    """

    def __init__(self, plant: HeatedHouse, offset: float, gain: float, ahead: int = 0) -> None:
        self.plant, self.offset, self.gain, self.ahead = plant, offset, gain, ahead

    def __call__(self, p: Tensor) -> Tensor:
        d, y = forecasts(self.plant, p), p[:, -1:]
        setpoint = d[:, : self.ahead + 1, LOWER].amax(1, keepdim=True) + self.offset
        return self.gain * (setpoint - y)


class Omniscient:
    """MPC with the true model, the true state and all signals, the gain included."""

    def __init__(self, plant: HeatedHouse) -> None:
        self._mpc = house_mpc(plant, Model(*plant.model()))

    def begin(self, plant: HeatedHouse, x: Tensor, w: Tensor) -> None:
        """Start at the true states ``x`` of the signals ``w``."""
        self._plant, self._x, self._w, self._k = plant, x, w, 0

    def __call__(self, p: Tensor) -> Tensor:
        plant, k = self._plant, self._k
        signals = self._w[:, k : k + plant.horizon + 1]
        u = plant.applied(self._mpc.policy(torch.cat((signals.flatten(1), self._x), -1)))
        self._x, self._k = plant.step(self._x, u, signals[:, 0]), k + 1
        return u


class KalmanHouseMPC:
    """MPC with the true model of states that a Kalman filter estimates from the air alone.

    The gain is a state of the filter, an AR(1) process like its random part.

    Args:
        plant: the house.
        margin: distance to the lower comfort bound in K at which the planned violation begins.
    """

    #: Standard deviation of the measurement in the filter, in K; the air is measured exactly.
    NOISE = 1e-3

    def __init__(self, plant: HeatedHouse, margin: float = 0.0) -> None:
        A, B, E = plant.model()
        n_x = len(A)
        self._A = torch.block_diag(A, A.new_tensor([[CORRELATION]]))
        self._A[:n_x, -1] = E[:, GAIN]
        self._B, self._E = (torch.cat((M, M[:1] * 0)) for M in (B, E[:, : plant.n_d]))
        self._variance = plant.gain_std**2
        self._mpc = house_mpc(plant, Model(self._A, self._B, self._E), margin=margin)

    def begin(self, plant: HeatedHouse, x: Tensor, w: Tensor) -> None:
        """Start at the true states ``x``, with an unknown gain."""
        self._plant = plant
        self._x = torch.cat((x, 0 * x[:, :1]), -1)
        self._P = torch.zeros_like(self._A)
        self._P[-1, -1] = self._variance

    def __call__(self, p: Tensor) -> Tensor:
        d, y = forecasts(self._plant, p), p[:, -1]
        column = self._P[:, 0] / (self._P[0, 0] + self.NOISE**2)
        x = self._x + torch.outer(y - self._x[:, 0], column)
        P = self._P - torch.outer(column, self._P[0])
        u = self._plant.applied(self._mpc.policy(torch.cat((d.flatten(1), x), -1)))
        self._x = x @ self._A.mT + u @ self._B.mT + d[:, 0] @ self._E.mT
        self._P = self._A @ P @ self._A.mT
        self._P[-1, -1] += (1 - CORRELATION**2) * self._variance
        return u


def forecasts(plant: HeatedHouse, p: Tensor) -> Tensor:
    """Return the known signals d_k, .., d_{k+N} of p, ``(starts, N + 1, n_d)``."""
    return p[:, : plant.n_preview].unflatten(-1, (plant.horizon + 1, plant.n_d))


def house_mpc(plant: HeatedHouse, model: Model, **options: float) -> QPMPC:
    """Make the MPC of a model, with nothing to learn; ``options`` are those of `heating_scheme`."""
    return QPMPC(heating_scheme(plant, model, **options), learn=(), solver="daqp")
