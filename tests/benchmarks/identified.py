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
from omegaconf import DictConfig

from tests.benchmarks.table import DOCS
from tests.runs import make_config
from torch_qpmpc.envs.closed_loop import cost_text
from torch_qpmpc.envs.heated_house import DAY
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
    """A task with logs of some length.

    Attributes:
        title: names the case in its table.
        overrides: those of train.py.
        picture: name of the picture of the first log's free C, beside the page.
    """

    title: str
    overrides: Sequence[str]
    picture: str | None = None

    def configured(self, *more: str) -> DictConfig:
        """Compose the configuration of its runs, with ``more`` overrides."""
        shared = ("start=data", UNDISCOUNTED, f"eval_seed={EVAL_SEED}")
        return make_config(*self.overrides, *shared, *more)


class Scale(NamedTuple):
    """How a task's J is shown.

    Attributes:
        reference: the rival that ratios are relative to.
        per: J is divided by this.
        fixed: the part of J that no policy changes.
    """

    reference: str
    per: float = 1.0
    fixed: float = 0.0


def logs(count: int, length: int) -> tuple[str, ...]:
    """Return the overrides of ``count`` logs of ``length`` steps."""
    total = f"start.transitions={count * length}"
    return (f"num_envs={count}", f"task.episode_steps={length}", total)


#: EUR a day in the houses, and the mean of 200 steps for the references; the tanks of the set point
#: start at zero, and the cost of that is left out.
SCALES = {
    "house": Scale("omniscient"),
    "house_wall": Scale("omniscient", per=2),
    "four_tanks": Scale("Kalman filter, N = 60", fixed=35.5),
    "tank_references": Scale("exact MPC", per=200),
}
ROOM, WALL = ("task=house", "task.margin=0.1"), ("task=house_wall",)
REFERENCES = ("task=tank_references", *logs(10, 100))
CASES = {
    "house": [
        Case("Room, 12 days, L = 4", (*ROOM, "task.past=4", *logs(1, 12 * DAY)), "house-day"),
        Case("Room, 12 days, L = 1", (*ROOM, *logs(1, 12 * DAY))),
        Case("House with a wall, 8 days", (*WALL, *logs(1, 8 * DAY))),
        Case("House with a wall, 20 days", (*WALL, *logs(1, 20 * DAY)), "house-wall-days"),
    ],
    "tanks": [
        Case("Set point", ("task=four_tanks", *logs(1, 1000)), "tanks-set-point"),
        Case("References", REFERENCES, "tanks-references"),
        Case("References, disturbed", (*REFERENCES, "task.disturbed=true")),
    ],
}


def evaluated(case: Case, seeds: Sequence[int], folder: Path) -> dict[str, list[float]]:
    """Return J by controller, the best first: of each seed's log, or once where no log is used.

    Draws the case's picture into ``folder``.
    """
    cfg = case.configured()
    physics: Any = make_physics(cfg)
    rivals, scale = TASKS[cfg.task.name].rivals, SCALES[cfg.task.name]
    true_mpc = make_true_mpc(cfg, physics)
    assert true_mpc is not None
    found = {"true model": [evaluate(cfg, warm_policy(true_mpc), physics).J]}
    cfg.rivals = [name for name in rivals if name != "DeePC"]
    found |= {name: [J] for name, J in rival_costs(cfg, physics).items()}
    for seed in seeds:
        for name, constraint in STRUCTURES.items():
            cfg = case.configured(constraint, f"seed={seed}")
            log = collect_log(cfg, physics)
            mpc = make_mpc(cfg, physics, identified_start(cfg, physics, log))
            loop = evaluate(cfg, warm_policy(mpc), physics)
            found.setdefault(f"from_data, {name} C", []).append(loop.J)
            if name == "tied":
                continue
            if "DeePC" in rivals:
                J = evaluate(cfg, deepc(physics, log), physics).J
                found.setdefault("DeePC", []).append(J)
            if case.picture and seed == seeds[0]:
                shown = Evaluation(cfg, physics, {"learned": loop}, {})
                learned_episode_figure(mpc, shown).savefig(folder / f"{case.picture}.png", dpi=110)
    return {
        name: [(J - scale.fixed) / scale.per for J in costs]
        for name, costs in sorted(found.items(), key=lambda item: median(item[1]))
    }


def case_table(title: str, found: dict[str, list[float]], reference: str) -> str:
    """Format the costs of a case."""
    lines = []
    for name, costs in found.items():
        spread = [cost_text(x) for x in (min(costs), max(costs))] if len(costs) > 1 else ["", ""]
        ratio = median(costs) / median(found[reference])
        lines.append([name, cost_text(median(costs)), *spread, f"{ratio:.3f}"])
    return table([title, "median", "best", "worst", f"/ {reference}"], lines)


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
            found = evaluated(case, options.seeds, options.folder)
            task = case.configured().task.name
            blocks.append(case_table(case.title, found, SCALES[task].reference))
            print(blocks[-1], flush=True)
        text = page.read_text(encoding="utf-8")
        page.write_text(replaced(text, "\n\n".join(blocks), "identified"), encoding="utf-8")


if __name__ == "__main__":
    main()
