"""A heat pump, on or off, by day-ahead prices: ``python docs/examples/heat_pump.py FILE.png``.

A house with a slow floor is to stay within a comfort band, whose lower bound falls at night. The
pump takes 3 kW or nothing, stays on for 90 minutes and off for an hour at least, and each start
costs. Its controller has a model from a log, knows prices, weather and band 12 hours ahead, and not
the sun in the windows. A plan for all days at once that knows everything (a mixed-integer linear
program in HiGHS) bounds what can be saved, and a thermostat is the usual.
"""

from __future__ import annotations

import sys
from typing import NamedTuple

import numpy as np
import pandas as pd
import scipy.sparse as sp
from matplotlib.figure import Figure
from scipy.optimize import Bounds, LinearConstraint, milp

import torch_qpmpc as qm

DT, N, DAYS = 0.5, 24, 10  # hours, steps of the horizon, days
POWER, MIN_ON, MIN_OFF = 3.0, 3, 2  # kW, steps
START, DISCOMFORT, HIGH, MARGIN = 0.05, 1.0, 23.0, 0.3  # EUR, EUR per K and hour, degC, K
WARM, SHOWN = 20.8, slice(96, 240)  # degC at the start, steps of the picture
# Air and floor lose heat to each other and to the weather, in K an hour.
A = np.eye(2) + DT * np.array([[-0.42, 0.35], [0.05, -0.055]])
B, E = DT * np.array([0.15, 0.14]), DT * np.array([0.07, 0.005])  # per kW, and per K outside
SUN = DT * np.array([0.5, 0.0])


class Days(NamedTuple):
    """Signals by step: price in EUR per kWh, weather in degC, the lower bound, and the sun."""

    price: np.ndarray
    T_out: np.ndarray
    low: np.ndarray
    sun: np.ndarray

    def ahead(self, k: int) -> dict[str, np.ndarray]:
        """Return what is known of the steps k, .., k + N; the price is that of a step."""
        part = slice(k, k + N + 1)
        low = self.low[part] + MARGIN
        return {"price": DT * self.price[part], "T_out": self.T_out[part], "low": low}


def days(count: int, seed: int) -> Days:
    """Draw days, and one more that plans look into."""
    rng, steps = np.random.default_rng(seed), round(24 / DT)
    hour = DT * np.arange((count + 1) * steps) % 24

    def daily(low: float, high: float) -> np.ndarray:
        return rng.uniform(low, high, count + 1).repeat(steps)

    def peak(at: float) -> np.ndarray:
        return np.exp(-(((hour - at) / 1.8) ** 2))

    price = daily(0.16, 0.3) + daily(0.05, 0.2) * (peak(8) + peak(19)) - daily(0, 0.1) * peak(13)
    T_out = daily(-5, 7) - 3 * np.cos(2 * np.pi * (hour - 3) / 24)
    sun = daily(0, 1) * np.clip(np.sin(np.pi * (hour - 8) / 9), 0, None) * (hour > 8)
    return Days(price, T_out, np.where((hour >= 6) & (hour < 22), 20.5, 18.5), sun)


def step(x: np.ndarray, q: float, one: Days, k: int) -> np.ndarray:
    return A @ x + B * q + E * one.T_out[k] + SUN * one.sun[k]


def from_log(seed: int = 1) -> qm.Controller:
    """Return the controller of a model that 20 days of switching have shown."""
    rng, one, x, rows = np.random.default_rng(seed), days(20, seed), np.full(2, 20.0), []
    q = POWER * rng.integers(0, 2, len(one.price) // 4).repeat(4)
    for k, on in enumerate(q):
        on = POWER * (x[0] < 21) if abs(x[0] - 21) > 2 else on
        rows.append((k * DT * 3600, x[0] + 0.05 * rng.normal(), on, one.T_out[k]))
        x = step(x, on, one, k)
    table = pd.DataFrame(rows, columns=["t", "T", "q", "T_out"])
    log = qm.read_log(table, outputs=["T"], inputs=["q"], known=["T_out"], time="t")
    mpc = qm.LinearMPC(
        qm.identify(log, horizon=N),
        N,
        known=["T_out", "price", "low"],
        R={"q": 1e-3},  # makes plans unique, as the export as C needs them
        linear={"q": "price"},
        y_bounds={"T": ("low", HIGH)},
        y_slack={"T": DISCOMFORT * DT},
        u_levels={"q": (0.0, POWER)},
        min_on={"q": MIN_ON},
        min_off={"q": MIN_OFF},
        start_cost={"q": START},
    )
    return qm.Controller(mpc)


def optimized(controller: qm.Controller, one: Days, steps: int, seed: int = 0) -> np.ndarray:
    """Return T and q of the closed loop, ``(steps, 2)``."""
    rng, x, rows = np.random.default_rng(seed), np.full(2, WARM), []
    controller.reset(u=[0.0])
    for k in range(steps):
        (q,) = controller.step([x[0] + 0.05 * rng.normal()], known=one.ahead(k))
        rows.append((x[0], q))
        x = step(x, q, one, k)
    return np.array(rows)


def thermostat(one: Days, steps: int) -> np.ndarray:
    """Return T and q of a switch with a hysteresis of 0.6 K; falling at night would cost more."""
    x, q, run, rows = np.full(2, WARM), 0.0, N, []
    for k in range(steps):
        wanted = POWER * (x[0] < one.low.max() + (0.9 if q else 0.3))
        if wanted != q and run >= (MIN_ON if q else MIN_OFF):
            q, run = wanted, 0
        run += 1
        rows.append((x[0], q))
        x = step(x, q, one, k)
    return np.array(rows)


def omniscient(one: Days, steps: int, gap: float = 0.005) -> tuple[np.ndarray, float]:
    """Return T and q of the plan that knows all, and a lower bound of the cost."""
    free, unit = np.empty((steps, 2)), np.zeros((steps, 2))
    free[0], unit[1] = WARM, B
    for k in range(1, steps):
        free[k] = step(free[k - 1], 0.0, one, k - 1)
        unit[k] = A @ unit[k - 1] if k > 1 else unit[k]
    heat = np.array(
        [[unit[k - j, 0] if k > j else 0.0 for j in range(steps)] for k in range(steps)]
    )
    eye, before = sp.eye(steps), sp.eye(steps, k=-1)
    on, off = (sum(sp.eye(steps, k=-j) for j in range(n)) for n in (MIN_ON, MIN_OFF))
    none = sp.csr_matrix((steps, steps))
    # The columns are: on or off, starts, K above or below the band.
    rows = [
        (sp.hstack((eye - before, -eye, none)), -np.inf, 0.0),
        (sp.hstack((-eye, on, none)), -np.inf, 0.0),
        (sp.hstack((sp.eye(steps, k=-MIN_OFF), off, none)), -np.inf, 1.0),
        (sp.hstack((POWER * sp.csr_matrix(heat), none, eye)), one.low[:steps] - free[:, 0], np.inf),
        (sp.hstack((POWER * sp.csr_matrix(heat), none, -eye)), -np.inf, HIGH - free[:, 0]),
    ]
    price = POWER * DT * one.price[:steps]
    cost = np.concatenate((price, np.full(steps, START), np.full(steps, DISCOMFORT * DT)))
    integer, ends = np.repeat([1, 0, 0], steps), np.repeat([1.0, 1.0, np.inf], steps)
    options = {"mip_rel_gap": gap, "time_limit": 600.0}
    limits = [LinearConstraint(D, lower, upper) for D, lower, upper in rows]
    best = milp(
        cost, integrality=integer, bounds=Bounds(0, ends), constraints=limits, options=options
    )
    q = POWER * best.x[:steps].round()
    return np.column_stack((free[:, 0] + heat @ q, q)), best.mip_dual_bound


def cost(one: Days, run: np.ndarray) -> float:
    """Return what a run costs, in EUR."""
    T, q = run.T
    low = one.low[: len(T)]
    starts = np.sum(np.diff(q, prepend=0.0) > 0)
    off = np.maximum(low - T, 0) + np.maximum(T - HIGH, 0)
    return float(DT * (one.price[: len(T)] @ q + DISCOMFORT * off.sum()) + START * starts)


def figure(one: Days, runs: dict[str, np.ndarray], shown: slice = SHOWN) -> Figure:
    """Draw temperatures in the band, the pump and the price of three days."""
    drawn = Figure(figsize=(10, 5), layout="constrained")
    top, *others = drawn.subplots(
        len(runs) + 1, 1, sharex=True, height_ratios=[3] + [1] * len(runs)
    )
    hours = DT * np.arange(len(one.price))[shown]
    top.fill_between(hours, one.low[shown], HIGH, color="0.92", label="comfort")
    for axes, (name, run) in zip(others, runs.items(), strict=True):
        (line,) = top.plot(hours, run[shown, 0], label=name)
        axes.fill_between(hours, run[shown, 1], step="post", color=line.get_color(), alpha=0.6)
        axes.twinx().step(hours, one.price[shown], "k", lw=0.8, where="post")
        axes.set_ylabel("kW")
    top.set_ylabel("T [degC]")
    top.legend(fontsize="small", ncols=4)
    others[-1].set_xlabel("hours; black: price")
    return drawn


if __name__ == "__main__":
    one, steps = days(DAYS, 0), round(DAYS * 24 / DT)
    plan, bound = omniscient(one, steps)
    runs = {"on levels": optimized(from_log(), one, steps), "thermostat": thermostat(one, steps)}
    for name, run in {**runs, "all known": plan}.items():
        print(f"{name}: {cost(one, run) / DAYS:.3f} EUR a day")
    print(f"no plan costs less than {bound / DAYS:.3f}")
    for path in sys.argv[1:]:
        figure(one, runs).savefig(path, dpi=80)
