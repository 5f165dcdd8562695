"""`Controller.simulate`: a closed loop of a controller and a plant."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure

from torch_qpmpc.analysis.episode import episode_figure
from torch_qpmpc.checks import check_seed, check_whole
from torch_qpmpc.control.controller import Controller
from torch_qpmpc.control.design import Design, read_vector
from torch_qpmpc.control.state_space import FAINT, Array, StateSpace, read_model
from torch_qpmpc.errors import QPError


@dataclass(frozen=True, eq=False)
class Run:
    """Signals of a closed loop of T steps.

    Attributes:
        design: that of the controller.
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
        outside = np.maximum(np.maximum(design.y_bounds[0] - y, y - design.y_bounds[1]), 0.0)
        prices = np.where(outside > 0, design.y_slack, 0.0)  # inf times zero is none
        return cost + (prices * outside).sum(1)

    def plot(self) -> Figure:
        """Return a figure with a panel for each output, input and known signal."""
        plant = self.design.plant
        step = 1.0 if plant.dt is None else plant.dt
        times, y, u, r = (
            torch.from_numpy(x) for x in (step * np.arange(len(self.y)), self.y, self.u, self.r)
        )
        signals = {
            plant.label(name): torch.from_numpy(x)
            for name, x in zip(plant.known, self.known.T.copy(), strict=True)
        }
        lower, upper = (torch.from_numpy(x) for x in self.design.y_bounds)
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
    controller: Controller,
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
    design, twin = controller.mpc.design, copy.copy(controller)
    rows = design.horizon + 1
    announced = known is None and hasattr(plant, "reset")  # by the environment, step by step
    known = controller.known if known is None else known
    d = np.empty((0, 0)) if announced else controller.read_known(known, steps + rows, steps)
    set_points = controller.read_set_points(r, steps + rows)
    load = read_vector("load", load, design.plant.inputs, 0.0)
    noise = read_vector("noise", noise, design.plant.outputs, 0.0)
    if not ((noise >= 0) & np.isfinite(noise)).all():
        raise QPError.expected("noise", f"{noise.tolist()}", "standard deviations >= 0")
    y, last = controller.rest
    twin.reset(u=last if u is None else u)
    start = twin.u
    if not hasattr(plant, "reset"):
        model = design.plant if plant is None else read_model(plant)
        plant = _Model(model, design, d, start, y, FAINT if u is not None else 1.0, x)
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
    ys, us, ds, held = [], [], [], []
    for k in range(steps):
        ys.append(observed + noise * rng.normal(size=len(design.Q)))
        ahead = twin.read_known(info.get("known"), rows) if announced else d[k : k + rows]
        us.append(twin.step(ys[-1], set_points[k : k + rows], ahead))
        ds.append(ahead[0])
        assert twin.target is not None
        held.append(twin.target.u.numpy().reshape(-1, len(load))[0])
        stepped = plant.step(us[-1] + load)
        observed, info = stepped[0], stepped[-1]
    ys.append(observed + noise * rng.normal(size=len(design.Q)))
    measured, inputs, d, u_s = map(np.array, (ys, us, ds, held))
    return Run(design, measured, set_points[: steps + 1], inputs, d, u_s, start)


class _Model:
    """A model with Gymnasium's ``reset`` and ``step``, which starts at rest with the input u.

    With outputs y it starts as near to them, with a weight, as `StateSpace.at_rest` says.
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
        rest = model.at_rest(u, self._d[0], y, weight)
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
