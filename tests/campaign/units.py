"""Controllers in random units: ``python -m tests.campaign.units --count 200 --compiled 20``.

Each design is made in units of order one, and again with y, u, x and d in units between 1e-6 and
1e6. Both must be accepted or refused alike, and the inputs of closed loops of 100 steps must agree
within 1e-6 of their ranges, for some designs in C, too.
"""

import argparse
import sys
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import torch_qpmpc as qm
from tests.control.controllers import load, matrices

STEPS = 100
#: Largest difference of inputs, relative to their range.
NEAR = 1e-6
#: Largest power of ten of a unit.
LARGEST = 6


class Units(NamedTuple):
    y: np.ndarray
    u: np.ndarray
    x: np.ndarray
    d: np.ndarray


class Drawn(NamedTuple):
    """A design in units of order one, and the set-points, loads and known signals of its loop.

    Attributes:
        model: A, B and C.
        E: the factor of known signals.
        horizon: N.
        options: the keywords of `LinearMPC`.
        r, load, d: ``(STEPS, n_y)``, ``(m,)`` and ``(STEPS, n_d)``.
    """

    model: tuple[np.ndarray, ...]
    E: np.ndarray
    horizon: int
    options: dict[str, Any]
    r: np.ndarray
    load: np.ndarray
    d: np.ndarray

    def made(self, units: Units) -> qm.LinearMPC:
        (A, B, C), (y, u, x, d), own = self.model, units, dict(self.options)
        for name, unit in (("Q", y), ("R", u), ("dR", u)):
            own[name] = own[name] / unit**2
        for name, unit in (("y_bounds", y), ("u_bounds", u), ("du_bounds", u)):
            if own[name] is not None:
                own[name] = tuple(side * unit for side in own[name])
        own["y_slack"] = None if own["y_slack"] is None else own["y_slack"] / y
        model = A * x[:, None] / x, B * x[:, None] / u, C * y[:, None] / x
        known = [f"d{i}" for i in range(len(d))]
        return qm.LinearMPC(model, self.horizon, E=self.E * x[:, None] / d, known=known, **own)

    def loop(self, units: Units, step: Any) -> np.ndarray:
        """Return the inputs ``(STEPS, m)`` of a closed loop in units, in those of order one."""
        (A, B, C), x, inputs = self.model, np.zeros(len(self.E)), []
        for r, d in zip(self.r, self.d, strict=True):
            u = step(C @ x * units.y, r * units.y, d * units.d) / units.u
            inputs.append(u)
            x = A @ x + B @ (u + self.load) + self.E @ d
        return np.array(inputs)


def drawn(seed: int) -> tuple[Drawn, Units]:
    """Draw a design, with and without bounds, of a plant with delays and integrators, and units."""
    rng = np.random.default_rng(seed)
    A, B, C = matrices(rng)
    n, m, n_y, n_d = len(A), B.shape[1], len(C), int(rng.integers(0, 3))
    upper = rng.uniform(0.5, 2, m)
    options = {
        "Q": rng.uniform(0.5, 2, n_y) * (rng.random(n_y) < 0.8),
        "R": rng.uniform(0.01, 0.5, m) * (rng.random() < 0.6),
        "dR": rng.uniform(0.05, 1, m),
        "u_bounds": (-rng.uniform(0.5, 2, m), upper) if rng.random() < 0.8 else None,
        "du_bounds": (-0.4 * upper, 0.4 * upper) if rng.random() < 0.3 else None,
        "y_bounds": (-rng.uniform(1, 4, n_y), rng.uniform(1, 4, n_y))
        if rng.random() < 0.5
        else None,
        "y_slack": rng.uniform(10, 100, n_y),
    }
    options["Q"][0] = 1.0
    r = rng.normal(size=(4, n_y)).repeat(STEPS // 4, 0)
    d = rng.normal(size=(4, n_d)).repeat(STEPS // 4, 0)
    E, load = 0.3 * rng.normal(size=(n, n_d)), rng.uniform(-0.3, 0.3, m)
    design = Drawn((A, B, C), E, int(rng.integers(5, 21)), options, r, load, d)
    units = Units(*(10.0 ** rng.uniform(-LARGEST, LARGEST, k) for k in (n_y, m, n, n_d)))
    if (kind := rng.random()) < 0.5:  # the default price, or hard bounds
        options["y_slack"] = None if kind < 0.4 else np.full(n_y, np.inf)
    return design, units


def judged(seed: int, compiled: bool = False) -> tuple[str, float]:
    """Return what both controllers do, in words, and the largest difference of an input.

    Raises:
        AssertionError: they do not do the same.
    """
    design, units = drawn(seed)
    one = Units(*(np.ones(len(unit)) for unit in units))
    (words, inputs), (others, moved) = (results(design, x, compiled) for x in (one, units))
    assert words == others, f"seed {seed}: {words!r} and {others!r}"
    bounds = design.options["u_bounds"]
    sizes = np.abs(inputs).max((0, 1)) if bounds is None else (bounds[1] - bounds[0]) / 2
    loops = np.concatenate((inputs, moved))  # in Python and C, in both units
    error = float((np.abs(loops - loops[:1]) / sizes).max(initial=0.0))
    assert error < NEAR, f"seed {seed}: inputs differ by {error:.1e} of their range"
    return words, error


def results(design: Drawn, units: Units, compiled: bool) -> tuple[str, np.ndarray]:
    """Return the outcome in a few words, and the inputs of the loops in Python and in C."""
    empty = np.zeros((0, STEPS, len(design.load)))
    try:
        controller = qm.Controller(design.made(units))
    except qm.QPError as error:
        return f"refused: {str(error).split(':')[0]}", empty
    known = len(design.E.T) > 0
    rows = controller.mpc.horizon + 1

    def step(y: np.ndarray, r: np.ndarray, d: np.ndarray) -> np.ndarray:
        return controller.step(y, r, known=d if known else None)

    loops = [design.loop(units, step)]
    if not compiled:
        return "controlled", np.array(loops)
    controller.reset()
    with tempfile.TemporaryDirectory() as folder:
        try:
            files = controller.export_c(folder).files
        except (qm.QPError, qm.SolverError) as error:
            return f"not exported: {str(error).split(':')[0]}", np.array(loops)
        library = load([Path(file) for file in files], controller)

    def step_in_c(y: np.ndarray, r: np.ndarray, d: np.ndarray) -> np.ndarray:
        return library.step(y, r, np.tile(d, (rows, 1)) if known else None)[0]

    loops.append(design.loop(units, step_in_c))
    return "controlled and exported", np.array(loops)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.campaign.units", description=__doc__)
    parser.add_argument("--count", type=int, default=200, help="designs")
    parser.add_argument("--compiled", type=int, default=20, help="designs that are exported, too")
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    options = parser.parse_args(arguments)
    counts: dict[str, int] = {}
    wrong, worst = 0, 0.0
    for seed in range(options.first, options.first + options.count):
        try:
            words, error = judged(seed, seed - options.first < options.compiled)
        except AssertionError as failure:
            print(failure, flush=True)
            words, error, wrong = "WRONG", 0.0, wrong + 1
        counts[words] = counts.get(words, 0) + 1
        worst = max(worst, error)
        if seed % 10 == 9:
            print(f"to seed {seed}: {counts}, inputs within {worst:.0e} of ranges", flush=True)
    print(counts, f"inputs within {worst:.0e} of their ranges")
    return wrong


if __name__ == "__main__":
    sys.exit(main())
