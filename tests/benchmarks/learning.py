"""The table of `docs/results/learning.md`: ``python -m tests.benchmarks.learning``.

It reads the runs of the commands of that page, below runs/learning/; rows without runs stay.
"""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from omegaconf import DictConfig
from scipy.stats import wilcoxon

from tests.benchmarks.dynamic_programming import optimal_policy
from tests.benchmarks.table import DOCS, ROOT, two_tables
from torch_qpmpc.envs import ActuatorNoise
from torch_qpmpc.envs.closed_loop import cost_text, plant_loop
from torch_qpmpc.experiment.config import load_config
from torch_qpmpc.experiment.rivals.rival import IDENTIFICATION
from torch_qpmpc.experiment.run_folder import read_summary
from torch_qpmpc.experiment.tasks.actuator_noise import STARTS
from torch_qpmpc.study.markdown import replaced

PAGE = DOCS / "results" / "learning.md"
#: The bound of the action of `task=actuator_noise` that is not active.
FREE = 10.0
#: The least gap, relative to the best without learning, of which a share is told.
SMALL = 0.01
HEADER = (
    "task",
    "start",
    "identification",
    "best without learning",
    "learned, median",
    "worst",
    "optimum",
    "share of the gap",
    "better",
    "p",
)


def runs(root: Path) -> dict[tuple[str, int], list[dict[str, Any]]]:
    """Return the summaries by task and horizon, with the optimum's cost as ``optimum``."""
    cases = defaultdict(list)
    for path in sorted(root.glob("*/*/summary.json")):
        cfg, summary = load_config(path.parent / "config.yaml"), read_summary(path.parent)
        name, summary["optimum"] = cfg.task.name.replace("_", " "), summary["J_true_model"]
        if cfg.task.name == "actuator_noise":
            name += f", std {cfg.task.actuator_std:g}"
            if cfg.task.hidden_velocity:
                name += ", hidden velocity"
            if cfg.task.a_max < FREE:
                name += f", action up to {cfg.task.a_max:g}"
                hidden = cfg.task.hidden_velocity  # whose optimum is not known under a bound
                summary["optimum"] = math.nan if hidden else bounded_optimum(cfg)
        cases[name, cfg.task.horizon].append(summary)
    return cases


@cache
def _optimal(a_max: float, std: float, gamma: float) -> tuple[ActuatorNoise, Any]:
    bound = torch.tensor([a_max]).double()
    plant = ActuatorNoise(horizon=1, lb_a=-bound, ub_a=bound, actuator_std=std)
    return plant, optimal_policy(plant, gamma)


def bounded_optimum(cfg: DictConfig) -> float:
    """Return J of the optimal policy of a bounded action, in the run's closed loops."""
    task = cfg.task
    plant, policy = _optimal(task.a_max, task.actuator_std, task.gamma)
    plant = replace(plant, horizon=task.horizon)  # the number of signals that are drawn
    options = {"steps": task.eval_steps, "starts": STARTS, "seed": cfg.eval_seed}
    return plant_loop(policy, plant, **options).J


def row(summaries: list[dict[str, Any]]) -> list[str]:
    """Return the costs of a case, and the one-sided test that learning costs less."""
    identified = np.array([x["rivals"][IDENTIFICATION] for x in summaries])
    fair = np.array([min(x["J_start"], *x["rivals"].values()) for x in summaries])
    learned, start, optimum = (
        np.array([x[name] for x in summaries]) for name in ("J_final", "J_start", "optimum")
    )
    costs = (start, identified, fair, learned)
    return [
        *(cost_text(float(np.median(x))) for x in costs),
        cost_text(float(learned.max())),
        cost_text(float(np.median(optimum))),
        *compared(learned, fair, optimum),
    ]


def compared(learned: np.ndarray, fair: np.ndarray, optimum: np.ndarray) -> list[str]:
    """Return the share of the gap that is closed, the seeds on which learning costs less, and p.

    ``fair`` is J of the best without learning, by seed like the others. The share is blank where
    the gap is less than `SMALL` of it, or there is no optimum; the test is one-sided.
    """
    gap = fair - optimum
    share = np.median((fair - learned) / gap) if np.median(gap / fair) > SMALL else None
    signed_rank: Any = wilcoxon(learned, fair, alternative="less")
    return [
        "" if share is None else f"{round(share, 2) + 0:.2f}",
        f"{(learned < fair).sum()} of {len(fair)}",
        f"{signed_rank.pvalue:.3f}",
    ]


def rows(page: str) -> dict[str, list[str]]:
    """Return the cells of each task's row in the page's two tables."""
    cells = defaultdict(list)
    for line in page.split("<!-- learning -->")[1].split("<!-- /learning -->")[0].splitlines():
        name, *others = (cell.strip() for cell in line.strip("| ").split(" | "))
        cells[name] += others
    return {name: line for name, line in cells.items() if name not in ("", "task", "---")}


def main() -> None:
    page, cases = PAGE.read_text(encoding="utf-8"), runs(ROOT / "runs" / "learning")
    cells = rows(page) | {f"{name}, N = {N}": row(x) for (name, N), x in cases.items()}
    lines = [[name, *line] for name, line in sorted(cells.items())]
    PAGE.write_text(replaced(page, two_tables(HEADER, lines, 7), "learning"), encoding="utf-8")


if __name__ == "__main__":
    main()
