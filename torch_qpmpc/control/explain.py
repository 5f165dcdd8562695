"""`Controller.explain`: why the last step did what it did, in the user's names and units."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch

from torch_qpmpc.control.design import Design
from torch_qpmpc.control.disturbance import PREFIX
from torch_qpmpc.control.law import PLANNED, Law, Memory, Outcome, Signals
from torch_qpmpc.control.review import hard_rows, set_points
from torch_qpmpc.control.simulation import Run, last_known
from torch_qpmpc.control.state_space import Array
from torch_qpmpc.qp.pipeline.arrays import BatchSolution

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: A multiplier this small, relative to a typical stage's cost for a usual deviation, is rounding.
ACTIVE = 1e-6
#: A smaller signal's bounds have prices in less than its unit; the first inputs of the text.
SMALL, NEXT = 0.1, 4


class Limit(NamedTuple):
    """A bound that holds the plan back, what a unit more room saves, and its violation."""

    signal: str
    text: str
    price: float
    violation: float


@dataclass(frozen=True, eq=False)
class Explanation:
    """The last step and its plan; ``print`` shows it, and ``plot`` draws the plan.

    Of a ``design`` and its ``status`` it has in ``now`` measured outputs, set-points and known
    signals; in ``u`` and ``y`` the plan's inputs ``(N, m)``, held without one, and the outputs
    after them; in ``limits`` what holds it back, dearest first; the estimated ``disturbances``; and
    in ``reach`` which set-points are in reach, and what to do if r is not.
    """

    design: Design
    status: Outcome
    now: Signals
    u: Array
    y: Array
    limits: tuple[Limit, ...]
    disturbances: Mapping[str, float]
    reach: str

    def __str__(self) -> str:
        plant, lines = self.design.plant, [f"{self.status}: {self.status.explanation}"]
        for i, name in enumerate(plant.outputs):
            aim = f", set-point {self.now.r[0, i]:.4g}" * bool(self.design.Q[i].any())
            steps = f"{len(self.y)} step{'s' * (len(self.y) > 1)}"
            later = f", in {steps} {self.y[-1, i]:.4g}" * bool(np.isfinite(self.y[-1, i]))
            lines.append(f"{plant.quantity(name, self.now.y[i])}{aim}{later}")
        for i, name in enumerate(plant.inputs):
            held = "at rest" if self.design.R[i].any() else "no R holds it"
            rests = f", free: {held} near {self.design.resting[i]:.4g}" * bool(self.design.free[i])
            later = "".join(f", then {x:.4g}" for x in self.u[1:NEXT, i])
            last = f", in {len(self.u) - 1} steps {self.u[-1, i]:.4g}" * (len(self.u) > NEXT)
            lines.append(f"{plant.quantity(name, self.u[0, i])}{later}{last}{rests}")
            levels = self.design.levels.get(name, ())
            decided = self.u[: self.design.switching.get("integer_horizon"), i]
            changed = np.flatnonzero(np.abs(np.diff(decided)) > ACTIVE * self.design.scaling.u[i])
            for k in 1 + changed[:1] if levels else ():
                to = "off" if decided[k] < np.mean(levels[:2]) else f"to {decided[k]:.4g}"
                lines.append(f"{name} goes {to} in {k} step{'s' * bool(k > 1)}")
        of_w = {name.removeprefix(PREFIX): x for name, x in self.disturbances.items()}
        lines += [f"{PREFIX}{plant.quantity(name, x)}" for name, x in of_w.items()]
        free = ["No bound holds the plan back."] * (self.status in PLANNED)
        return "\n".join([*lines, *([x.text for x in self.limits] or free), self.reach])

    def plot(self) -> Figure:
        """Return a figure of the plan, with bounds and set-points."""
        y, rows = np.vstack((self.now.y, self.y)), np.arange(len(self.y) + 1)
        r, known = (x[np.minimum(rows, len(x) - 1)] for x in (self.now.r, self.now.known))
        return Run(self.design, y, r, self.u, known[:-1], self.u, self.u[0]).plot()


def explain(
    law: Law, memory: Memory, status: Outcome, now: Signals, plan: BatchSolution | None
) -> Explanation:
    """Return what a step with a plan has come to, from the memory after it."""
    design, mpc, known = law.design, law.mpc, now.known
    if status == Outcome.INVALID:  # the last valid signals hold
        known = np.tile(last_known(design, memory), (len(known), 1))
    u, e, rows = np.tile(memory.u, (design.horizon, 1)), memory.e, []
    if plan is not None:
        _, moved = mpc.plan.predicted(torch.from_numpy(plan.z[0]))
        u += (moved - moved[0]).numpy()
        u[np.abs(u) < ACTIVE * design.scaling.u] = 0.0
    for k in range(len(u)):
        rows.append(np.full(len(design.Q), np.nan) if e is None else law.observer.H @ e)
        e = e if e is None else law.predicted(e, u[min(k + 1, len(u) - 1)], known[k + 1])
    y = np.array(rows)
    limits = () if plan is None else _limits(design, plan.lam[0], np.vstack((now.y, y)), u, known)
    w = law.estimates(memory)[1]
    names = dict(zip(design.disturbances.names, w.tolist(), strict=True))
    findings = [set_points(mpc, w, known[0], memory.r, False)]
    findings += [x] if status == Outcome.INFEASIBLE and not (x := hard_rows(design)).ok else []
    reach = "\n".join(f"{x.text} {x.remedy}".rstrip() for x in findings)
    return Explanation(design, status, now, u, y, limits, names, reach)


def _limits(design: Design, lam: Array, y: Array, u: Array, known: Array) -> tuple[Limit, ...]:
    """Return the bounds with multipliers ``lam`` of G's rows, dearest first."""
    plant, N, bands, ends = design.plant, len(u), design.bands, design.ends
    inner, n = np.flatnonzero(design.inner), len(bands.W)
    of_stages, of_end = np.split(lam[len(lam) - N * n - len(ends.W) :], [N * n])
    bands = bands.beside(ends.take(np.s_[len(inner) :]))
    prices = np.zeros((N + 1, len(bands.W)))
    prices[:N, :n] = of_stages.reshape(N, n)
    prices[0, inner] = 0.0  # nothing moves the outputs of this step
    prices[N, [*inner, *range(n, len(bands.W))]] = of_end
    values = np.hstack((y, np.vstack((u, u[-1:])))) @ bands.W.T  # of moves zero, as if within
    sides = bands.at(known[: N + 1] - design.nominal)
    sizes = bands.sizes(design.usual, design.scaling.u)
    rows = zip(bands.names, sizes, prices.T, values.T, *(side.T for side in sides), strict=True)
    limits = []
    for name, size, price, x, *sides in rows:
        for side, sign, bound in zip(("lower", "upper"), (-1, 1), sides, strict=True):
            steps = np.flatnonzero(sign * price * size > ACTIVE * design.typical)
            if not len(steps):
                continue
            over = float(np.nan_to_num(sign * (x - bound)[steps], nan=-np.inf).max())
            over, saved = over * bool(over > ACTIVE * size), abs(price[steps]).sum()
            unit = plant.units.get(name.removeprefix("move of "), "")
            text = f"{name} is at its {side} bound {bound[steps[0]]:.4g} {unit}".rstrip()
            runs = np.split(steps, 1 + np.flatnonzero(np.diff(steps) > 1))
            spans = ", ".join(f"{x[0]} to {x[-1]}" if len(x) > 1 else f"{x[0]}" for x in runs)
            text += f" in step{'s' * (len(steps) > 1)} {spans}"
            text += f", violated by up to {over:.3g}" * bool(over)
            one = 10.0 ** np.floor(np.log10(size)) if size < SMALL else 1.0
            more = f"{one:g} {unit} {'more' if sign > 0 else 'less'}".replace("  ", " ")
            text += f": {more} would save {saved * one:.3g} of the cost."
            limits.append(Limit(str(name), text, float(saved), over))
    return tuple(sorted(limits, key=lambda limit: -limit.price))
