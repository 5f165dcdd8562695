"""A room that is heated by price, after leap-c's tutorial of a differentiable planner.

    T+ = T + DT ((T_out - T) / (R C) + (q + gain) / C)

References:
    leap-c, notebooks/getting_started 06 to 08: model, tariff, comfort band, weather and gain.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import conv1d, pad

from torch_qpmpc.checks import check_number
from torch_qpmpc.envs.heated_house import DT, GAIN, OUTDOOR, HeatedHouse, hours
from torch_qpmpc.envs.linear_system import Rng, float64

#: The air's first temperature in degrees Celsius.
START = 19.0
#: The tutorial smooths the outdoor temperature's noise over two hours.
WINDOW = torch.as_tensor(np.hanning(8) / np.hanning(8).sum())


@dataclass(frozen=True, eq=False, kw_only=True)
class House(HeatedHouse):
    """The tutorial's room: T is measured, 0 <= q <= 12 kW, T_0 = 19 degrees Celsius.

    The signals are w = [price, lower, upper, T_out | gain]. As in the tutorial, the forecast of
    T_out is exact. The comfort of T_k counts at step k, the tutorial's one step earlier.

    Args:
        R: thermal resistance to the outdoors in K/kW; the tutorial's planner assumes 2.
        C: thermal capacity in kWh/K.

    Raises:
        QPError: if an argument does not fit, such as an R that is not positive.

    Example:
        >>> import numpy as np, torch_qpmpc as qm
        >>> house, rng = qm.envs.House(), np.random.default_rng(0)
        >>> w, T = house.signals(rng, 20, 129), house.starts(rng, 20)
        >>> house.step(T, torch.zeros(20, 1), w[:, 0]).shape
        torch.Size([20, 1])
    """

    n_weather_draws: ClassVar[int] = 1

    ub_a: Tensor = field(default_factory=float64(12.0))
    n_d: int = 4
    R: float = 1.4
    C: float = 1.5

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("R", "C"):
            check_number(name, getattr(self, name), lambda x: 0 < x < math.inf, "a number > 0")

    def model(self) -> tuple[Tensor, Tensor, Tensor]:
        E = self.lb_a.new_zeros(1, self.n_d + 1)
        E[0, OUTDOOR], E[0, GAIN] = DT / (self.R * self.C), DT / self.C
        return 1 - E[:, OUTDOOR : OUTDOOR + 1], E[:, GAIN:], E

    def weather(self, draws: Tensor) -> Tensor:
        """Return T_out: 8 degrees, swinging by 6 to its maximum at 15 h, and smoothed noise."""
        noise = draws[..., 0].mT
        noise = conv1d(pad(noise.unsqueeze(1), (4, 3)), WINDOW.to(noise).expand(1, 1, -1))
        swing = 6 * torch.sin(2 * math.pi * (hours(len(draws)) - 9) / 24).to(noise)
        return (8 + swing + noise.squeeze(1)).unsqueeze(-1)

    def starts(self, rng: Rng, count: int) -> Tensor:
        return self.lb_a.new_full((count, 1), START)
