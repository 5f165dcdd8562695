"""QPs beside plain networks: ``python -m tests.benchmarks.networks``.

Each case is a configuration of train.py. ``--train`` runs its missing seeds, below the folder
``--runs``, and writes J by transitions to networks.csv, where what has no run there stays.
Without it, the tables and the figure of the page are drawn from that file.
"""

from __future__ import annotations

import argparse
import csv
import math
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from statistics import median

import numpy as np
from matplotlib.figure import Figure

from tests.benchmarks.table import DOCS, ROOT
from torch_qpmpc.envs.closed_loop import cost_text
from torch_qpmpc.experiment.config import load_config
from torch_qpmpc.experiment.plots import experience, scale_costs
from torch_qpmpc.experiment.run_folder import read_metrics
from torch_qpmpc.experiment.tasks import find_task
from torch_qpmpc.study.markdown import replaced, table

#: J by transitions of each seed; those of each case of each task.
Seeds = dict[int, dict[int, float]]
Curves = dict[str, dict[str, Seeds]]

PAGE = DOCS / "results" / "networks.md"
SEEDS = range(11, 16)
#: J is shown at these multiples of the QP's transitions.
MULTIPLES = (1, 100)
#: A gate's closed loops would be further transitions.
COMMON = ("gate=false", "rivals=false", "figures=false")
PENDULUM = (
    *("task=pendulum", "start=data", "algo.critic=mlp", "algo.actor_rate=1"),
    *("algo.lr_network=1e-3", "algo.width=64", "target_rate=0.01", "batch_size=128"),
    *("solver=daqp", "task.horizon=5", "constraint=free", "constraint.learn=[C,b]"),
    *("num_envs=1", "replay_capacity=10000", "log_interval=50", "eval_interval=1000"),
)
#: The log's 2,000 transitions, of which a network has no use, count as the QP's.
SCHEDULED = ("algo.actor=scheduled", "algo.theta.q=5", "algo.theta.b=0.3", "updates=7950")
ALONE = ("algo.actor=mlp", "updates=9950")
#: Episodes of 5 s. The linear model is that at the hanging pole, where they start.
CART_POLE = (
    *("task=gymnasium", "task.id=gymnasium_cartpole_swingup:CartPoleSwingUp-v0"),
    "task.kwargs={obs_mode: trig, cost_mode: pilco, sigma_c: 1, x_threshold: 1000, dt: 0.05}",
    "task.A=[[1,.05,0,0,0],[0,.992,.2946,0,0],[0,0,1,0,-.05],[0,0,0,1,0],[0,.02,1.964,0,1]]",
    "task.B=[[0],[.8],[0],[0],[-2]]",
    "task.stage_weight=[[4,0,2.4,0,0,0],[0,.1,0,0,0,0],[2.4,0,2.4,0,0,0],[0,0,0,0,0,0],"
    "[0,0,0,0,.05,0],[0,0,0,0,0,1]]",
    *("task.horizon=5", "task.episode_steps=100", "task.eval_steps=100", "task.gamma=0.97"),
    "task.terminal_weight=identity",
    *("task.action_slack=0.1", "solver=daqp", "constraint=free", "constraint.learn=[C,b]"),
    *("algo=td3", "algo.critic=mlp", "algo.lr_network=1e-3", "algo.width=128"),
    *("target_rate=0.01", "batch_size=128", "exploration_std=0.8", "replay_capacity=10000"),
    *("num_envs=1", "warmup_steps=1000", "updates=9000", "log_interval=50", "eval_interval=1000"),
)
CART_POLE_QP = ("algo.actor_rate=0.3", "optimizer.lr_cost=2e-3", "optimizer.lr_constraints=2e-4")
NETWORK = (
    *("algo.actor=mlp", "algo.critic=mlp", "algo.width=256", "algo.actor_rate=1"),
    *("constraint=free", "target_rate=0.005", "batch_size=256", "replay_capacity=102400"),
    "log_interval=100",
)
POINT_MASS = ("task=point_mass", "num_envs=160", "updates=4090", "eval_interval=200")
#: One update of 256 transitions for each new one, as in the published examples, after a warm-up;
#: as many transitions as the QP's.
EACH = ("task=point_mass", "num_envs=1", "warmup_steps=592", "updates=6000", "eval_interval=500")
FAST, SLOW = "algo.lr_network=1e-3", "algo.lr_network=3e-4"
#: The overrides of each case, by task; the first case of a task is the QP.
CASES: dict[str, dict[str, Sequence[str]]] = {
    "pendulum": {
        "scheduled QP by TD3": ("algo=td3", *PENDULUM, *SCHEDULED),
        "network by TD3": ("algo=td3", *PENDULUM, *ALONE),
        "scheduled QP by SAC": ("algo=sac", *PENDULUM, *SCHEDULED),
        "network by SAC": ("algo=sac", *PENDULUM, *ALONE),
    },
    "cart_pole": {
        "scheduled QP": (*CART_POLE, *CART_POLE_QP, "algo.actor=scheduled"),
        "network": (*CART_POLE, "algo.actor_rate=1", "algo.actor=mlp"),
    },
    "point_mass": {
        "QP": ("task=point_mass",),
        "TD3": ("algo=td3", *NETWORK, *POINT_MASS, SLOW),
        "SAC": ("algo=sac", *NETWORK, *POINT_MASS, FAST),
        "TD3 each step": ("algo=td3", *NETWORK, *EACH, FAST),
        "SAC each step": ("algo=sac", *NETWORK, *EACH, FAST),
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
        for update, J in read_metrics(file.parent)["eval/J"].dropna().to_dict().items():
            if update or not network:
                yield cfg.seed, round((before + each * float(update)) * length) - unused, float(J)


def update(curves: Curves, runs: Path) -> Curves:
    """Return the curves with those of the runs below ``runs`` in the place of the same seeds'."""
    updated: Curves = {}
    for task, cases in CASES.items():
        for case in cases:
            seeds = updated.setdefault(task, {})[case] = dict(curves.get(task, {}).get(case, {}))
            found: Seeds = {}
            for seed, transitions, J in costs(runs / task / case):
                found.setdefault(seed, {})[transitions] = J
            seeds |= found
    return updated


def write(curves: Curves, file: Path) -> None:
    """Write J to a CSV file, by task, case, seed and transitions."""
    rows = [
        (task, case, seed, transitions, f"{J:.6g}")
        for task, cases in curves.items()
        for case, seeds in cases.items()
        for seed, found in seeds.items()
        for transitions, J in found.items()
    ]
    with file.open("w", encoding="utf-8", newline="") as out:
        writer = csv.writer(out, lineterminator="\n")
        writer.writerows([("task", "case", "seed", "transitions", "J"), *rows])


def read(file: Path) -> Curves:
    """Read what `write` has written."""
    found: Curves = {}
    with file.open(encoding="utf-8", newline="") as rows:
        for row in csv.DictReader(rows):
            seeds = found.setdefault(row["task"], {}).setdefault(row["case"], {})
            seeds.setdefault(int(row["seed"]), {})[int(row["transitions"])] = float(row["J"])
    return found


def at(seeds: Seeds, transitions: float = math.inf) -> list[float]:
    """Return J of each seed at its last evaluation with at most so many transitions."""
    latest = [max((x for x in J if x <= transitions), default=None) for J in seeds.values()]
    return [J[x] for J, x in zip(seeds.values(), latest, strict=True) if x is not None]


def reach(seeds: Seeds, level: float) -> list[int]:
    """Return the transitions after which J is first at most ``level``, of the seeds that do so."""
    found = [min((x for x in J if J[x] <= level), default=None) for J in seeds.values()]
    return [x for x in found if x is not None]


def seeds_table(cases: Mapping[str, Seeds]) -> str:
    """Format the last J of a task's cases, by seed."""
    head = ["J", "median", *(f"seed {seed}" for seed in next(iter(cases.values())))]
    last = {case: at(seeds) for case, seeds in cases.items()}
    return table(head, [[case, *map(cost_text, [median(J), *J])] for case, J in last.items()])


def spread(J: list[float]) -> str:
    """Format the median, the best and the worst."""
    return f"{cost_text(median(J))} [{cost_text(min(J))}, {cost_text(max(J))}]"


def budgets_table(cases: Mapping[str, Seeds]) -> str:
    """Format J of a task's cases at multiples of the QP's transitions, and who reaches its J."""
    qp, *_ = cases.values()
    budget, level = max(map(max, qp.values())), median(at(qp))
    lines = []
    for case, seeds in cases.items():
        row = [case]
        for multiple in MULTIPLES:
            J = at(seeds, multiple * budget)
            covered = min(map(max, seeds.values())) > 0.99 * multiple * budget
            row.append(spread(J) if J and covered else "")
        found = reach(seeds, level)
        after = f", after {median(found):,.0f}" if found else ""
        lines.append([*row, "" if seeds is qp else f"{len(found)} of {len(seeds)}{after}"])
    head = [f"J at {multiple * budget:,}" for multiple in MULTIPLES]
    return table(["", *head, f"reach {cost_text(level)}"], lines)


TITLES = {
    "pendulum": "Pendulum",
    "cart_pole": "Cart-pole, swing-up",
    "point_mass": "Point mass",
}


def figure(curves: Curves) -> Figure:
    """Draw J over transitions for each task: the median over seeds, the best and the worst."""
    drawn = Figure(figsize=(5 * len(curves), 4), layout="constrained")
    panels = drawn.subfigures(1, len(curves), squeeze=False)[0]
    for panel, (task, cases) in zip(panels, curves.items(), strict=True):
        axes = panel.subplots()
        for case, seeds in cases.items():
            x = sorted(set.intersection(*map(set, seeds.values())))
            J = np.array([[of_seed[k] for k in x] for of_seed in seeds.values()])
            (line,) = axes.plot(x, np.median(J, 0), label=case)
            axes.fill_between(x, J.min(0), J.max(0), color=line.get_color(), alpha=0.2, linewidth=0)
        axes.set(title=TITLES[task], xlabel="transitions", ylabel="J", xscale="log")
        scale_costs(axes)
        axes.legend(fontsize="small")
    return drawn


TABLES = {
    "pendulum": seeds_table,
    "cart_pole": seeds_table,
    "point_mass": budgets_table,
}


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m tests.benchmarks.networks", description="Compare QPs with plain networks."
    )
    parser.add_argument("--train", action="store_true", help="run what is missing; takes hours")
    parser.add_argument("--tasks", nargs="+", choices=list(CASES), default=list(CASES))
    parser.add_argument("--seeds", type=int, nargs="+", default=list(SEEDS))
    parser.add_argument("--runs", type=Path, default=ROOT / "runs" / "networks")
    parser.add_argument("--page", type=Path, default=PAGE)
    options = parser.parse_args(arguments)
    file = options.page.with_suffix(".csv")
    if options.train:
        before = read(file) if file.exists() else {}
        for task in options.tasks:
            for case in CASES[task]:
                train(options.runs, task, case, options.seeds)
        write(update(before, options.runs), file)
    curves = read(file)
    figure(curves).savefig(options.page.with_suffix(".png"), dpi=80)
    text = options.page.read_text(encoding="utf-8")
    for task, cases in curves.items():
        text = replaced(text, TABLES[task](cases), task)
    options.page.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
