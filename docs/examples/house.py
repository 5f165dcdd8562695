"""A room that is heated by price, learned from its planner's wrong model.

    T+ = T + DT ((T_out - T) / (R C) + (q + gain) / C),    0 <= q <= 12
    cost = DT (price q + max(lower - T, 0) + max(T - upper, 0))

Units are kW, K, hours and EUR. An episode is a day from midnight, in steps of a quarter of an hour.
Price, comfort band and weather are known 8 hours ahead. The gain is heat from people: more each
evening, and a random part, both hidden. Model, tariff and weather are from leap-c's tutorial
(notebooks 06 to 08), whose planner assumes R = 2 where the room has 1.4.

    python train.py task.file=docs/examples/house.py
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch.nn.functional import conv1d, pad

from torch_qpmpc import QPMPC, Bounds, Cost, Model, Scheme
from torch_qpmpc.envs.linear_system import float64, normal
from torch_qpmpc.envs.plant import Plant
from torch_qpmpc.experiment.config import NonNegative
from torch_qpmpc.experiment.tasks import Task, TaskSettings, plant_layout, priced, register
from torch_qpmpc.mpc.layout import band_distance

DT, DAY = 0.25, 96  # hours of a step, steps of a day
PRICE, LOWER, UPPER, OUTDOOR, GAIN = range(5)  # positions in w
CORRELATION = 0.9  # of the gain's random part, from step to step
WINDOW = torch.as_tensor(np.hanning(8) / np.hanning(8).sum())  # smooths the weather's noise


@dataclass(frozen=True, eq=False, kw_only=True)
class House(Plant):
    """w = [price, lower, upper, T_out | gain], and T is measured."""

    lb_a: torch.Tensor = field(default_factory=float64(0.0))
    ub_a: torch.Tensor = field(default_factory=float64(12.0))
    n_y: int = 1
    n_d: int = 4
    horizon: int = 32
    R: float = 1.4
    C: float = 1.5
    gain_std: float = 0.3

    def model(self):
        """Return A, B and E of x+ = A x + B u + E w."""
        E = self.lb_a.new_zeros(1, 5)
        E[0, OUTDOOR], E[0, GAIN] = DT / (self.R * self.C), DT / self.C
        return 1 - E[:, OUTDOOR : OUTDOOR + 1], E[:, GAIN:], E

    def signals(self, rng, count, length):
        draws = normal(rng, length, count, 2)
        hour = (torch.arange(length) * DT % 24).to(draws).expand(count, length)
        peak = (hour >= 7) & (hour < 9) | (hour >= 17) & (hour < 20)
        price = torch.where(peak, 0.35, 0.15).to(draws)
        lower = torch.where((hour >= 8) & (hour < 22), 17.0, 12.0).to(draws)
        known = (price, lower, torch.full_like(lower, 21.0))
        noise = pad(draws[..., 1].mT.unsqueeze(1), (4, 3))
        noise = conv1d(noise, WINDOW.to(noise).expand(1, 1, -1)).squeeze(1)
        outdoor = 8 + 6 * torch.sin(2 * math.pi * (hour - 9) / 24) + noise
        gain = [torch.zeros_like(draws[0, :, 0])]
        for innovation in self.gain_std * math.sqrt(1 - CORRELATION**2) * draws[1:, :, 0]:
            gain.append(CORRELATION * gain[-1] + innovation)
        evening = torch.where((hour >= 18) & (hour < 22), 1.5, 0.0).to(draws)
        return torch.stack((*known, outdoor, evening + torch.stack(gain, -1)), -1)

    def starts(self, rng, count):
        return self.lb_a.new_full((count, 1), 19.0)

    def cost(self, x, u, w):
        return DT * (w[..., PRICE] * u[..., 0] + self.violation(x, w))

    def step(self, x, u, w):
        A, B, E = self.model()
        return x @ A.mT + u.to(A) @ B.mT + w @ E.mT

    def violation(self, x, w):
        return (w[..., LOWER] - x[..., 0]).relu() + (x[..., 0] - w[..., UPPER]).relu()


def heating_scheme(house, model, gamma=1.0, margin=0.0, c=0.0):
    """Make the scheme of the house's cost: prices are cross terms of H, the band is two rows."""
    n_x, n_d = model.E.shape
    H = torch.zeros(n_d + n_x + 1, n_d + n_x + 1).double()
    H[PRICE, -1] = H[-1, PRICE] = DT
    H[-1, -1] = 2e-5  # makes a plan unique
    D = torch.zeros(2, n_d + n_x + 1).double()
    D[:, n_d] = 1.0  # the first state is the air
    D[0, LOWER] = D[1, UPPER] = -1.0
    lower, upper = H.new_tensor([margin, -torch.inf]), H.new_tensor([torch.inf, 0.0])
    bounds = Bounds(
        action_bounds=(house.lb_a, house.ub_a),
        constraints=(D, lower, upper),
        terminal_constraints=(D[:, :-1], lower, upper),
        constraint_slack=DT,
        discount_slack=True,
    )
    cost = Cost(H, H.new_zeros(n_x, n_x), hessian="block", c=c)
    return Scheme(model.layout(house.horizon), model, cost, bounds, gamma)


def known_model(house):
    """Return the true model without the gain; further states of an observer have no effect."""
    (A, B, E), rest = house.model(), house.n_x - 1
    B, E = (pad(matrix, (0, 0, 0, rest)) for matrix in (B, E[:, :GAIN]))
    return Model(pad(A, (0, rest, 0, rest)), B, E)


def make_plant(cfg):
    return House(horizon=cfg.task.horizon)


def wrong_scheme(cfg, house):
    # c is the part of a typical cost, of 21 EUR a day, that lies beyond the horizon.
    gamma, model = cfg.task.gamma, known_model(replace(house, R=2.0))
    c = gamma**house.horizon / (1 - gamma) * 21.0 / DAY if gamma < 1 else 0.0
    scheme = heating_scheme(house, model, gamma, cfg.task.margin, c)
    return replace(scheme, bounds=priced(cfg, scheme.bounds))


def true_scheme(cfg, house):
    scheme = heating_scheme(house, known_model(house))
    return replace(scheme, bounds=priced(cfg, scheme.bounds))


def masks(cfg, house):
    """Learn q at the forecasts only, and of a free C what lies in its band: it is causal."""
    layout = plant_layout(house, house.horizon)
    masks = {"q": torch.arange(layout.n_z) < layout.n_preview}
    if cfg.constraint.structure == "free":
        masks["C"] = band_distance(layout) <= 0
    return masks


class Omniscient:
    """MPC with the true model that sees the gain of the hours ahead."""

    def __init__(self, house):
        self.mpc = QPMPC(heating_scheme(house, Model(*house.model())), learn=(), solver="daqp")

    def begin(self, house, x, w):
        self.house, self.w, self.k = house, w, 0

    def __call__(self, p):
        ahead = self.w[:, self.k : self.k + self.house.horizon + 1]
        self.k += 1
        return self.mpc.policy(torch.cat((ahead.flatten(1), p[:, [self.house.n_preview]]), -1))


def thermostat(house):
    """Make proportional control to 0.75 K above the lower bound of the next two hours."""

    def policy(p):
        d = p[:, : house.n_preview].unflatten(-1, (house.horizon + 1, house.n_d))
        return 10.0 * (d[:, :9, LOWER].amax(1, keepdim=True) + 0.75 - p[:, [house.n_preview]])

    return policy


def episode(house, d):
    return {
        "times": DT * torch.arange(len(d)),
        "xlabel": "hour",
        "outputs": ["air, °C"],
        "actions": ["heating, kW"],
        "band": (d[:, LOWER : LOWER + 1], d[:, UPPER : UPPER + 1]),
        "signals": {"price, EUR/kWh": d[:, PRICE], "outdoors, °C": d[:, OUTDOOR]},
    }


class Settings(TaskSettings):
    margin: NonNegative  # distance to the lower bound, in K, at which the planned violation begins


OPTIONS = {"solver": "daqp", "num_envs": 4, "exploration_std": 1.0, "warmup_steps": 96}
OPTIONS |= {"gate": "act", "gate_interval": None, "defaults": [{"override /constraint": "free"}]}
TASK = {"horizon": 32, "gamma": 0.95, "episode_steps": DAY, "eval_steps": DAY}
TASK |= {"margin": 0.0, "hessian": "block", "learn_cost": ["q", "c"], "discount_slack": True}
TASK |= {"terminal_weight": "identity"}
register(
    Task(
        "house",
        make_plant,
        wrong_scheme,
        true_scheme,
        masks,
        rivals={"thermostat with timer": thermostat, "omniscient": Omniscient},
        episode=episode,
        settings=Settings,
        defaults={**OPTIONS, "task": TASK},
    )
)
