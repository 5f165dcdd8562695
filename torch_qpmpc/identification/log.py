"""Trajectories of a plant with the names of their signals."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from torch import Tensor

from torch_qpmpc.errors import QPError

#: The largest magnitude, whose squares are finite.
LARGEST = 1e100
#: A column is constant, or a linear function of others, up to this share of its size.
STILL = 1e-6


class Trajectory(NamedTuple):
    """Consecutive steps in float64: y ``(T + 1, n_x)``, u ``(T, n_u)`` and d ``(T, n_d)``."""

    y: Tensor
    u: Tensor
    d: Tensor

    @property
    def steps(self) -> int:
        """The number of steps, T."""
        return self.u.shape[0]  # len takes ten times as long


@dataclass(frozen=True, eq=False)
class Log:
    """Trajectories with the names of their signals; ``print`` shows what `read_log` did.

    Attributes:
        trajectories: consecutive steps: outputs y, inputs u and known signals d.
        outputs, inputs, known: the names of the entries of y, u and d.
        units: units by name, where known.
        dt: the time between steps, or None if no times are known.
        notes: sentences on what was split, left out or noticed.
        dt_unit: dt's unit: s of dates and clocks, and of numbers the one in the column's header.
    """

    trajectories: Sequence[Trajectory]
    outputs: tuple[str, ...]
    inputs: tuple[str, ...]
    known: tuple[str, ...] = ()
    units: Mapping[str, str] = field(default_factory=dict)
    dt: float | None = None
    notes: tuple[str, ...] = ()
    dt_unit: str = ""

    @property
    def steps(self) -> int:
        """The number of steps of all trajectories."""
        return sum(trajectory.steps for trajectory in self.trajectories)

    def label(self, name: str) -> str:
        """Return ``name`` with its unit, as ``T [degC]``."""
        return f"{name} [{self.units[name]}]" if name in self.units else name

    def __str__(self) -> str:
        kinds = (("outputs", self.outputs), ("inputs", self.inputs), ("known", self.known))
        parts = (f"{k} {', '.join(map(self.label, names))}" for k, names in kinds if names)
        every = "" if self.dt is None else f", one step every {self.dt:g} {self.dt_unit}".rstrip()
        return "\n".join((f"{self.steps} steps{every}: {'; '.join(parts)}", *self.notes))


def named(
    trajectories: Sequence[Trajectory],
    outputs: Sequence[str] | None = None,
    inputs: Sequence[str] | None = None,
    known: Sequence[str] | None = None,
) -> Log:
    """Return the log of trajectories, by default with the names y1, .., u1, .. and d1, ..."""
    names = []
    for kind, part in {"outputs": outputs, "inputs": inputs, "known": known}.items():
        letter, size = "yud"[len(names)], trajectories[0][len(names)].shape[-1]
        if part is not None and len(part) != size:
            raise QPError.expected(kind, f"{list(part)}", f"{size} names")
        names.append(tuple(part or (f"{letter}{i + 1}" for i in range(size))))
    return Log(trajectories, *names)


def runs(mask: Any) -> np.ndarray:
    """Return the first entry of each run of True, and the one after its last, ``(m, 2)``."""
    return np.flatnonzero(np.diff(mask, prepend=False, append=False)).reshape(-1, 2)


def folds(trajectories: Sequence[Trajectory], count: int) -> list[list[Trajectory]]:
    """Cut all steps into ``count`` consecutive parts of nearly equal length."""
    total, begin = sum(trajectory.steps for trajectory in trajectories), 0
    bounds = [total * i // count for i in range(count + 1)]
    parts: list[list[Trajectory]] = [[] for _ in range(count)]
    for trajectory in trajectories:
        y, u, d = trajectory
        for part, first, last in zip(parts, bounds[:-1], bounds[1:], strict=True):
            start, stop = max(first - begin, 0), min(last - begin, trajectory.steps)
            if start < stop:
                part.append(Trajectory(y[start : stop + 1], u[start:stop], d[start:stop]))
        begin += trajectory.steps
    return parts
