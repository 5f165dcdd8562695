"""Exported controllers beside Python's, with faulty signals: ``python -m tests.campaign.soak``.

Each closes a loop of its own with the model, a load and noise. Dropouts and absurd values come in
any signal, and operators take over in ten phases. Inputs must agree to `NEAR`, and codes exactly.
"""

import argparse
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Mapping

import numpy as np
import torch

import torch_qpmpc as qm
from tests.control.controllers import load
from torch_qpmpc.control.exporting import CompiledController

#: The largest difference of inputs, the probabilities of faults, and the length of a manual phase.
NEAR, DROPOUT, ABSURD, MANUAL = 1e-9, 0.02, 0.01, 50
VALUES = (np.inf, -np.inf, 3.4e38, -1e300, 1e20)


def soak(
    controller: qm.Controller,
    twin: CompiledController,
    steps: int,
    phases: int,
    seed: int,
    size: float = 1.0,
    faults: float = 1.0,
) -> tuple[float, Counter]:
    """Return the largest difference of inputs, and counts of codes, faults and manual steps.

    ``size`` scales set-points and known signals, ``faults`` the probabilities of faults.
    """
    design, rng = controller.mpc.design, np.random.default_rng(seed)
    counts, largest = Counter(), 0.0
    plant, rows = design.plant, design.horizon + 1
    n, m, n_y, n_d = plant.sizes
    stages = rows if design.references == "preview" else 1
    x, u, r, known = np.zeros((2, n)), np.zeros(m), np.zeros((stages, n_y)), np.zeros((rows, n_d))
    manual, disturbance = {*rng.choice(steps // MANUAL, phases, replace=False)}, np.zeros(m)

    def faulty(signal: np.ndarray) -> np.ndarray:
        dropped = rng.random(signal.shape) < faults * DROPOUT
        absurd = rng.random(signal.shape) < faults * ABSURD
        counts["dropouts"] += int(dropped.sum())
        counts["absurd values"] += int(absurd.sum())
        return np.where(dropped, np.nan, np.where(absurd, rng.choice(VALUES), signal))

    def spoiled(signal: np.ndarray, limits: np.ndarray) -> np.ndarray:
        """Return rows that now and then have an absurd entry, NaN where no number is too large."""
        if not signal.size or rng.random() > faults * ABSURD:
            return signal
        counts["absurd values"] += 1
        signal, (k, i) = signal.copy(), rng.integers(signal.shape)
        signal[k, i] = rng.choice(VALUES) if limits[i] < np.finfo(float).max else np.nan
        return signal

    controller.reset(u=u)
    twin.reset(u=u)
    for k in range(steps):
        if k % 50 == 0:
            disturbance = rng.uniform(-0.1, 0.1, m)
            known = 0.1 * size * rng.normal(size=(rows, n_d))
            r = rng.uniform(-size, size, (stages, n_y))
        noise, unseen = 0.01 * rng.normal(size=n_y), faulty(np.zeros(n_y))
        y = x @ plant.C.T + noise + unseen
        if k // MANUAL in manual:
            u = 0.9 * u + 0.1 * rng.normal(size=m)
            applied, seen = faulty(u), known[0]
            controller.observe(y[0], applied, seen if n_d else None)
            code, inputs = twin.observe(y[1], applied, seen), np.array([u, u])
            counts["manual steps"] += 1
        else:
            wanted, ahead = map(spoiled, (r, known), controller.max_plausible)
            own = controller.step(y[0], wanted, ahead if n_d else None)
            other, code = twin.step(y[1], wanted, ahead)
            inputs, u = np.array([own, other]), own
        assert code == controller.status, f"step {k}: C {code}, Python {controller.status}"
        counts[controller.status.name] += 1
        largest = max(largest, float(np.abs(np.diff(inputs, axis=0)).max()))
        x = x @ plant.A.T + (inputs + disturbance) @ plant.B.T + known[0] @ plant.E.T + plant.offset
    return largest, counts


def main(arguments: list[str] | None = None) -> int:
    from tests.control.test_exporting import MPCS

    parser = argparse.ArgumentParser(prog="python -m tests.campaign.soak", description=__doc__)
    parser.add_argument("--steps", type=int, default=100_000, help="of all controllers together")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    return int(max(run(MPCS, options.steps).values()) > NEAR)


def run(made: Mapping[str, Callable[[], qm.LinearMPC]], steps: int) -> dict[str, float]:
    """Run a controller of each kind, print its counts, and return the largest differences."""
    differences = {}
    for i, (name, make) in enumerate(made.items()):
        controller = qm.Controller(make())
        with tempfile.TemporaryDirectory() as folder:
            twin = load(controller.export_c(folder, missing=True).files, controller)
        differences[name], counts = soak(controller, twin, -(-steps // len(made)), 10, i)
        print(f"{name}: inputs within {differences[name]:.1e}; {dict(counts)}", flush=True)
    return differences


if __name__ == "__main__":
    sys.exit(main())
