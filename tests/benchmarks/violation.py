"""Bounds that outputs may leave in a share of the steps, beside plans up to the bounds.

``python -m tests.benchmarks.violation`` identifies a heated tank from logs of 600 steps of each
kind of noise, and holds a set-point beyond the upper bound for 300 steps of new noise. *Quantile*
is stochastic MPC as textbooks have it: the bound moves by the quantile of a normal error
with the identified noise's covariance. ``--write`` puts the table into docs/results/conventions.md.
Seeds 0 to 3 chose the step whose errors count.
"""

import argparse
from typing import Any

import numpy as np
from scipy.special import ndtri

import torch_qpmpc as qm
from tests.benchmarks.table import DOCS, publish, table

KINDS = ("normal", "heavy-tailed", "coloured")
SHARES = (None, 0.2, 0.05, 0.01)
QUANTILE = "quantile"
#: The first step that an input decides.
AHEAD = 2
HORIZON, SETTLED, BOUND, BEYOND, FIRST = 12, 50, 6.0, 7.0, 100
PAGE = DOCS / "results" / "conventions.md"
A, B, C = np.array([[0.9, 0.1], [0.0, 0.8]]), np.array([[0.0], [0.2]]), np.array([[1.0, 0.0]])


def noise(kind: str, rng: np.random.Generator, steps: int) -> np.ndarray:
    """Draw noise of deviation one: normal, of Student's t with 3 degrees of freedom, or AR(1)."""
    if kind == "heavy-tailed":
        return rng.standard_t(3, size=steps) / np.sqrt(3)
    e = rng.normal(size=steps)
    for k in range(1, steps if kind == "coloured" else 0):
        e[k] = 0.8 * e[k - 1] + 0.6 * e[k]
    return e


def identified(kind: str, seed: int, steps: int = 600) -> Any:
    rng = np.random.default_rng([seed, 1])
    w, v = noise(kind, rng, steps), 0.02 * rng.normal(size=steps)
    q, x, T = rng.uniform(0, 10, steps // 10).repeat(10), np.array([5.0, 5.0]), np.zeros(steps)
    for k in range(steps):
        T[k] = x[0] + v[k]
        x = A @ x + B[:, 0] * q[k] + [0.15 * w[k], 0.0]
    return qm.identify(qm.read_log({"T": T, "q": q}, outputs=["T"], inputs=["q"]), HORIZON)


def rate(controller: qm.Controller, kind: str, seed: int, steps: int) -> tuple[float, float]:
    """Return the share of steps above the bound and the mean cost (y - r)^2, on new noise."""
    rng = np.random.default_rng([seed, 2])
    w, v = noise(kind, rng, steps + SETTLED), 0.02 * rng.normal(size=steps + SETTLED)
    x, T = np.array([5.0, 5.0]), np.zeros(steps + SETTLED)
    controller.reset(y=[5.0], u=[5.0])
    for k in range(len(T)):
        T[k] = x[0] + v[k]
        x = A @ x + B @ controller.step(T[k : k + 1], [BEYOND]) + [0.15 * w[k], 0.0]
    T = T[SETTLED:]
    return float((T > BOUND).mean()), float(((T - BEYOND) ** 2).mean())


def normal_margin(model: Any, share: float) -> float:
    """Return the distance from the bound that a normal error exceeds with a chance ``share``."""
    own = model.model
    variance, response = own.S[0, 0], own.L
    for _ in range(1, AHEAD):
        response = own.A @ response
        variance += (own.C @ response @ own.S @ response.T @ own.C.T).item()
    return float(ndtri(1 - share)) * variance**0.5


def rates(seeds: int, steps: int) -> str:
    """Return the table: the rate in % with its 95 % interval over the seeds, and the cost."""
    head = ["noise", "none asked", *(f"{share:.0%} asked" for share in SHARES[1:])]
    rows: list[list[str]] = []
    options: Any = {"Q": 1.0, "dR": 0.1, "u_bounds": (0.0, 10.0)}
    for kind in KINDS:
        runs = np.zeros((2, seeds, len(SHARES), 2))
        for seed in range(seeds):
            model = identified(kind, FIRST + seed)
            for i, share in enumerate(SHARES):
                designs = [(BOUND, share)]
                if share is not None:
                    designs.append((BOUND - normal_margin(model, share), None))
                for run, (top, asked) in zip(runs, designs, strict=False):
                    bounds = {"y_bounds": (0.0, top), "violation": asked}
                    mpc = qm.LinearMPC(model, HORIZON, **bounds, **options)
                    run[seed, i] = rate(qm.Controller(mpc), kind, FIRST + seed, steps)
        for name, run in zip((kind, QUANTILE), runs, strict=True):
            wide = 196 * run[..., 0].std(0) / np.sqrt(max(seeds - 1, 1))
            pairs = zip(100 * run[..., 0].mean(0), wide, run[..., 1].mean(0), strict=True)
            cells = [f"{x:.1f}±{by:.1f}, {cost:.2f}" for x, by, cost in pairs]
            rows.append([name, *cells] if name == kind else [name, "", *cells[1:]])
    return table(head, rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    publish(rates(options.seeds, options.steps), "violation", options.write, PAGE)


if __name__ == "__main__":
    main()
