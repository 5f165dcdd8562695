"""Q-learning beside rivals that do not learn: ``python -m tests.benchmarks.improvement``.

Each case is one of train.py's configurations, which starts from a model identified from a log. What
is learned is the last theta, without a gate. The evaluation has starts, days and noise
that no setting was chosen on. Finished runs are kept in docs/results/improvement.csv and not
repeated; the tables go into docs/results/improvement.md.
"""

import argparse
import functools
import tempfile
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch

import train
from tests.benchmarks.table import DOCS, keep, options_of, table, write_section
from tests.runs import make_config
from torch_qpmpc.experiment.algorithms import evaluate
from torch_qpmpc.experiment.evaluation import cost_text
from torch_qpmpc.experiment.plots import experience
from torch_qpmpc.experiment.rivals import IDENTIFICATION, ZERO_ACTION
from torch_qpmpc.experiment.start import collect_log
from torch_qpmpc.experiment.tasks import find_task, make_physics

PAGE, RESULTS = (DOCS / "results" / f"improvement.{end}" for end in ("md", "csv"))
#: Seeds of the runs, and of the evaluation.
SEEDS, EVAL_SEED = range(711, 721), 9003
COMMON = ("solver=daqp", "figures=false", f"eval_seed={EVAL_SEED}", "start=data")
COMMON += (f"rivals=[{IDENTIFICATION}]", "gate=false")
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
GROS_ZANON = Case(("task=gros_zanon",), "tightened", (), SHORT_EPISODES)
CASES = {
    "Point mass, Gaussian noise": Case(("task=point_mass",), "tightened"),
    "Point mass, Brownian noise": Case(("task=point_mass", "noise=brownian"), "tightened"),
    "Gros-Zanon": GROS_ZANON,
    "Pendulum": Case(("task=pendulum",), None, (ZERO_ACTION,)),
}


def configuration(case: Case, seed: int) -> Any:
    cfg = make_config(*COMMON, *case.overrides, f"seed={seed}")
    cfg.eval_interval = cfg.updates
    return cfg


@functools.cache
def fixed_costs(case: str) -> dict[str, float]:
    """Return J of the case's other rivals, the best of them, and of its reference."""
    cfg, (_, reference, others, _) = configuration(CASES[case], 1), CASES[case]
    names, physics = [*others, *([] if reference is None else [reference])], make_physics(cfg)
    rivals = find_task(cfg.task).rivals
    J = {name: evaluate(cfg, rivals[name](physics), physics).J for name in names}
    other = min((J[name] for name in others), default=np.nan)
    return {"other": other, "reference": np.nan if reference is None else J[reference]}


def trained(case: Case, seed: int) -> tuple[Any, int, dict[str, Any]]:
    """Train once; return the configuration, the size of a log of its own, and the summary."""
    cfg, logged = configuration(case, seed), 0
    with tempfile.TemporaryDirectory() as folder:
        if case.log:
            other = make_config(*case.log, f"seed={seed}")
            cfg.start.file = f"{folder}/other.pt"
            torch.save(collect_log(other, make_physics(other)).to_dict(), cfg.start.file)
            logged = other.start.transitions
        return cfg, logged, train.train(cfg, folder, quiet=True)


def run(case: str, seed: int) -> dict[str, Any]:
    cfg, logged, summary = trained(CASES[case], seed)
    before, each = experience(cfg)
    costs = {
        "start": summary["J_start"],
        IDENTIFICATION: summary["rivals"][IDENTIFICATION],
        "learned": summary["J_final"],
        "true model": summary["J_true_model"],
        **fixed_costs(case),
    }
    transitions = before + each * cfg.updates + logged
    names = {"case": case, "seed": seed}
    return names | {name: costs[name] for name in COSTS} | {"transitions": transitions}


def median_costs(runs: Any, names: Sequence[str]) -> list[str]:
    """Format medians of J; blank where there is no such controller."""
    medians = (float(runs[name].median()) for name in names)
    return ["" if np.isnan(x) else cost_text(x) for x in medians]


def comparison(rows: Any) -> str:
    """Format J of Q-learning and of what it is compared with, and the seeds on which it is less."""
    lines, shown = [], [name for name in COSTS if name != "true model"]
    for case in CASES:
        runs = rows[rows["case"] == case]
        if not len(runs):
            continue
        J = {name: runs[name].to_numpy(float) for name in COSTS}
        better = (J["learned"] < np.nanmin([J[name] for name in COSTS[:3]], axis=0)).sum()
        cells = [cost_text(float(J["learned"].max())), f"{better} of {len(runs)}"]
        lines.append([case, *median_costs(runs, shown), *cells, f"{runs['transitions'].max():,}"])
    return table(["J, medians", *shown, "learned, worst", "better", "transitions"], lines)


def main(arguments: Iterable[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m tests.benchmarks.improvement", description="Write the table of learning."
    )
    parser.add_argument("--cases", nargs="+", choices=CASES, default=[*CASES])
    options = options_of(parser, arguments, SEEDS, RESULTS, PAGE)
    torch.set_num_threads(1)
    keys = ((case, seed) for seed in options.seeds for case in options.cases)
    rows = keep(options.results, keys, run)
    write_section(options.page, comparison(rows), "improvement")


if __name__ == "__main__":
    main()
