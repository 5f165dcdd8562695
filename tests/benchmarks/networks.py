"""QPs beside plain networks: ``python -m tests.benchmarks.networks``.

Each case is a configuration of train.py. ``--train`` runs its missing seeds, below the folder
``--runs``, and writes J by transitions to networks.csv. Without it, the tables and the figure of
the page are drawn from that file.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import pandas as pd
from matplotlib.figure import Figure

from tests.benchmarks.table import DOCS, ROOT
from torch_qpmpc.envs.closed_loop import cost_text
from torch_qpmpc.experiment.config import load_config
from torch_qpmpc.experiment.plots import experience, scale_costs
from torch_qpmpc.experiment.run_folder import read_metrics
from torch_qpmpc.experiment.tasks import find_task
from torch_qpmpc.study.markdown import replaced, table

PAGE = DOCS / "results" / "networks.md"
SEEDS = range(11, 16)
#: J is shown at these multiples of the QP's transitions.
MULTIPLES = (1, 10, 100)
#: A gate's closed loops would be further transitions.
COMMON = ("gate=false", "rivals=false", "figures=false")
PENDULUM = (
    *("task=pendulum", "start=data", "algo=td3", "algo.critic=mlp", "algo.actor_rate=1"),
    *("algo.lr_network=1e-3", "algo.width=64", "target_rate=0.01", "batch_size=128"),
    *("solver=daqp", "task.horizon=5", "constraint=free", "constraint.learn=[C,b]"),
    *("num_envs=1", "replay_capacity=10000", "log_interval=50", "eval_interval=1000"),
)
NETWORK = (
    *("algo.actor=mlp", "algo.critic=mlp", "algo.width=256", "algo.actor_rate=1"),
    *("constraint=free", "target_rate=0.005", "batch_size=256", "replay_capacity=102400"),
    "log_interval=100",
)
POINT_MASS = ("task=point_mass", "num_envs=160", "updates=4090", "eval_interval=200")
HOUSE = ("task=house", "num_envs=64", "warmup_steps=10", "updates=3090", "eval_interval=150")
FAST, SLOW = "algo.lr_network=1e-3", "algo.lr_network=3e-4"
#: The overrides of each case, by task; the first case of a task is the QP.
CASES: dict[str, dict[str, Sequence[str]]] = {
    "pendulum": {
        "scheduled QP": (
            *PENDULUM,
            *("algo.actor=scheduled", "algo.theta.q=5", "algo.theta.b=0.3", "updates=7950"),
        ),
        "network": (*PENDULUM, "algo.actor=mlp", "updates=9950"),
    },
    "point_mass": {
        "QP": ("task=point_mass",),
        "TD3": ("algo=td3", *NETWORK, *POINT_MASS, SLOW),
        "SAC": ("algo=sac", *NETWORK, *POINT_MASS, FAST),
    },
    "house": {
        "QP": ("task=house",),
        "TD3": ("algo=td3", *NETWORK, *HOUSE, SLOW),
        "SAC": ("algo=sac", *NETWORK, *HOUSE, FAST),
    },
}


def train(runs: Path, task: str, case: str, seeds: Sequence[int]) -> None:
    """Run the seeds of a case that are missing below ``runs``, one after the other."""
    folder = runs / task / case
    missing = [seed for seed in seeds if not list(folder.rglob(f"*seed{seed}/summary.json"))]
    if missing:
        sweep = [f"seed={','.join(map(str, missing))}", f"hydra.sweep.dir={folder}"]
        command = [sys.executable, "train.py", "-m", "hydra/launcher=basic", *sweep]
        subprocess.run([*command, *COMMON, *CASES[task][case]], cwd=ROOT, check=True)


def costs(folder: Path) -> Iterator[tuple[int, int, float]]:
    """Yield seed, transitions and J of each evaluation of the finished runs below ``folder``.

    A network uses no log, and the first evaluation of its run is that of the QP.
    """
    for file in sorted(folder.rglob("summary.json")):
        cfg = load_config(file.parent / "config.yaml")
        network = cfg.algo.get("actor") == "mlp"
        before, each, _ = experience(cfg)
        length, _ = find_task(cfg.task).unit
        unused = cfg.start.transitions if network and cfg.start.name == "data" else 0
        J = read_metrics(file.parent)["eval/J"].dropna()
        for update, cost in J.items():
            if update or not network:
                yield cfg.seed, round((before + each * update) * length) - unused, cost


def collected(runs: Path) -> pd.DataFrame:
    """Return J of all cases by task, case, seed and transitions."""
    rows = [
        (task, case, *row)
        for task, cases in CASES.items()
        for case in cases
        for row in costs(runs / task / case)
    ]
    return pd.DataFrame(rows, columns=["task", "case", "seed", "transitions", "J"])


def at(runs: pd.DataFrame, transitions: int) -> pd.Series:
    """Return J by seed at the last evaluation of a case with at most so many transitions."""
    before = runs[runs["transitions"] <= transitions].sort_values("transitions")
    return before.groupby("seed")["J"].last()


def reach(runs: pd.DataFrame, level: float) -> pd.Series:
    """Return, by seed, the transitions after which J of a case is first at most ``level``."""
    return runs[runs["J"] <= level].groupby("seed")["transitions"].min()


def cell(J: pd.Series) -> str:
    """Format the median over seeds, the best and the worst."""
    if J.empty:
        return "-"
    return f"{cost_text(J.median())} [{cost_text(J.min())}, {cost_text(J.max())}]"


def seeds_table(frame: pd.DataFrame) -> str:
    """Format the last J of each case of one task, by seed."""
    seeds = sorted(frame["seed"].unique())
    lines = []
    for case, runs in frame.groupby("case", sort=False):
        J = at(runs, runs["transitions"].max())
        each = [cost_text(J[seed]) if seed in J else "-" for seed in seeds]
        lines.append([str(case), cost_text(J.median()), *each])
    return table(["J", "median", *(f"seed {seed}" for seed in seeds)], lines)


def budgets_table(frame: pd.DataFrame) -> str:
    """Format J of a task's cases at multiples of the QP's transitions, and who reaches its J."""
    first = frame["case"].iloc[0]
    qp = frame[frame["case"] == first]
    budget = int(qp["transitions"].max())
    level = at(qp, budget).median()
    lines = []
    for case, runs in frame.groupby("case", sort=False):
        row, found = [str(case)], reach(runs, level)
        for multiple in MULTIPLES:
            fits = runs["transitions"].max() >= 0.99 * multiple * budget
            row.append(cell(at(runs, multiple * budget)) if fits else "")
        count = f"{len(found)} of {runs['seed'].nunique()}"
        median = f", {found.median():,.0f} transitions" if len(found) else ""
        lines.append([*row, "" if case == first else count + median])
    head = [f"J at {multiple * budget:,}" for multiple in MULTIPLES]
    return table(["", *head, f"reach {cost_text(level)}"], lines)


def figure(frame: pd.DataFrame) -> Figure:
    """Draw J over transitions for each task: the median over seeds, the best and the worst."""
    tasks = frame["task"].unique()
    drawn = Figure(figsize=(5 * len(tasks), 4), layout="constrained")
    for axes, task in zip(drawn.subplots(1, len(tasks), squeeze=False)[0], tasks, strict=True):
        for case, runs in frame[frame["task"] == task].groupby("case", sort=False):
            J = runs[runs["transitions"] > 0].groupby("transitions")["J"]
            line = axes.plot(J.median().index, J.median(), label=case)[0]
            axes.fill_between(
                J.min().index, J.min(), J.max(), color=line.get_color(), alpha=0.2, linewidth=0
            )
        axes.set(title=task, xlabel="transitions", ylabel="J", xscale="log")
        scale_costs(axes)
        axes.legend(fontsize="small")
    return drawn


TABLES = {"pendulum": seeds_table, "point_mass": budgets_table, "house": budgets_table}


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m tests.benchmarks.networks", description="Compare QPs with plain networks."
    )
    parser.add_argument("--train", action="store_true", help="run what is missing; takes hours")
    parser.add_argument("--seeds", type=int, nargs="+", default=list(SEEDS))
    parser.add_argument("--runs", type=Path, default=ROOT / "runs" / "networks")
    parser.add_argument("--page", type=Path, default=PAGE)
    options = parser.parse_args(arguments)
    file = options.page.with_suffix(".csv")
    if options.train:
        for task, cases in CASES.items():
            for case in cases:
                train(options.runs, task, case, options.seeds)
        collected(options.runs).to_csv(file, index=False, float_format="%.6g")
    frame = pd.read_csv(file)
    figure(frame).savefig(options.page.with_suffix(".png"), dpi=80)
    text = options.page.read_text(encoding="utf-8")
    for task, runs in frame.groupby("task", sort=False):
        text = replaced(text, TABLES[str(task)](runs), str(task))
    options.page.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
