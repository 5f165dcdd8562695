"""The tables and the picture of a study: ``python -m tests.benchmarks.paper RUNS_FOLDER``.

They go between the markers of the folder's name in docs/results/paper.md.
"""

import argparse
from pathlib import Path

from tests.benchmarks.table import DOCS, write_section
from torch_qpmpc.study import plots
from torch_qpmpc.study.markdown import escaped
from torch_qpmpc.study.report import SIDE_BY_SIDE, section
from torch_qpmpc.study.runs import collect


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, metavar="RUNS_FOLDER", help="runs at any depth")
    parser.add_argument("--page", type=Path, default=DOCS / "results/paper.md")
    options = parser.parse_args(arguments)
    page, name = options.page, options.folder.resolve().name
    sweeps = collect(options.folder).groupby("sweep")
    tables = [f"**{escaped(title)}**\n\n{section(sweep)}" for title, sweep in sweeps]
    write_section(page, "\n\n".join(tables), name)
    _, first = max(sweeps, key=lambda pair: pair[1]["closed_gap"].median())
    if len({*first["label"]}) <= SIDE_BY_SIDE:
        plots.meaning_figure(first).savefig(page.with_name(f"{name}.png"), dpi=90)


if __name__ == "__main__":
    main()
