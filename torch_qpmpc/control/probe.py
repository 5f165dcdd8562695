"""What a closed loop of a controller and its model tells of the design's weights and of its QP."""

from __future__ import annotations

import copy
from dataclasses import dataclass

import numpy as np
import torch

from torch_qpmpc.control.controller import Controller
from torch_qpmpc.control.design import half_range, middle
from torch_qpmpc.control.state_space import FAINT, Array
from torch_qpmpc.errors import QPError, SolverError

#: Steps of the loop, and of a set-point. Set-points and loads are these shares of half the bounds.
STEPS, HELD = 100, 25
MOVE, LOAD = 0.5, 0.1


@dataclass(frozen=True)
class Probe:
    """A closed loop with moving set-points and a load, which ends where no input is feasible.

    Attributes:
        shares: the share of each weight in the loop's cost J, the largest first. By the envelope
            theorem it is d log J / d log weight, as the inputs are nearly optimal for the weights.
            Of a weight with entries off the diagonal, that of a row, which may be negative.
        iterations: the changes of the plan's active set in a step, and one; at least so many
            iterations take a step in C, from the last active set.
    """

    shares: dict[str, float]
    iterations: Array


def held_known(controller: Controller) -> Array:
    """Return the known signals of the last step or reset, ``(n_d,)``, zero before."""
    n_d = len(controller.mpc.design.plant.known)
    return np.zeros(n_d) if controller.known is None else controller.known


def centre(controller: Controller) -> Array:
    """Return the middle of the outputs' bounds, where there are none what the inputs' middle holds.

    An input with one bound is half its range from it.
    """
    design, known = controller.mpc.design, held_known(controller)
    half, (lower, upper) = half_range(design.u_bounds), design.u_bounds
    u, y = np.clip(0.0, lower + half, upper - half), middle(design.y_bounds)
    held = design.plant.C @ design.plant.at_rest(u, known, y, FAINT)
    return np.where(np.isfinite(design.y_bounds).all(0), y, np.clip(held, *design.y_bounds))


def at_rest(controller: Controller) -> tuple[Array, Array, Array]:
    """Return x, u and `held_known` of the model at rest as near to `centre` as its bounds allow."""
    known = held_known(controller)
    rest = controller.mpc.target(centre(controller), known=known)
    return rest.x.numpy(), rest.u.numpy(), known


@torch.no_grad()
def probe(controller: Controller) -> Probe:
    """Run the loop, from rest near `centre`; known signals are held."""
    design, twin, rng = controller.mpc.design, copy.copy(controller), np.random.default_rng(0)
    plant = design.plant
    size_y, size_u = half_range(design.y_bounds), half_range(design.u_bounds)
    middle_y, load = centre(controller), LOAD * size_u
    x, last, known = at_rest(controller)
    twin.reset(u=last)
    costs: dict[str, float] = {}
    states = []
    for k in range(STEPS):
        if k % HELD == 0:
            r = middle_y + MOVE * size_y * rng.uniform(-1, 1, len(size_y))
        y = plant.C @ x
        try:
            u = twin.step(y, r, known)
        except (QPError, SolverError):  # an unstable loop's y is above controller.most
            break
        assert twin.target is not None
        u_s = twin.target.u.numpy().reshape(-1, len(u))[0]
        states.append(twin.p)
        for name, weight, signal, names in (
            ("Q", design.Q, y - twin.target.y.numpy().reshape(-1, len(y))[0], plant.outputs),
            ("R", design.R, u - u_s, plant.inputs),
            ("dR", design.dR, u - last, plant.inputs),
        ):
            for i in np.flatnonzero(weight.any(0)):
                key = f"{name} of {names[i]}"
                costs[key] = costs.get(key, 0.0) + float(signal[i] * (weight[i] @ signal))
        x, last = plant.A @ x + plant.B @ (u + load) + plant.E @ known + plant.offset, u
    whole = sum(costs.values()) or 1.0
    shares = {name: cost / whole for name, cost in sorted(costs.items(), key=lambda x: -x[1])}
    changes = np.zeros(0)
    if states:
        active = controller.mpc.solve(torch.stack(states)).active.numpy()
        changes = (np.diff(active, axis=0, prepend=0 * active[:1]) != 0).sum(-1)
    return Probe(shares, 1 + changes)
