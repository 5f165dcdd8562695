"""The house's comfort band over a day, from any temperature in the band and with any gain.

    python -m tests.benchmarks.comfort --write

p has a day's forecasts, which are fixed, and the temperature, which is not: at each of 96 steps
the law of this one entry is listed by regions. It is continuous, so that the temperatures of the
next step are an interval, with ends at vertices of regions. The gain is within 0.6 kW, twice its
standard deviation, of 1.5 kW in the evening and of none at other times. The attack is 1,000 days
from both ends of the band with the gain at an end, for the whole day or at random. The worst case
of the first step is also that of a mixed-integer program, with one entry that varies. Seconds are
the process's.
"""

from __future__ import annotations

import time
from typing import NamedTuple

import numpy as np

from tests.benchmarks.rows import main
from tests.runs import make_config
from torch_qpmpc import QPMPC
from torch_qpmpc.envs import House
from torch_qpmpc.envs.heated_house import DAY, GAIN, LOWER, OUTDOOR, UPPER, hours
from torch_qpmpc.experiment.tasks import make_mpc, make_physics, make_true_mpc
from torch_qpmpc.proofs import Plant, Polytope, explicit_law, largest_violation
from torch_qpmpc.proofs.questions import action

Array = np.ndarray
TITLES = (
    *("policy", "n_p", "too cold, K (attack), at", "too warm, K (attack)", "regions", "CPU, s"),
    "first step as MILP: nodes, CPU, s",
)
SPREAD, EVENING, DAYS = 0.6, 1.5, 1000
#: The horizon, the planner's margin in K, and whether its model is the true one.
CASES = {
    **{f"N = {N}, the planner's model": (N, 0.0, False) for N in (8, 16, 32)},
    "N = 32, its model, margin of 1.0 K": (32, 1.0, False),
    "N = 32, the true model": (32, 0.0, True),
}
#: The largest horizon that HiGHS is asked about.
MOST = 16


class Day(NamedTuple):
    """A policy, the plant ``T+ = a T + b q + r_k + e gain``, and the signals of each step."""

    mpc: QPMPC
    a: float
    b: float
    e: float
    rest: Array
    gain: Array
    bands: Array
    known: Array

    @classmethod
    def of(cls, horizon: int, margin: float, *, true: bool) -> Day:
        cfg = make_config("task=house", f"task.horizon={horizon}", f"task.margin={margin}")
        house = make_physics(cfg)
        assert isinstance(house, House)
        mpc = make_true_mpc(cfg, house) if true else make_mpc(cfg, house)
        assert mpc is not None
        length = DAY + horizon + 1
        w = house.signals(np.random.default_rng(0), 1, length)[0].numpy()
        known = [w[k : k + horizon + 1, : mpc.n_d].ravel() for k in range(DAY)]
        evening = np.where((hours(DAY).numpy() >= 18) & (hours(DAY).numpy() < 22), EVENING, 0.0)
        A, B, E = (x.numpy() for x in house.model())
        return cls(
            mpc, A.item(), B.item(), E[0, GAIN], w[:DAY, OUTDOOR] * E[0, OUTDOOR],
            np.column_stack((evening - SPREAD, evening + SPREAD)),
            w[: DAY + 1, [LOWER, UPPER]], np.array(known),
        )  # fmt: skip

    def following(self, k: int, T: Array, q: Array, gain: Array | float) -> Array:
        """Return the next temperatures."""
        return self.a * T + self.b * q + self.rest[k] + self.e * gain


def reached(day: Day) -> tuple[Array, int]:
    """Return the least and the largest temperature after each step, and the regions in all."""
    ends, count, basis = day.bands[0], 0, np.eye(day.mpc.n_p)[:, -1:]
    reached = []
    for k in range(DAY):
        origin = np.append(day.known[k], 0.0)
        law = explicit_law(day.mpc, Polytope.box(ends[:1], ends[1:]), origin=origin, basis=basis)
        assert law.covered == 1
        T = np.concatenate([x.vertices[:, 0] for x in law.regions])
        q = np.concatenate([(x.vertices @ x.K.T + x.k)[:, 0] for x in law.regions])
        following = day.following(k, T, q, 0.0) + day.e * day.gain[k, :, None]
        ends, count = np.array([following.min(), following.max()]), count + len(law.regions)
        reached.append(ends)
    return np.array(reached), count


def attacked(day: Day) -> Array:
    """Return the least and the largest temperature after each step of the attack."""
    generator, ends = np.random.default_rng(1), []
    high = generator.integers(0, 2, (DAY, DAYS))
    high[:, :100], high[:, -100:] = 0, 1
    T = np.tile(day.bands[0], DAYS // 2)
    for k in range(DAY):
        p = np.column_stack((np.tile(day.known[k], (DAYS, 1)), T))
        T = day.following(k, T, action(day.mpc, p)[:, 0], day.gain[k, high[k]])
        ends.append((T.min(), T.max()))
    return np.array(ends)


def first_step(day: Day, ends: Array) -> str:
    """Ask HiGHS whether the first step stays within ``ends``, up to its tolerance."""
    n, unit = day.mpc.n_p, np.eye(day.mpc.n_p)[-1]
    noise = Polytope.box(day.gain[0, :1], day.gain[0, 1:])
    B, E = (unit[:, None] * x for x in (day.b, day.e))
    offset = unit * day.rest[0]
    plant = Plant.of(np.diag(unit * day.a), B, E=E, offset=offset, disturbances=noise)
    states = Polytope.box(*(np.append(day.known[0], end) for end in day.bands[0]))
    lower, upper = (
        np.append(np.full(n - 1, x), y) for x, y in zip((-np.inf, np.inf), ends, strict=True)
    )
    began = time.process_time()
    answer = largest_violation(day.mpc, plant, states, lower, upper)
    assert answer.proved
    assert answer.value > -1e-6
    return f"{answer.nodes:,}, {time.process_time() - began:.1f}"


def measured(name: str) -> list[str]:
    """Measure one row of the table."""
    horizon, margin, true = CASES[name]
    day = Day.of(horizon, margin, true=true)
    began = time.process_time()
    ends, regions = reached(day)
    seconds = time.process_time() - began
    seen = attacked(day)
    assert ((seen - ends) @ np.diag([-1, 1]) < 1e-6).all()
    cold, warm = (
        [float((sign * (x - day.bands[1:])[:, i]).max()) for x in (ends, seen)]
        for i, sign in enumerate((-1, 1))
    )
    coldest = 1 + (day.bands[1:, 0] - ends[:, 0]).argmax()
    return [
        name,
        str(day.mpc.n_p),
        f"{cold[0]:.3f} ({cold[1]:.3f}), {coldest / 4:g} h",
        f"{warm[0]:.3f} ({warm[1]:.3f})",
        str(regions),
        f"{seconds:.1f}",
        first_step(day, ends[0]) if horizon <= MOST else "-",
    ]


if __name__ == "__main__":
    main("comfort", "comfort", TITLES, CASES, measured)
