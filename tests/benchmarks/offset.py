"""Errors of tracked references after learning: ``python -m tests.benchmarks.offset``.

Each seed learns task=tank_references from a wrong model, without noise. References that the plant
can hold are then held for 400 steps, and the last levels are compared with them. The table goes
into docs/results/tanks.md.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
from omegaconf import DictConfig
from torch import Tensor

import train
from tests.benchmarks.table import DOCS
from tests.runs import make_config
from torch_qpmpc import QPMPC, Model
from torch_qpmpc.envs import TankReferences
from torch_qpmpc.envs.closed_loop import cost_text, plant_loop
from torch_qpmpc.envs.linear_system import Rng
from torch_qpmpc.experiment.algorithms import evaluate
from torch_qpmpc.experiment.tasks import make_mpc, make_physics
from torch_qpmpc.experiment.tracking import offset_free, reference_scheme
from torch_qpmpc.study.markdown import replaced, table
from torch_qpmpc.study.runs import FinishedRun

PAGE = DOCS / "results" / "tanks.md"
SEEDS = (1, 2, 3)
COMMON = ("task=tank_references", "solver=daqp", "figures=false", "logger=csv", "rivals=false")
#: A window of one error, and no discount, as the true model.
WINDOW = ("task.memory=1", "task.gamma=1")


class Reachable(TankReferences):
    """Tanks that start near references which the plant of the episode can hold."""

    def signals(self, rng: Rng, count: int, length: int) -> Tensor:
        w = super().signals(rng, count, length)
        A, B, _ = self.model(w[:, 0])
        inputs = 0.03 + 0.005 * w[:, 0, :2, None]  # from 0.03 to 0.13
        w[..., :4] = torch.linalg.solve(torch.eye(4).to(A) - A, B @ inputs).mT
        return w

    def starts(self, rng: Rng, count: int) -> Tensor:
        return self.signals(np.random.default_rng(5), count, 1)[:, 0, :4]


def steady_error(mpc: QPMPC, plant: Reachable, steps: int = 400) -> float:
    """Return the largest distance of a level from its reference after ``steps``."""
    loop = plant_loop(mpc.policy, plant, steps=steps, starts=4, seed=5)
    return float((loop.states[-1] - loop.states[0]).abs().max())


def corrected(cfg: DictConfig, mpc: QPMPC) -> QPMPC:
    """Return MPC with the learned model, whose predictions its last error corrects."""
    physics: Any = make_physics(cfg)
    A, B, *_ = mpc.model()
    model = Model(*offset_free(A, B))
    return QPMPC(reference_scheme(physics, model, cfg.task.gamma), solver=cfg.solver)


def controllers(seed: int, *overrides: str) -> dict[str, tuple[QPMPC, DictConfig]]:
    """Learn, and return each scheme with the configuration that evaluates it."""
    cfg, window = (make_config(*COMMON, f"seed={seed}", *more) for more in (overrides, WINDOW))
    with tempfile.TemporaryDirectory() as folder:
        train.train(cfg, folder, quiet=True)
        run = FinishedRun(Path(folder))
        start, learned, true = run.start, run.policy, run.true
    assert true is not None
    with torch.no_grad():
        return {
            "wrong model": (start, cfg),
            "learned": (learned, cfg),
            "wrong model, offset-free": (make_mpc(window, make_physics(window)), window),
            "learned model, offset-free": (corrected(window, learned), window),
            "true model": (true, cfg),
        }


def rows(seeds: tuple[int, ...]) -> list[list[str]]:
    """Train and measure; each row is a controller, each pair of columns a seed."""
    found: dict[str, list[str]] = {}
    for seed in seeds:
        for name, (mpc, cfg) in controllers(seed).items():
            plant = Reachable(horizon=cfg.task.horizon, past=1 + cfg.task.memory)
            J = evaluate(cfg, mpc.policy, make_physics(cfg)).J
            found.setdefault(name, [name]).extend((f"{steady_error(mpc, plant):.1e}", cost_text(J)))
    return list(found.values())


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m tests.benchmarks.offset", description="Write the table of steady states."
    )
    parser.add_argument("--page", type=Path, default=PAGE, help="the file that gets the table")
    options = parser.parse_args(arguments)
    text = options.page.read_text(encoding="utf-8")
    replaced(text, "", "offset")  # fail before the runs
    torch.set_num_threads(1)
    head = [""]
    for seed in SEEDS:
        head += [f"error, seed {seed}", "J"]
    options.page.write_text(replaced(text, table(head, rows(SEEDS)), "offset"), encoding="utf-8")


if __name__ == "__main__":
    main()
