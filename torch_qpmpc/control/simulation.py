"""Closed loops of a controller: `Controller.simulate`, and the loop with its own model."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch

from torch_qpmpc.checks import check_seed, check_whole
from torch_qpmpc.control.design import Design, middle
from torch_qpmpc.control.law import Law, Memory, Move, Signals
from torch_qpmpc.control.linear_mpc import LinearMPC
from torch_qpmpc.control.scaling import FAINT, Scaling
from torch_qpmpc.control.state_space import Array, StateSpace, read_model, read_row, read_vector
from torch_qpmpc.errors import QPError, SolverError
from torch_qpmpc.loops import Step, run_loop

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Steps of the probe, and of each of its set-points.
PROBED, HELD = 100, 25
#: Its set-points and load, relative to half of the bounds' distance.
MOVE, LOAD = 0.5, 0.1


@dataclass(frozen=True, eq=False)
class Run:
    """Signals of a closed loop of T steps.

    Attributes:
        design: the controller's design.
        y, r: measured outputs and set-points, ``(T + 1, n_y)``.
        u: inputs ``(T, m)``.
        known: known signals, ``(T, n_d)``.
        u_s: the inputs that hold the target, ``(T, m)``.
        u_last: the input before the first step, ``(m,)``.
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
        design, y = self.design, self.y[:-1]
        parts = (
            (y - self.r[:-1], design.Q),
            (self.u - u_s, design.R),
            (np.diff(self.u, axis=0, prepend=self.u_last[None]), design.dR),
        )
        cost = sum(np.einsum("ki,ij,kj->k", x, weight, x) for x, weight in parts)
        for name, price in design.linear.items():
            known = isinstance(price, str)
            level = self.known[:, design.plant.known.index(price)] if known else price
            cost = cost + level * self.u[:, design.plant.inputs.index(name)]
        lower, upper = design.bounds_at(self.known)[0]
        outside = np.maximum(np.maximum(lower - y, y - upper), 0.0)
        prices = np.where(outside > 0, design.y_slack, 0.0)  # inf times zero is none
        return cost + (prices * outside).sum(1)

    def plot(self) -> Figure:
        """Return a figure with a panel for each output, input and known signal."""
        from torch_qpmpc.analysis.plots import episode_figure  # imports matplotlib

        plant = self.design.plant
        step = 1.0 if plant.dt is None else plant.dt
        times, y, u, r = (
            torch.from_numpy(x) for x in (step * np.arange(len(self.y)), self.y, self.u, self.r)
        )
        signals = {
            plant.label(name): torch.from_numpy(x)
            for name, x in zip(plant.known, self.known.T.copy(), strict=True)
        }
        known = np.vstack((self.known, self.known[-1:]))
        lower, upper = map(torch.from_numpy, self.design.bounds_at(known)[0])
        return episode_figure(
            times,
            y,
            u,
            signals=signals,
            band=(lower, upper),
            references=r,
            outputs=[plant.label(name) for name in plant.outputs],
            actions=[plant.label(name) for name in plant.inputs],
            xlabel="step" if plant.dt is None else "time",
        )


def simulate(
    law: Law,
    memory: Memory,
    plant: Any,
    steps: int,
    r: Any,
    *,
    known: Any = None,
    u: Any = None,
    load: Any = 0.0,
    noise: Any = 0.0,
    x: Any = None,
    seed: int = 0,
) -> Run:
    """Return a closed loop; see `Controller.simulate`."""
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
    y, last = memory.rest
    begun = law.begun(
        last if u is None else read_row("u", u, design.plant.inputs), not hasattr(plant, "reset")
    )
    if not hasattr(plant, "reset"):
        model = design.plant if plant is None else read_model(plant)
        plant = _Model(model, design, d, begun.u, y, FAINT if u is not None else 1.0, x)
    rng, started = np.random.default_rng(seed), plant.reset(seed=seed)
    if not (isinstance(started, tuple) and len(started) == 2):
        remedy = "Its reset returns the outputs and a dict."
        raise QPError.expected("plant", type(plant).__name__, "Gymnasium's reset and step", remedy)
    observed, info = started
    if np.shape(observed) != noise.shape:
        got = f"an observation of shape {np.shape(observed)}"
        want = f"the outputs alone, {', '.join(design.plant.outputs)}"
        remedy = "Wrap the environment: gymnasium.wrappers.TransformObservation chooses entries."
        raise QPError.expected("plant", got, want, remedy)
    k, act = 0, law.policy(begun)

    def measured() -> Array:
        return observed + noise * rng.normal(size=len(noise))

    def policy(y: Array) -> Move:
        ahead = law.read_known(info.get("known"), rows) if announced else d[k : k + rows]
        move = act(Signals(law.read("y", y, 1)[0], set_points[k : k + rows], ahead))
        if move.target is None:
            remedy = "Widen the hard bounds, or give the outputs a y_slack."
            raise SolverError(f"Step {k} of the loop has no plan: {move.status.name}. {remedy}")
        return move

    def step(move: Move) -> Step:
        nonlocal observed, info, k
        observed, *_, info = plant.step(move.u + load)
        k += 1
        return Step(measured(), move)

    first = measured()
    ys, moves, _ = zip(*run_loop(policy, first, step, steps), strict=True)
    signals = ((move.u, move.memory.known, _first(move.target.u)) for move in moves)
    inputs, passed, u_s = map(np.array, zip(*signals, strict=True))
    measurements = np.array([first, *ys])
    return Run(design, measurements, set_points[: steps + 1], inputs, passed, u_s, begun.u)


def _first(target: torch.Tensor) -> Array:
    """Return the part of a target of the first stage."""
    return target.numpy().reshape(-1, target.shape[-1])[0]


class _Model:
    """A model with Gymnasium's ``reset`` and ``step``, which starts at rest with the input u.

    With outputs y it starts as near to them, with a weight, as `Scaling.at_rest` says.
    """

    def __init__(
        self,
        model: StateSpace,
        design: Design,
        d: Array,
        u: Array,
        y: Array | None,
        weight: float,
        x: Any,
    ) -> None:
        got, want = model.sizes[1:3], design.plant.sizes[1:3]
        if got != want:
            got, want = (f"{m} inputs and {n_y} outputs" for m, n_y in (got, want))
            raise QPError.expected("plant", got, f"the controller's {want}")
        self._model, self._d = model, d if model.known else d[:, :0]
        if self._d.shape[1] != len(model.known):
            got, want = f"{len(model.known)} known signals", f"none, or {d.shape[1]}"
            raise QPError.expected("plant", got, want)
        scaling = Scaling.of(model, design.y_bounds, design.u_bounds, design.Q)
        rest = scaling.at_rest(model, u, self._d[0], y, weight)
        states = [f"x{i + 1}" for i in range(len(model.A))]
        self._start = rest if x is None else read_vector("x", x, states, 0.0)

    def reset(self, *, seed: int) -> tuple[Array, dict]:
        del seed
        self._x, self._k = self._start, 0
        return self._model.C @ self._x, {}

    def step(self, u: Array) -> tuple[Array, dict]:
        model = self._model
        driven = model.B @ u + model.E @ self._d[self._k] + model.offset
        self._x = model.A @ self._x + driven
        self._k += 1
        return self._model.C @ self._x, {}


def last_known(design: Design, memory: Memory) -> Array:
    """Return the known signals of the last step or reset, `Design.nominal` before, ``(n_d,)``."""
    return design.nominal if memory.known is None else memory.known


def centre(design: Design, known: Array) -> Array:
    """Return the middle of the outputs' bounds, where there are none what the inputs' middle holds.

    An input with one bound is half its range from it.
    """
    half, (lower, upper) = design.scaling.u, design.u_bounds
    u, y = np.clip(0.0, lower + half, upper - half), middle(design.y_bounds)
    held = design.plant.C @ design.scaling.at_rest(design.plant, u, known, y, FAINT)
    return np.where(np.isfinite(design.y_bounds).all(0), y, np.clip(held, *design.y_bounds))


def at_rest(mpc: LinearMPC, known: Array) -> tuple[Array, Array]:
    """Return x and u of the model at rest as near to `centre` as its bounds allow."""
    rest = mpc.target(centre(mpc.design, known), known=known)
    return rest.x.numpy(), rest.u.numpy()


class Course(NamedTuple):
    """Signals of a loop with the controller's own model, by step.

    Attributes:
        x: the state that the model starts from, ``(n,)``.
        load: a constant that is added to the inputs, ``(m,)``.
        noise: what is added to the outputs, ``(T + 1, n_y)``.
        r, known: set-points and known signals of the stages, ``(T + 1, rows, ..)``.
    """

    x: Array
    load: Array
    noise: Array
    r: Array
    known: Array


def own_loop(
    law: Law, course: Course, policy: Callable[[Signals], Any], steps: int
) -> Iterator[tuple[Signals, Any]]:
    """Yield the signals and the move of each step of a loop with the law's own model.

    It ends where no input satisfies the hard bounds, or an output is above `Law.max_plausible`.
    """
    plant, x, k = law.design.plant, course.x, 0

    def seen() -> Signals:
        return Signals(plant.C @ x + course.noise[k], course.r[k], course.known[k])

    def step(move: Any) -> Step:
        nonlocal x, k
        x = plant.A @ x + plant.B @ (move.u + course.load)
        x = x + plant.E @ course.known[k][0] + plant.offset
        k += 1
        return Step(seen(), move)

    signals = seen()
    for after, move, _ in run_loop(policy, signals, step, steps):
        if move.status:
            return
        yield signals, move
        if (np.abs(after.y) > law.max_plausible[0]).any():
            return
        signals = after


class Probe(NamedTuple):
    """A closed loop's verdict on the weights and the QP.

    Attributes:
        shares: the share of each weight in the loop's cost J, the largest first. By the envelope
            theorem it is d log J / d log weight, as the inputs are nearly optimal for the weights.
            With entries off the diagonal it is a row's, which may be negative.
        iterations: the changes of the plan's active set in a step, and one: a lower bound of the
            iterations in C from the last active set.
    """

    shares: dict[str, float]
    iterations: Array


@torch.no_grad()
def probe(law: Law, known: Array) -> Probe:
    """Run a loop with moving set-points and a load, from rest near `centre`."""
    design, rng = law.design, np.random.default_rng(0)
    plant, size_y, size_u = design.plant, design.scaling.y, design.scaling.u
    (x, u), rows = at_rest(law.mpc, known), design.horizon + 1
    moves = rng.uniform(-1, 1, (-(-PROBED // HELD), len(size_y))).repeat(HELD, 0)
    r = centre(design, known) + MOVE * size_y * np.vstack((moves[:PROBED], moves[-1:]))
    constant = np.tile(known, (PROBED + 1, rows, 1))
    quiet = np.zeros((PROBED + 1, len(size_y)))
    course = Course(x, LOAD * size_u, quiet, r[:, None].repeat(rows, 1), constant)
    costs: dict[str, float] = {}
    states, last = [], u
    for signals, move in own_loop(law, course, law.policy(law.begun(u, True)), PROBED):
        states.append(move.p)
        for name, weight, signal, names in (
            ("Q", design.Q, signals.y - _first(move.target.y), plant.outputs),
            ("R", design.R, move.u - _first(move.target.u), plant.inputs),
            ("dR", design.dR, move.u - last, plant.inputs),
        ):
            for i in np.flatnonzero(weight.any(0)):
                key = f"{name} of {names[i]}"
                costs[key] = costs.get(key, 0.0) + float(signal[i] * (weight[i] @ signal))
        last = move.u
    whole = sum(costs.values()) or 1.0
    shares = {name: cost / whole for name, cost in sorted(costs.items(), key=lambda x: -x[1])}
    changes = np.zeros(0)
    if states:
        active = law.mpc.solve(torch.stack(states)).active.numpy()
        changes = (np.diff(active, axis=0, prepend=0 * active[:1]) != 0).sum(-1)
    return Probe(shares, 1 + changes)
