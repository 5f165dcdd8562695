"""The table of `docs/results/weighted.md`: ``python -m tests.benchmarks.weighted FOLDER``.

FOLDER holds the runs of ``+study=actuator_noise``, with and without ``algo.weighted``.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import pandas as pd

from tests.benchmarks.table import DOCS
from torch_qpmpc.study.markdown import replaced, table

PAGE = DOCS / "results" / "weighted.md"
#: Transitions before the first update and in each, and those from which a run counts as steady.
WARM_UP, UPDATE, STEADY = 640, 160, 3000
HEADER = ("case", "seeds", "start", "median", "worst median", "worst", "end: worst")


def ratios(folder: Path) -> pd.Series:
    """Return discounted J over that of the optimum by the number of transitions."""
    optimum = json.loads((folder / "summary.json").read_text())["J_discounted_true_model"]
    J = pd.read_csv(folder / "metrics.csv", index_col="update")["eval/J_discounted"].dropna()
    return J.set_axis(WARM_UP + UPDATE * J.index) / optimum


def rows(folder: Path) -> list[list[str]]:
    """Return a row for each strength of the noise, horizon and weighting."""
    cases: dict[tuple[str, str, str], list[pd.Series]] = {}
    for run in sorted(folder.glob("N=*")):
        N, std, weighted = (part.split("=")[1] for part in run.name.split("-")[:3])
        cases.setdefault((std, N, {"True": "weighted", "False": "plain"}[weighted]), []).append(
            ratios(run)
        )
    lines = []
    for case, runs in sorted(cases.items(), reverse=True):
        all_runs = pd.concat(runs, axis=1)
        steady = all_runs[all_runs.index >= STEADY]
        medians = steady.median(axis=1)
        numbers = (all_runs.iloc[0, 0], medians.median(), medians.max(), steady.max().max())
        numbers += (all_runs.iloc[-1].max(),)
        std, N, weighted = case
        name = f"std {std}, N = {N}, {weighted}"
        lines.append([name, str(len(runs)), *(f"{x:.3f}" for x in numbers)])
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.weighted")
    parser.add_argument("folder", type=Path)
    text = table(HEADER, rows(parser.parse_args().folder))
    page = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(replaced(page, text, "actuator noise"), encoding="utf-8")


if __name__ == "__main__":
    main()
