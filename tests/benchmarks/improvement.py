"""Q-learning beside rivals that do not learn: ``python -m tests.benchmarks.improvement``.

Each case is one of train.py's configurations, which starts from a model identified from a log. What
is learned is the last theta, without a gate or a search. The evaluation has starts, days and noise
that no setting was chosen on. Finished runs are kept in docs/results/improvement.csv and not
repeated; the tables go into docs/results/improvement.md.
"""

from __future__ import annotations

import argparse
import functools
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import torch
from omegaconf import DictConfig

import train
from tests.benchmarks.learning import compared
from tests.benchmarks.table import DOCS, two_tables
from tests.runs import make_config
from torch_qpmpc.envs.closed_loop import cost_text
from torch_qpmpc.experiment.evaluation import rival_costs
from torch_qpmpc.experiment.plots import experience
from torch_qpmpc.experiment.rivals.rival import IDENTIFICATION, ZERO_ACTION
from torch_qpmpc.experiment.start import collect_log
from torch_qpmpc.experiment.tasks import find_task, make_physics
from torch_qpmpc.learning.search import KNOBS
from torch_qpmpc.study.markdown import replaced, table

PAGE, RESULTS = (DOCS / "results" / f"improvement.{end}" for end in ("md", "csv"))
#: Seeds of the runs, those with which the further ways run, and the seed of the evaluation.
SEEDS, FEW, EVAL_SEED = range(711, 721), range(711, 716), 9003
COMMON = ("solver=daqp", "figures=false", "logger=csv", f"eval_seed={EVAL_SEED}", "start=data")
COSTS = ("start", IDENTIFICATION, "other", "learned", "true model", "reference")


class Case(NamedTuple):
    """A task and how it is run.

    Attributes:
        overrides: those of train.py.
        reference: the rival with the most knowledge, if the task has one.
        others: rivals that need neither a simulator nor the true model.
        log: overrides with which the log is collected, where they are others.
    """

    overrides: Sequence[str]
    reference: str | None = None
    others: Sequence[str] = ()
    log: Sequence[str] = ()


# Random actions in one long episode would diverge.
SHORT_EPISODES = ("task=gros_zanon", "start=data", "num_envs=25", "task.episode_steps=20")
SHORT_EPISODES += ("start.transitions=500",)
DAYS = ("num_envs=4", "start.transitions=1152")
THERMOSTATS = ("thermostat", "thermostat with timer")
TD_ALONE = ("constraint=mpc", "task.learn_cost=[q,c]")
CASES = {
    "Point mass, Gaussian noise": Case(("task=point_mass",), "tightened"),
    "Point mass, Brownian noise": Case(("task=point_mass", "noise=brownian"), "tightened"),
    "Gros-Zanon, adaptive": Case(("task=gros_zanon",), "tightened", (), SHORT_EPISODES),
    "Gros-Zanon, TD errors alone": Case(
        ("task=gros_zanon", *TD_ALONE), "tightened", (), SHORT_EPISODES
    ),
    "House": Case(("task=house", "task.margin=0.1", *DAYS), "omniscient", THERMOSTATS),
    "House with a wall": Case(("task=house_wall", *DAYS), "omniscient", THERMOSTATS),
    "Four tanks": Case(("task=four_tanks",), "omniscient", ("DeePC",)),
    "Tank with references": Case(("task=tank_references",), "omniscient"),
    "Pendulum": Case(("task=pendulum",), None, (ZERO_ACTION,)),
}
PLAIN = ("gate=false", *(f"search.{name}=null" for name in KNOBS))
#: The further ways have fewer seeds; *search* runs on the true plant, as a simulator.
WAYS = {
    "Q-learning": PLAIN,
    "weighted": (*PLAIN, "algo.weighted=true"),
    "search": ("updates=1",),
}
#: Overrides of a task without a search of its own.
SEARCH: dict[str, Sequence[str]] = {
    "Point mass, Gaussian noise": ("search.H_f=1",),
    "Point mass, Brownian noise": ("search.H_f=1",),
}


def configuration(case: str, way: str, seed: int) -> DictConfig:
    """Compose the configuration of a run."""
    search = SEARCH.get(case, ()) if way == "search" else ()
    rivals = f"rivals=[{IDENTIFICATION}]" if way == "Q-learning" else "rivals=false"
    overrides = [*CASES[case].overrides, *WAYS[way], *search, rivals, f"seed={seed}"]
    cfg = make_config(*COMMON, *overrides)
    cfg.eval_interval = cfg.updates
    return cfg


@functools.cache
def fixed_costs(case: str) -> dict[str, float]:
    """Return J of the case's other rivals, the best of them, and of its reference."""
    cfg, (_, reference, others, _) = configuration(case, "Q-learning", 1), CASES[case]
    cfg.rivals = [*others, *([] if reference is None else [reference])]
    J = rival_costs(cfg, make_physics(cfg))
    other = min((J[name] for name in others), default=np.nan)
    return {"other": other, "reference": np.nan if reference is None else J[reference]}


def run(case: str, way: str, seed: int) -> dict[str, Any]:
    """Train once; return the fields of a row."""
    cfg, log, logged = configuration(case, way, seed), CASES[case].log, 0
    with tempfile.TemporaryDirectory() as folder:
        if log:
            other = make_config(*log, f"seed={seed}")
            cfg.start.file = f"{folder}/other.pt"
            torch.save(collect_log(other, make_physics(other)).to_dict(), cfg.start.file)
            logged = other.start.transitions
        summary = train.train(cfg, folder, quiet=True)
    before, each, _ = experience(cfg)
    unit, _ = find_task(cfg.task).unit
    costs = {
        "start": summary["J_start"],
        IDENTIFICATION: summary["rivals"].get(IDENTIFICATION),
        "learned": summary["J_best"],  # without a gate, the last theta
        "true model": summary["J_true_model"],
        **fixed_costs(case),
    }
    counts = {
        "transitions": round((before + each * cfg.updates) * unit) + logged,
        "simulated": summary.get("simulated", 0),
    }
    names = {"case": case, "way": way, "seed": seed}
    return names | {name: costs[name] for name in COSTS} | counts


def median_costs(runs: Any, names: Sequence[str]) -> list[str]:
    """Format medians of J; blank where there is no such controller."""
    medians = (float(runs[name].median()) for name in names)
    return ["" if np.isnan(x) else cost_text(x) for x in medians]


def comparison(rows: Any) -> str:
    """Format J of Q-learning and of what it is compared with, and the test of the difference."""
    lines = []
    for case in CASES:
        runs = rows[(rows["case"] == case) & (rows["way"] == "Q-learning")]
        if not len(runs):
            continue
        J = {name: runs[name].to_numpy(float) for name in COSTS}
        fair = np.nanmin([J[name] for name in COSTS[:3]], axis=0)
        outcome = compared(J["learned"], fair, J["reference"])
        cells = [cost_text(float(J["learned"].max())), *outcome]
        lines.append([case, *median_costs(runs, COSTS), *cells, f"{runs['transitions'].max():,}"])
    head = ["J, medians", *COSTS, "learned, worst", "share of the gap", "better", "p"]
    return two_tables([*head, "transitions"], lines, 7)


def further(rows: Any) -> str:
    """Format J of all ways, on the seeds that all of them have."""
    lines = []
    for case in CASES:
        runs = rows[rows["case"] == case]
        J = runs.pivot(index="seed", columns="way", values="learned").reindex(columns=[*WAYS])
        if len(J := J.dropna()):
            simulated = f"{runs['simulated'].max():,}"
            lines.append([case, str(len(J)), *median_costs(J, [*WAYS]), simulated])
    return table(["J, medians", "seeds", *WAYS, "simulated by search"], lines)


def order(pair: tuple[int, str]) -> tuple[bool, bool, int]:
    """Sort Q-learning on the few seeds before the other ways, and its other seeds after them."""
    seed, way = pair
    return seed not in FEW, way != "Q-learning", seed


def main(arguments: Iterable[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m tests.benchmarks.improvement", description="Write the table of learning."
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=list(SEEDS))
    parser.add_argument("--cases", nargs="+", choices=CASES, default=[*CASES])
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=[*WAYS])
    parser.add_argument("--results", type=Path, default=RESULTS, help="the file of all rows")
    parser.add_argument("--page", type=Path, default=PAGE, help="the file that gets the tables")
    options = parser.parse_args(None if arguments is None else list(arguments))
    text = options.page.read_text(encoding="utf-8")
    replaced(replaced(text, "", "improvement"), "", "further")  # fail before the runs
    torch.set_num_threads(1)
    rows: Any = pd.read_csv(options.results) if options.results.exists() else pd.DataFrame()
    done = {*rows[["case", "way", "seed"]].itertuples(index=False, name=None)} if len(rows) else {}
    seeds = {way: options.seeds if way == "Q-learning" else FEW for way in options.ways}
    pairs = sorted(((seed, way) for way in seeds for seed in seeds[way]), key=order)
    wanted = ((case, way, seed) for seed, way in pairs for case in options.cases)
    for key in wanted:
        if key not in done:
            rows = pd.concat([rows, pd.DataFrame([row := run(*key)])])
            rows.to_csv(options.results, index=False, float_format="%.6g")
            print(*row.values(), flush=True)
    text = replaced(replaced(text, comparison(rows), "improvement"), further(rows), "further")
    options.page.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
