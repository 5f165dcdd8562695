"""A house whose wall and heater are hidden: only the air's temperature is measured.

    C_i dT_i/dt = (T_h - T_i) / R_hi + (T_e - T_i) / R_ie + g_A sun + gain
    C_h dT_h/dt = (T_i - T_h) / R_hi + q
    C_e dT_e/dt = (T_i - T_e) / R_ie + (T_out - T_e) / R_ea

References:
    leap-c's house with three states, whose constants were identified for BOPTEST's test case
    bestest_hydronic. Weather and gain are chosen here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import ClassVar

import torch
from torch import Tensor

from torch_qpmpc.envs.heated_house import DAY, DT, GAIN, OUTDOOR, HeatedHouse, during, hours
from torch_qpmpc.envs.linear_system import Rng, float64

#: Position of the sun in w.
SUN = OUTDOOR + 1
#: Heat capacities of air, heater and wall in kWh/K: J/K / 3.6e6.
C_I, C_H, C_E = 1914908.30860716 / 3.6e6, 4015.39425109821 / 3.6e6, 15545663.6743828 / 3.6e6
#: Thermal resistances heater to air, air to wall and wall to outdoors, in K/kW: 1000 K/W.
R_HI, R_IE, R_EA = 76.1996125919563, 1.35151763922409, 7.51396226986365
#: Effective area of the windows in m2.
G_A = 10.1265729225269
#: Mean outdoor temperature in degrees Celsius.
MEAN_OUTDOOR = 2.0
#: Start of air, heater and wall in degrees Celsius, after a day of heating.
START = (18.0, 18.0, 15.0)


@dataclass(frozen=True, eq=False, kw_only=True)
class HouseWall(HeatedHouse):
    """A house x = [T_i, T_h, T_e], y = T_i, with 0 <= q <= 5 kW, discretised exactly.

    The signals are w = [price, lower, upper, T_out, sun | gain], the sun in kW/m2; its forecast and
    that of T_out are exact, as in leap-c's house. T_out is 2 degrees, plus an offset with standard
    deviation 3, plus a swing of 2 to 5 K with its maximum at 15 h; offset and swing are drawn for
    each midnight and change linearly between. The sun shines from 8 to 16 h, with clouds of its own
    each day, to at most 0.25 kW/m2.
    """

    n_weather_draws: ClassVar[int] = 3

    ub_a: Tensor = field(default_factory=float64(5.0))
    n_d: int = 5
    past: int = 8
    upper: float = 22.0
    evening_gain: float = 0.8
    gain_std: float = 0.2

    def model(self) -> tuple[Tensor, Tensor, Tensor]:
        return self._model

    @cached_property
    def _model(self) -> tuple[Tensor, Tensor, Tensor]:
        """A, B and E, from the matrix exponential of the dynamics and of constant inputs."""
        n_w = self.n_d + 1
        dynamics = self.lb_a.new_zeros(4 + n_w, 4 + n_w)
        dynamics[0, :3] = dynamics.new_tensor([-1 / R_HI - 1 / R_IE, 1 / R_HI, 1 / R_IE]) / C_I
        dynamics[1, :2] = dynamics.new_tensor([1 / R_HI, -1 / R_HI]) / C_H
        dynamics[2, :3] = dynamics.new_tensor([1 / R_IE, 0.0, -1 / R_IE - 1 / R_EA]) / C_E
        inputs = dynamics[:, 4:]
        dynamics[1, 3] = 1 / C_H
        inputs[0, SUN], inputs[0, GAIN] = G_A / C_I, 1 / C_I
        inputs[2, OUTDOOR] = 1 / (R_EA * C_E)
        discrete = torch.linalg.matrix_exp(DT * dynamics)[:3]
        return discrete[:, :3], discrete[:, 3:4], discrete[:, 4:]

    def weather(self, draws: Tensor) -> Tensor:
        hour = hours(len(draws)).to(draws)
        day = torch.arange(len(draws), device=draws.device) // DAY
        # Rows 0 and 1, then the first row of each later day, are those of the midnights.
        midnights = torch.cat((draws[1:2], draws[::DAY])).movedim(1, 0)
        offset, swing = 3 * midnights[..., 0], 2 + 3 * torch.special.ndtr(midnights[..., 1])
        offset, swing = (torch.lerp(x[:, day], x[:, day + 1], hour / 24) for x in (offset, swing))
        outdoor = MEAN_OUTDOOR + offset + swing * torch.sin(2 * math.pi * (hour - 9) / 24)
        clear = torch.special.ndtr(draws[::DAY, :, 2]).mT[:, day]
        height = torch.sin(math.pi * (hour - 8) / 8).relu() * during(hour, 8, 16)
        return torch.stack((outdoor, 0.25 * clear * height), dim=-1)

    def starts(self, rng: Rng, count: int) -> Tensor:
        return self.lb_a.new_tensor(START).expand(count, 3).clone()
