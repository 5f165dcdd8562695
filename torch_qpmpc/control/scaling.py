"""The sizes of a plant's signals, in which all decisions about ranks and small numbers are made.

A change of units multiplies a signal and its size alike, so it changes no decision.
"""

from __future__ import annotations

from dataclasses import replace
from functools import reduce
from typing import NamedTuple

import numpy as np

from torch_qpmpc.control.state_space import Array, StateSpace
from torch_qpmpc.export.tables import FAR

#: The fewest steps of the responses that sizes follow from.
STEPS = 20
#: Entries this small relative to what they are beside are what rounding leaves of zero.
ROUNDING = 1e-14
#: Weight of outputs beside an input that is at rest with them: it decides for integrators.
FAINT = 1e-6
Bounds = tuple[Array, Array]


class Scaling(NamedTuple):
    """Sizes of the outputs ``(n_y,)``, inputs ``(m,)``, states ``(n,)`` and known signals.

    Half the distance of its bounds is the size of an output or an input. Without bounds, an output
    has the size of its response to a step of the inputs; and an input the size that moves some
    output by its own, which is then ``1 / sqrt(Q_ii)`` if no input has bounds. A state's is between
    what the inputs move and what shows in the outputs, and a known signal's moves a state by its.
    """

    y: Array
    u: Array
    x: Array
    d: Array

    @classmethod
    def of(
        cls,
        plant: StateSpace,
        y_bounds: Bounds | None = None,
        u_bounds: Bounds | None = None,
        Q: Array | None = None,
        steps: int = 0,
    ) -> Scaling:
        """Return the sizes of a plant's signals, from responses of at least ``steps`` steps."""
        n, m, n_y, _ = plant.sizes
        growth = max(1.0, np.abs(np.linalg.eigvals(plant.A)).max(initial=0.0))
        A, count = plant.A / growth, max(steps, n, STEPS)  # modes that grow would hide the others
        y, u = (
            np.zeros(k) if b is None else ranges(b) for k, b in ((n_y, y_bounds), (m, u_bounds))
        )
        weight = np.zeros(n_y) if Q is None else np.sqrt(np.diag(Q))
        of_u = first(_within(u, np.ones(m)), np.ones(m))
        driven = np.hstack((plant.B * of_u, plant.E))
        x, seen, shown = np.zeros_like(driven), plant.C, np.zeros((n_y, n))
        X, Y = np.zeros_like(x), plant.C @ x
        for _ in range(count):
            x = A @ x + driven
            X, Y = np.maximum(X, np.abs(x)), np.maximum(Y, np.abs(plant.C @ x))
            shown, seen = np.maximum(shown, np.abs(seen)), seen @ A
        parts = (np.abs(plant.C) @ X).max(1, keepdims=True)  # of Y, which may cancel
        X, Y = X[:, :m] / of_u, but_rounding(Y, parts)[:, :m] / of_u
        rest = first(inverse(Y.max(0)), np.ones(m))
        aiming = inverse((Y * first(weight, inverse(y))[:, None]).max(0))
        u = _within(u, first(aiming, rest))
        y = _within(y, np.maximum((Y * u).max(1, initial=0.0), inverse(weight)))
        aimed = first(y, (Y * u).max(1, initial=0.0), inverse(weight))
        aiming = inverse((Y * inverse(aimed)[:, None]).max(0))
        u = first(u, aiming, rest)
        y = first(y, (Y * u).max(1, initial=0.0), aimed, np.ones(n_y))
        shows = inverse((shown * inverse(y)[:, None]).max(0))
        moved = but_rounding((X * u).max(1, initial=0.0), shows)
        x = first(np.sqrt(moved * shows), moved, shows, np.ones(n))
        effect = (np.abs(plant.E) / x[:, None]).max(0)
        return cls(y, u, x, first(inverse(effect), np.ones(len(effect))))

    def plant(self, plant: StateSpace) -> StateSpace:
        """Return a plant in signals divided by their sizes."""
        y, u, x, d = self
        noise, visited = plant.noise, plant.visited
        if noise is not None:
            noise = noise[0] * (y / x[:, None]), noise[1] / y / y[:, None]
        if visited is not None:
            visited = visited[0] / x, visited[1] / x / x[:, None]
        sizes = {"A": (x, x), "B": (u, x), "C": (x, y), "E": (d, x)}
        parts = {
            name: but_rounding(getattr(plant, name) * (of / row[:, None]))
            for name, (of, row) in sizes.items()
        }
        parts |= {"offset": but_rounding(plant.offset / x), "noise": noise, "visited": visited}
        return replace(plant, **parts, drifts=plant.drifts / np.concatenate((x, y))[:, None])

    def at_rest(self, plant: StateSpace, u: Array, d: Array, y: Array, weight: float) -> Array:
        """Return the state ``(n,)`` that rests with the input u and the known signals d.

        It is as near to rest, and to outputs y with a weight, as least squares allow: the input
        alone does not determine the outputs of a plant that integrates, or nearly so.
        """
        normal = self.plant(plant)
        still = np.vstack((np.eye(len(normal.A)) - normal.A, weight * normal.C))
        driven = normal.B @ (u / self.u) + normal.E @ (d / self.d) + normal.offset
        driven = np.concatenate((driven, weight * y / self.y))
        return self.x * np.linalg.lstsq(still, driven, rcond=None)[0]


def ranges(bounds: Bounds) -> Array:
    """Return half the distance of the bounds, and zero where there is none, or one is far away."""
    half, near = (bounds[1] - bounds[0]) / 2, np.minimum(*np.abs(bounds))
    return _within(np.where(np.isfinite(half) & (half > 0), half, 0.0), near)


def but_rounding(sizes: Array, others: Array | float = 1.0) -> Array:
    """Return the sizes, and zero where rounding may leave as much of others."""
    return np.where(np.abs(sizes) <= ROUNDING * others, 0.0, sizes)


def _within(sizes: Array, others: Array) -> Array:
    """Return the sizes, and zero where they exceed other ones more than `FAR` times."""
    return np.where((others > 0) & (sizes > FAR * others), 0.0, sizes)


def first(*sizes: Array) -> Array:
    """Return the first of the sizes that is not zero, for each entry."""
    return reduce(lambda one, size: np.where(one > 0, one, size), sizes)


def inverse(size: Array) -> Array:
    """Return the inverse, zero of zero."""
    return np.where(size > 0, 1 / np.where(size > 0, size, 1.0), 0.0)
