"""Shared parts of the heated houses: tariff, comfort band, hidden gain and cost.

A step is a quarter of an hour; every episode starts at midnight. Units are kW, kWh, K, hours and
EUR. The signals are w = [price, lower, upper, weather | gain]: all but the gain are known in
advance. The gain is heat from people, with a part that repeats each evening and a random part.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import dataclass, field
from typing import ClassVar

import torch
from torch import Tensor

from torch_qpmpc.checks import check_number, check_tensor
from torch_qpmpc.envs.linear_system import Rng, float64, normal
from torch_qpmpc.envs.plant import Plant

#: Length of a step in hours, and steps of a day.
DT = 0.25
DAY = 96
#: Positions in w of the signals that all houses share.
PRICE, LOWER, UPPER, OUTDOOR, GAIN = 0, 1, 2, 3, -1
#: Prices in EUR/kWh: in the peaks at 7-9 and 17-20 h, and at other times.
PEAK_PRICE, BASE_PRICE = 0.35, 0.15
#: Lower comfort bounds in degrees Celsius: at 22-8 h, and by day.
NIGHT, BY_DAY = 12.0, 17.0
#: Autocorrelation of the gain's random part from step to step.
CORRELATION = 0.9


def hours(length: int) -> Tensor:
    """Return the time of day of ``length`` steps from midnight, in hours."""
    return torch.arange(length, dtype=torch.float64) * DT % 24


def during(hour: Tensor, start: float, end: float) -> Tensor:
    """Return True where ``start <= hour < end``."""
    return (hour >= start) & (hour < end)


@dataclass(frozen=True, eq=False, kw_only=True)
class HeatedHouse(Plant):
    """A linear house x+ = A x + B u + E w, of which y, the air temperature, is the first state.

    The cost of a step, in EUR, is the heat's price and 1 EUR for each K h outside the comfort band:

        L(x, u, w) = DT (price u + max(lower - y, 0) + max(y - upper, 0)).

    Args:
        upper: upper comfort bound, in degrees Celsius.
        evening_gain: the gain at 18-22 h, in kW.
        gain_std: stationary standard deviation of the gain's random part, an AR(1) process, in kW.
    """

    #: Random numbers that the weather of one step takes.
    n_weather_draws: ClassVar[int]

    lb_a: Tensor = field(default_factory=float64(0.0))
    n_y: int = 1
    horizon: int = 32
    upper: float = 21.0
    evening_gain: float = 1.5
    gain_std: float = 0.3

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("evening_gain", "gain_std"):
            check_number(name, getattr(self, name), lambda x: 0 <= x < math.inf, "a number >= 0")

    @abstractmethod
    def model(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return A ``(n_x, n_x)``, B ``(n_x, 1)`` and E ``(n_x, n_w)``."""

    @abstractmethod
    def weather(self, draws: Tensor) -> Tensor:
        """Return the outdoor temperature, then any other weather, ``(count, length, n_d - 3)``.

        ``draws`` ``(length, count, n_weather_draws)`` are standard normal numbers.
        """

    def signals(self, rng: Rng, count: int, length: int) -> Tensor:
        """Draw w ``(count, length, n_w)``; a greater ``length`` extends the same episodes."""
        draws = normal(rng, length, count, 1 + self.n_weather_draws)
        hour = hours(length).to(draws).expand(count, length)
        peak = during(hour, 7, 9) | during(hour, 17, 20)
        price = torch.where(peak, PEAK_PRICE, BASE_PRICE).to(draws)
        lower = torch.where(during(hour, 8, 22), BY_DAY, NIGHT).to(draws)
        known = torch.stack((price, lower, torch.full_like(lower, self.upper)), dim=-1)
        evening = torch.where(during(hour, 18, 22), self.evening_gain, 0.0).to(draws)
        gain = evening + self._random_gain(draws[..., 0])
        return torch.cat((known, self.weather(draws[..., 1:]), gain.unsqueeze(-1)), dim=-1)

    def output(self, x: Tensor, w: Tensor) -> Tensor:
        return x[..., :1]

    def cost(self, x: Tensor, u: Tensor, w: Tensor) -> Tensor:
        return DT * (w[..., PRICE] * u[..., 0] + self.violation(x, w))

    def output_cost(self, y: Tensor, u: Tensor, d: Tensor) -> Tensor:
        return self.cost(y, u, d)

    def step(self, x: Tensor, u: Tensor, w: Tensor) -> Tensor:
        A, B, E = self.model()
        check_tensor("x", x, len(A))
        return x.to(A) @ A.mT + u.to(A) @ B.mT + w.to(A) @ E.mT

    def violation(self, x: Tensor, w: Tensor) -> Tensor:
        """Return how far the air is outside the comfort band, in K, ``(*batch,)``."""
        y = x[..., 0]
        return (w[..., LOWER] - y).relu() + (y - w[..., UPPER]).relu()

    def _random_gain(self, draws: Tensor) -> Tensor:
        """Return the AR(1) process, which starts at 0, ``(count, length)``."""
        innovations = self.gain_std * math.sqrt(1 - CORRELATION**2) * draws
        gain = [torch.zeros_like(draws[0])]
        for innovation in innovations[1:]:
            gain.append(CORRELATION * gain[-1] + innovation)
        return torch.stack(gain, dim=-1)
