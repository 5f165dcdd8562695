"""Closed loops of a controller: `Controller.simulate`, and the loop with its own model."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from torch_qpmpc.checks import check_seed, check_whole
from torch_qpmpc.control.design import Design
from torch_qpmpc.control.law import PLANNED, Law, Memory, Signals, settled
from torch_qpmpc.control.scaling import FAINT, Scaling
from torch_qpmpc.control.state_space import Array, StateSpace, read_model, read_table, read_vector
from torch_qpmpc.errors import QPError, SolverError

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False)
class Run:
    """Signals of a closed loop of T steps.

    Of a controller's ``design`` it has measured outputs ``y`` and set-points ``r``,
    ``(T + 1, n_y)``, inputs ``u`` and those that hold the target ``u_s``, ``(T, m)``, known signals
    ``(T, n_d)``, and ``u_last``, the input before the first step ``(m,)``.
    """

    design: Design
    y: Array
    r: Array
    u: Array
    known: Array
    u_s: Array
    u_last: Array

    def __repr__(self) -> str:
        """Return its size, cost and end."""
        last = dict(zip(self.design.plant.outputs, self.y[-1].round(4).tolist(), strict=True))
        return f"Run({len(self.u)} steps, cost {self.cost.sum():.4g}, at the end {last})"

    @property
    def cost(self) -> Array:
        """The `costs` about the run's own targets, ``(T,)``."""
        return self.costs(self.u_s)

    def costs(self, u_s: Array) -> Array:
        """Return the cost of each step, ``(T,)``, with weights of inputs about ``u_s`` ``(T, m)``.

        It is ``(y - r)'Q(y - r) + (u - u_s)'R(u - u_s) + du'dR du``, with prices and the price of
        violations of outputs' bounds.
        """
        du = np.diff(self.u, axis=0, prepend=self.u_last[None])
        signals = self.y[:-1], self.r[:-1], self.u, u_s, du, self.known
        return self.design.costs(*map(torch.from_numpy, signals)).numpy()

    def plot(self) -> Figure:
        """Return a figure with a panel for each output, input and known signal."""
        from torch_qpmpc.analysis.plots import episode_figure  # imports matplotlib

        plant, known = self.design.plant, np.vstack((self.known, self.known[-1:]))
        times = (plant.dt or 1.0) * np.arange(len(self.y))
        signals = times, self.y, self.u, self.r, *self.design.bounds_at(known)[0]
        times, y, u, r, lower, upper = map(torch.from_numpy, signals)
        outputs, inputs, names = (
            [*map(plant.label, x)] for x in (plant.outputs, plant.inputs, plant.known)
        )
        known = dict(zip(names, map(torch.from_numpy, self.known.T.copy()), strict=True))
        options = {"band": (lower, upper), "references": r, "outputs": outputs, "actions": inputs}
        xlabel = "step" if plant.dt is None else "time"
        return episode_figure(times, y, u, signals=known, xlabel=xlabel, **options)


def simulate(
    law: Law, memory: Memory, plant: Any, steps: int, r: Any, *, u: Any = None, **options: Any
) -> Run:
    """Return a closed loop; see `Controller.simulate`."""
    last = memory.rest[1] if u is None else read_table("u", u, law.design.plant.inputs, 1)[0]
    if last is None and law.design.plant.dynamics is not None:
        last = law.design.plant.point[-len(law.design.plant.inputs) :]
    begun = law.begun(last, not hasattr(plant, "reset"))
    options["near"] = 1.0 if u is None else FAINT
    loop = closed_loop(law, memory, plant, steps, r, begun.u, law.policy(begun), **options)
    signals, moves, following = zip(*loop, strict=True)
    y, r, d = map(np.array, zip(*signals, strict=True))
    y, r = np.vstack((y, following[-1])), np.vstack((r[:, 0], r[-1, 1]))
    u, u_s = np.array([(x.u, np.atleast_2d(x.target.u)[0]) for x in moves]).swapaxes(0, 1)
    return Run(law.design, y, r, u, d[:, 0], u_s, begun.u)


def closed_loop(
    law: Law,
    memory: Memory,
    plant: Any,
    steps: int,
    r: Any,
    u: Array,
    act: Callable[[Signals], Any],
    *,
    known: Any = None,
    load: Any = 0.0,
    noise: Any = 0.0,
    x: Any = None,
    seed: int = 0,
    near: float = 1.0,
) -> Iterator[tuple[Signals, Any, Array]]:
    """Yield the signals of each step, the move of ``act``, and the outputs after it.

    A model starts at rest with the input u, ``near`` the last reset's outputs as
    `Scaling.at_rest` weights them. Other arguments are those of `Controller.simulate`.
    """
    check_whole("steps", steps, 1)
    check_seed(seed)
    design, rows = law.design, law.design.horizon + 1
    announced = known is None and hasattr(plant, "reset")  # by the environment, step by step
    known = memory.known if known is None else known
    d = np.empty((0, 0)) if announced else law.read_known(known, steps + rows, steps)
    set_points = law.read_set_points(r, steps + rows, memory.r)
    load = read_vector("load", load, design.plant.inputs, 0.0)
    noise = read_vector("noise", noise, design.plant.outputs, 0.0)
    if not ((noise >= 0) & np.isfinite(noise)).all():
        raise QPError.expected("noise", f"{noise.tolist()}", "standard deviations >= 0")
    if not hasattr(plant, "reset"):
        model = design.plant if plant is None else read_model(plant)
        own = _known(model, design, d)
        scaling = Scaling.of(model, design.y_bounds, design.u_bounds, design.Q)
        held, aim = (u, own[0]), memory.rest[0]
        y, near = (np.zeros(len(model.C)), 0.0) if aim is None else (aim, near)
        rest = scaling.at_rest(model, *held, y, near)
        if model.dynamics is not None:
            rest = settled(
                model.point[len(own[0]) :][: len(rest)],
                lambda x: scaling.at_rest(model.at(np.concatenate((own[0], x, u))), *held, y, near),
                lambda x: np.append(
                    (model.after(x, *held) - x) / scaling.x, near * (model.C @ x - y) / scaling.y
                ),
            )
        states = [f"x{i + 1}" for i in range(len(model.A))]
        plant = _Model(model, own, rest if x is None else read_vector("x", x, states, 0.0))
    entropy = seed if isinstance(plant, _Model) else (seed, 1)  # an environment draws from seed
    rng, started = np.random.default_rng(entropy), plant.reset(seed=seed)
    if not (isinstance(started, tuple) and len(started) == 2):
        remedy = "Its reset returns the outputs and a dict."
        raise QPError.expected("plant", type(plant).__name__, "Gymnasium's reset and step", remedy)
    observed, info = started
    if np.shape(observed) != noise.shape:
        got = f"an observation of shape {np.shape(observed)}"
        want = f"the outputs alone, {', '.join(design.plant.outputs)}"
        remedy = "Wrap the environment: gymnasium.wrappers.TransformObservation chooses entries."
        raise QPError.expected("plant", got, want, remedy)
    y = observed + noise * rng.normal(size=len(noise))
    for k in range(steps):
        ahead = law.read_known(info.get("known"), rows) if announced else d[k : k + rows]
        signals = Signals(law.read("y", y, 1)[0], set_points[k : k + rows], ahead)
        move = act(signals)
        if move.status not in PLANNED:
            remedy = "Widen the hard bounds, give outputs a y_slack, or start elsewhere, by u or x."
            raise SolverError(f"Step {k} of the loop has no plan: {move.status.name}. {remedy}")
        observed, *_, info = plant.step(move.u + load)
        y = observed + noise * rng.normal(size=len(noise))
        yield signals, move, y


def _known(model: StateSpace, design: Design, d: Array) -> Array:
    """Return the rows of known signals that a model of a design's signals takes."""
    dt, own_dt = model.dt, design.plant.dt
    if dt and own_dt and not np.isclose(dt, own_dt):
        raise QPError.expected("plant", f"dt = {dt:g}", f"the controller's {own_dt:g}")
    got, want = ((*x.outputs, *x.inputs) for x in (model, design.plant))
    if got != want and {*got} == {*want}:
        raise QPError.expected("plant", ", ".join(got), f"the order of {', '.join(want)}")
    got, want = model.sizes[1:], (*design.plant.sizes[1:3], d.shape[1])
    if got != want and got != (*want[:2], 0):
        got, want = ("{} inputs, {} outputs, {} known signals".format(*x) for x in (got, want))
        raise QPError.expected("plant", got, f"the controller's {want}, or none of the last")
    return d[:, : len(model.known)]


@dataclass
class _Model:
    """A model with Gymnasium's ``reset`` and ``step``, which starts at x with known signals d."""

    model: StateSpace
    d: Array
    x: Array
    k: int = 0

    def reset(self, **_: int) -> tuple[Array, dict]:
        return self.model.C @ self.x, {}

    def step(self, u: Array) -> tuple[Array, dict]:
        model = self.model
        self.x = model.after(self.x, u, self.d[self.k])
        self.k += 1
        return model.C @ self.x, {}


def ready(law: Law) -> Law:
    """Return a law with factored QPs and compiled code, by steps with active bounds and without."""
    memory, rows = law.begun(rests=True), (law.design.horizon + 1, 1)
    y, far = law.design.middle, 100.0 * law.design.usual
    if (plant := law.design.plant).dynamics is not None:
        y, far = plant.C @ plant.point[len(plant.known) :][: len(plant.A)], 0.0 * far
    known = np.tile(last_known(law.design, memory), rows)
    for r in (y + far, y):
        memory = law.step(memory, y, np.tile(r, rows), known).memory
    return law


def last_known(design: Design, memory: Memory) -> Array:
    """Return the last known signals ``(n_d,)``: before any the log's means, or nominal ones."""
    if memory.known is not None:
        return memory.known
    names = zip(design.plant.known, design.nominal, strict=True)
    return np.array([design.plant.means.get(name, x) for name, x in names])


def centre(design: Design, known: Array) -> Array:
    """Return the middle of the outputs' bounds, where there are none what the inputs' middle holds.

    An input with one bound is half its range from it.
    """
    half, (lower, upper) = design.scaling.u, design.u_bounds
    u, y = np.clip(0.0, lower + half, upper - half), design.middle
    held = design.plant.C @ design.scaling.at_rest(design.plant, u, known, y, FAINT)
    return np.where(design.ranged, y, np.clip(held, *design.y_bounds))
