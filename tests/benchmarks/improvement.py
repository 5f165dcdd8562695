"""What learning adds to its start, on all tasks: ``python -m tests.benchmarks.improvement``.

Each case is one of train.py's configurations and a start, corrupted or identified from a log; each
way is plain Q-learning, the default, or, on some cases, a single method. The evaluation
has starts, days and noise that no setting was chosen on. Finished runs are kept in
docs/results/improvement.csv and not repeated; the tables go into docs/results/improvement.md.
"""

from __future__ import annotations

import argparse
import csv
import functools
import math
import tempfile
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import torch
from omegaconf import DictConfig

import train
from tests.benchmarks.table import DOCS, two_tables
from tests.runs import make_config
from torch_qpmpc.envs.closed_loop import cost_text
from torch_qpmpc.experiment.evaluation import rival_costs
from torch_qpmpc.experiment.plots import experience
from torch_qpmpc.experiment.start import collect_log
from torch_qpmpc.experiment.tasks import find_task, make_physics
from torch_qpmpc.learning.search import KNOBS
from torch_qpmpc.study.markdown import replaced, table
from torch_qpmpc.study.statistics import spread

PAGE = DOCS / "results" / "improvement.md"
RESULTS = DOCS / "results" / "improvement.csv"
#: Seeds of the runs, and of the evaluation.
SEEDS, EVAL_SEED = range(501, 511), 9002
COMMON = ("solver=daqp", "figures=false", "logger=csv", "rivals=false", f"eval_seed={EVAL_SEED}")
NO_SEARCH = tuple(f"search.{name}=null" for name in KNOBS)
ENDS = ("start", "best", "true model", "reference")
FIELDS = ("case", "way", "seed", *ENDS, "final")
FIELDS += ("transitions", "simulated", "accepted", "rejected", "seconds")


class Case(NamedTuple):
    """A task and the start of its learning.

    Attributes:
        overrides: those of train.py.
        reference: the rival with the most knowledge, if the task has one.
        log: overrides with which the log is collected, where they are others.
    """

    overrides: Sequence[str]
    reference: str | None = None
    log: Sequence[str] = ()


MODEL, DATA = "start=model", "start=data"
HOUSE, WALL = ("task=house", "task.margin=0.1"), ("task=house_wall",)
#: As many transitions as 24 of the task's updates, with four times as many updates.
HOUSE_8 = ("steps_per_update=1", "updates=96")
SHORT_EPISODES = ("task=gros_zanon", DATA, "num_envs=25", "task.episode_steps=20")
SHORT_EPISODES += ("start.transitions=500",)
DAYS = ("num_envs=4", "start.transitions=1152")
CASES = {
    "Point mass, Gaussian noise, corrupted": Case(("task=point_mass",)),
    "Point mass, Gaussian noise, corrupted, constraint=identified": Case(
        ("task=point_mass", "constraint=identified")
    ),
    "Point mass, Gaussian noise, identified": Case(("task=point_mass", DATA)),
    "Point mass, Brownian noise, corrupted": Case(("task=point_mass", "noise=brownian")),
    "Point mass, Brownian noise, identified": Case(("task=point_mass", "noise=brownian", DATA)),
    "Gros-Zanon, corrupted": Case(("task=gros_zanon",), "tightened"),
    "Gros-Zanon, corrupted, TD errors alone": Case(
        ("task=gros_zanon", "constraint=mpc", "task.learn_cost=[q,c]"), "tightened"
    ),
    # Random actions in one long episode would diverge.
    "Gros-Zanon, identified": Case(("task=gros_zanon", DATA), "tightened", SHORT_EPISODES),
    "House, corrupted, 8 days": Case((*HOUSE_8, "task=house"), "omniscient"),
    "House, corrupted": Case(("task=house",), "omniscient"),
    "House, identified": Case((*HOUSE, DATA, *DAYS), "omniscient"),
    "House with a wall, corrupted": Case(WALL, "omniscient"),
    "House with a wall, identified": Case((*WALL, DATA, *DAYS), "omniscient"),
    "Four tanks, identified": Case(("task=four_tanks",), "omniscient"),
    "Tank with references, corrupted": Case(("task=tank_references",), "omniscient"),
    "Tank with references, identified": Case(("task=tank_references", DATA), "omniscient"),
    "Pendulum, linear model": Case(("task=pendulum",)),
    "Pendulum, identified": Case(("task=pendulum", DATA)),
}
PLAIN = ("gate=false", *NO_SEARCH)
WAYS = {"Q-learning": PLAIN, "default": ()}
GATE, SEARCH = "gate", "search"
METHODS = {
    GATE: NO_SEARCH,
    SEARCH: ("updates=1",),
}
POINT_MASS: dict[str, Sequence[str]] = {SEARCH: ("search.H_f=1",)}
#: Cases of the single methods, with further overrides of some.
METHOD_CASES: dict[str, dict[str, Sequence[str]]] = {
    "Point mass, Gaussian noise, identified": POINT_MASS,
    "Point mass, Brownian noise, identified": POINT_MASS,
    "Gros-Zanon, corrupted, TD errors alone": {},
    "House, identified": {},
    "House with a wall, identified": {},
    "Four tanks, identified": {},
    "Tank with references, identified": {},
    "Pendulum, identified": {},
}


@functools.cache
def reference_cost(case: str) -> float | None:
    """Return J of the case's reference."""
    overrides, reference, _ = CASES[case]
    if reference is None:
        return None
    cfg = make_config(*COMMON, *overrides)
    cfg.rivals = [reference]
    return rival_costs(cfg, make_physics(cfg))[reference]


def configuration(case: str, way: str, seed: int) -> DictConfig:
    """Compose the configuration of a run."""
    overrides = [*COMMON, *CASES[case].overrides, *(WAYS | METHODS)[way], f"seed={seed}"]
    return make_config(*overrides, *METHOD_CASES.get(case, {}).get(way, ()))


def run(case: str, way: str, seed: int) -> dict[str, Any]:
    """Train once; return the fields of a row."""
    log = CASES[case].log
    cfg = configuration(case, way, seed)
    began = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        logged = 0
        if log:
            other = make_config(*log, f"seed={seed}")
            cfg.start.file = f"{folder}/other.pt"
            torch.save(collect_log(other, make_physics(other)).to_dict(), cfg.start.file)
            logged = other.start.transitions
        summary = train.train(cfg, folder, quiet=True)
    seconds = time.perf_counter() - began
    before, each, _ = experience(cfg)
    unit, _ = find_task(cfg.task).unit
    ends = {name: summary[f"J_{name}"] for name in ("start", "best", "final")}
    return ends | {
        "case": case,
        "way": way,
        "seed": seed,
        "true model": summary["J_true_model"],
        "reference": reference_cost(case),
        "transitions": round((before + each * cfg.updates) * unit) + logged,
        "simulated": summary.get("simulated", 0),
        "accepted": summary.get("accepted"),
        "rejected": summary.get("rejected"),
        "seconds": round(seconds, 1),
    }


def finished(path: Path) -> pd.DataFrame:
    """Read the rows of former runs."""
    return pd.read_csv(path) if path.exists() else pd.DataFrame(columns=list(FIELDS))


def add(path: Path, row: Any) -> None:
    """Append a row."""
    new = not path.exists()
    path.parent.mkdir(exist_ok=True)
    with path.open("a", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, FIELDS, lineterminator="\n")
        if new:
            writer.writeheader()
        writer.writerow(row)


def percents(rows: Any) -> np.ndarray:
    """Return J of each run relative to its start's, in percent."""
    return 100 * rows["best"].to_numpy(float) / rows["start"].to_numpy(float)


def ratios(rows: Any) -> str:
    """Format J relative to the start's, in percent: median, spread, worst seed."""
    percent = percents(rows)
    return f"{np.median(percent):.1f} {spread([percent]).text('.1f')}, {percent.max():.1f}"


def by_case(rows: Any) -> Iterator[tuple[str, Any]]:
    """Yield the rows of each case, in the order of the cases."""
    for case in CASES:
        if len(runs := rows[rows["case"] == case]):
            yield case, runs


def outcome_table(rows: Any) -> str:
    """Format each case's J by way, relative to its start."""
    lines = []
    for case, runs in by_case(rows):
        ways = [runs[runs["way"] == way] for way in WAYS]
        cells = [ratios(found) if len(found) else "" for found in ways]
        seeds = str(runs["seed"].nunique())
        lines.append([case, seeds, cost_text(float(runs["start"].median())), *cells])
    head = ["J / J of the start, %: median [interval], worst", "seeds", "J start", *WAYS]
    return table(head, lines)


def method_table(rows: Any) -> str:
    """Format J of single methods, relative to the start's.

    A case's seeds are those with which all its methods have run.
    """
    ways = (*WAYS, *METHODS)
    head = ["J / J of the start, %: median [interval], worst", "seeds", *ways]
    lines = []
    for case, runs in by_case(rows):
        if case not in METHOD_CASES:
            continue
        common = set.intersection(*({*found["seed"]} for _, found in runs.groupby("way")))
        lines.append([case, str(len(common))])
        for way in ways:
            of_way: Any = runs[runs["seed"].isin([*common]) & (runs["way"] == way)]
            lines[-1].append(ratios(of_way) if len(of_way) else "")
    return table(head, lines)


def closed(start: np.ndarray, best: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the share of the gap to another controller; NaN if a start is as good as it."""
    if not (start > other).all():
        return np.full_like(start, np.nan)
    return (start - best) / (start - other)


def reference_table(rows: Any) -> str:
    """Format the default's J beside the other controllers', with what it took."""
    lines = []
    for case, runs in by_case(rows[rows["way"] == "default"]):
        J = {name: runs[name].to_numpy(float) for name in ENDS}
        gaps = (closed(J["start"], J["best"], J[name]) for name in ENDS[2:])
        medians = [float(np.median(x)) for x in (*J.values(), *gaps)]
        cells = [cost_text(x) for x in medians[:4]] + [f"{x:.2f}" for x in medians[4:]]
        cells = ["" if math.isnan(x) else cell for x, cell in zip(medians, cells, strict=True)]
        counts = [f"{runs[n].median():,.0f}" for n in ("transitions", "simulated")]
        accepted, rejected = (runs[n].sum() for n in ("accepted", "rejected"))
        lines.append([case, *cells, *counts, f"{accepted:.0f} of {accepted + rejected:.0f}"])
    head = ["Medians", "start", "default", "true model", "reference", "gap closed to true model"]
    head += ["to reference", "transitions", "simulated for comparisons", "accepted"]
    return two_tables(head, lines, 7)


def wanted(
    seeds: Sequence[int], parts: Sequence[str], ways: Sequence[str]
) -> Iterator[tuple[str, str, int]]:
    """Yield case, way and seed of each run, for the cases with one of ``parts`` in their names."""
    cases = [case for case in CASES if any(part in case for part in parts)]
    for seed in seeds:
        yield from ((case, way, seed) for case in cases for way in WAYS if way in ways)
        some = [case for case in cases if case in METHOD_CASES]
        yield from ((case, way, seed) for case in some for way in METHODS if way in ways)


def main(arguments: Iterable[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m tests.benchmarks.improvement", description="Write the table of learning."
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=list(SEEDS))
    parser.add_argument("--cases", nargs="+", default=[""], help="parts of the cases' names")
    ways = [*WAYS, *METHODS]
    parser.add_argument("--ways", nargs="+", choices=ways, default=ways)
    parser.add_argument("--results", type=Path, default=RESULTS, help="the file of all rows")
    parser.add_argument("--page", type=Path, default=PAGE, help="the file that gets the tables")
    options = parser.parse_args(None if arguments is None else list(arguments))
    text = options.page.read_text(encoding="utf-8")
    replaced(replaced(text, "", "improvement"), "", "methods")  # fail before the runs
    torch.set_num_threads(1)
    for case, way, seed in wanted(options.seeds, options.cases, options.ways):
        rows = finished(options.results)
        done = {*zip(rows["case"], rows["way"], rows["seed"], strict=True)}
        if (case, way, seed) not in done:
            add(options.results, row := run(case, way, seed))
            print(*row.values(), flush=True)
    rows: Any = finished(options.results)
    rows = rows[rows["seed"].isin(options.seeds)]
    both: Any = rows[rows["way"].isin([*WAYS])]
    tables = f"{outcome_table(both)}\n\n{reference_table(both)}"
    text = replaced(replaced(text, tables, "improvement"), method_table(rows), "methods")
    options.page.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
