"""MPC identified from logs, beside the tasks' rivals: ``python -m tests.benchmarks.identified``.

Each case is one of train.py's configurations with ``start=data``: a log for each seed, C and b
identified from it, and the closed loop of the QP without any learning, on days or episodes that no
setting was chosen on. The rivals have the same ones. The tables go into docs/results.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import torch

from tests.benchmarks.table import DOCS
from tests.runs import make_config
from torch_qpmpc.envs.closed_loop import cost_text
from torch_qpmpc.experiment.algorithms import evaluate
from torch_qpmpc.experiment.evaluation import Evaluation, rival_costs
from torch_qpmpc.experiment.plots import learned_episode_figure
from torch_qpmpc.experiment.rivals.tanks import deepc
from torch_qpmpc.experiment.start import collect_log
from torch_qpmpc.experiment.tasks import TASKS, make_mpc, make_physics, make_true_mpc
from torch_qpmpc.experiment.tasks.identified import identified_start
from torch_qpmpc.learning.operators import warm_policy
from torch_qpmpc.study.markdown import replaced, table

#: Seeds of the logs, and of the evaluation.
SEEDS, EVAL_SEED = range(301, 311), 9001
STRUCTURES = {"free": "constraint=free", "tied": "constraint=mpc"}
#: The discount of the evaluated schemes, which do not learn.
UNDISCOUNTED = "task.gamma=1.0"


class Case(NamedTuple):
    """Logs of a task, and how its J is shown.

    Attributes:
        title: names the case in the table.
        task: overrides of the task and of the evaluation.
        log: overrides of the logs.
        reference: the rival that ratios are relative to.
        per: J is divided by this.
        fixed: part of J that no policy changes.
        picture: name of the picture of the first log's free C, beside the page.
    """

    title: str
    task: Sequence[str]
    log: Sequence[str]
    reference: str
    per: float = 1.0
    fixed: float = 0.0
    picture: str | None = None


def days(count: int) -> tuple[str, ...]:
    """Return the overrides of one log of ``count`` days."""
    steps = 96 * count
    return ("num_envs=1", f"task.episode_steps={steps}", f"start.transitions={steps}")


def episodes(count: int, length: int) -> tuple[str, ...]:
    """Return the overrides of ``count`` logs of ``length`` steps."""
    total = f"start.transitions={count * length}"
    return (f"num_envs={count}", f"task.episode_steps={length}", total)


HOUSE = ("task=house", "task.margin=0.1")
WINDOW = "task.past=4"
HOUSE_WALL = ("task=house_wall",)
TANKS, REFERENCES = ("task=four_tanks",), ("task=tank_references",)
CASES = {
    "house": [
        Case("Room, 12 days, L = 4", (*HOUSE, WINDOW), days(12), "omniscient", picture="house-day"),
        Case("Room, 12 days, L = 1", HOUSE, days(12), "omniscient"),
        Case("House with a wall, 8 days", HOUSE_WALL, days(8), "omniscient", per=2),
        Case(
            "House with a wall, 20 days",
            HOUSE_WALL,
            days(20),
            "omniscient",
            per=2,
            picture="house-wall-days",
        ),
    ],
    "tanks": [
        Case(
            "Set point",
            TANKS,
            episodes(1, 1000),
            "Kalman filter, N = 60",
            fixed=35.5,
            picture="tanks-set-point",
        ),
        Case(
            "References",
            REFERENCES,
            episodes(10, 100),
            "exact MPC",
            per=200,
            picture="tanks-references",
        ),
        Case(
            "References, disturbed",
            (*REFERENCES, "task.disturbed=true"),
            episodes(10, 100),
            "exact MPC",
            per=200,
        ),
    ],
}


def evaluated(case: Case, seeds: Sequence[int], folder: Path) -> dict[str, list[float]]:
    """Return J by controller, the best first: of each seed's log, or once where no log is used.

    Draws the case's picture into ``folder``.
    """
    common = (*case.task, *case.log, "start=data", UNDISCOUNTED, f"eval_seed={EVAL_SEED}")
    cfg = make_config(*common)
    physics: Any = make_physics(cfg)
    rivals = TASKS[cfg.task.name].rivals
    true_mpc = make_true_mpc(cfg, physics)
    assert true_mpc is not None
    found = {"true model": [evaluate(cfg, warm_policy(true_mpc), physics).J]}
    cfg.rivals = [name for name in rivals if name != "DeePC"]
    found |= {name: [J] for name, J in rival_costs(cfg, physics).items()}
    for seed in seeds:
        for name, constraint in STRUCTURES.items():
            cfg = make_config(*common, constraint, f"seed={seed}")
            log = collect_log(cfg, physics)
            mpc = make_mpc(cfg, physics, identified_start(cfg, physics, log))
            loop = evaluate(cfg, warm_policy(mpc), physics)
            found.setdefault(f"from_data, {name} C", []).append(loop.J)
            if case.picture and name == "free" and seed == seeds[0]:
                episode = learned_episode_figure(
                    mpc, Evaluation(cfg, physics, {"learned": loop}, {})
                )
                episode.savefig(folder / f"{case.picture}.png", dpi=80)
            if "DeePC" in rivals and name == "free":
                J = evaluate(cfg, deepc(physics, log), physics).J
                found.setdefault("DeePC", []).append(J)
    return {
        name: [(J - case.fixed) / case.per for J in costs]
        for name, costs in sorted(found.items(), key=lambda item: median(item[1]))
    }


def case_table(case: Case, found: dict[str, list[float]]) -> str:
    """Format the costs of a case."""
    reference = median(found[case.reference])
    lines = []
    for name, costs in found.items():
        spread = [cost_text(x) for x in (min(costs), max(costs))] if len(costs) > 1 else ["", ""]
        middle = median(costs)
        lines.append([name, cost_text(middle), *spread, f"{middle / reference:.3f}"])
    return table([case.title, "median", "best", "worst", f"/ {case.reference}"], lines)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m tests.benchmarks.identified", description="Write the tables of from_data."
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=list(SEEDS))
    parser.add_argument("--pages", nargs="+", choices=list(CASES), default=list(CASES))
    parser.add_argument("--folder", type=Path, default=DOCS / "results", help="folder of the pages")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    pages = {name: options.folder / f"{name}.md" for name in options.pages}
    for page in pages.values():
        replaced(page.read_text(encoding="utf-8"), "", "identified")  # fail before the runs
    for name, page in pages.items():
        blocks = []
        for case in CASES[name]:
            blocks.append(case_table(case, evaluated(case, options.seeds, options.folder)))
            print(blocks[-1], flush=True)
        text = page.read_text(encoding="utf-8")
        page.write_text(replaced(text, "\n\n".join(blocks), "identified"), encoding="utf-8")


if __name__ == "__main__":
    main()
