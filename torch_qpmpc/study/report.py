"""Tables and figures of finished runs: ``python -m torch_qpmpc.report RUNS_FOLDER``.

The report is written to RUNS_FOLDER/report, with a folder for each sweep: the paper's figures with
intervals or ranges over seeds (1 and 3: learning-NOISE.png, 2 and 4: constraints-NOISE.png), and
the errors of the models that are read from C.
"""

import argparse
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from torch_qpmpc.errors import QPError
from torch_qpmpc.experiment.evaluation import cost_text
from torch_qpmpc.files import write_whole
from torch_qpmpc.study import plots
from torch_qpmpc.study.markdown import escaped, table
from torch_qpmpc.study.runs import CASES, REAL_GAP, collect
from torch_qpmpc.study.statistics import interquartile_mean, spread

#: Largest number of settings that fit side by side in a figure.
SIDE_BY_SIDE = 8
CAPTION = f"""\
Closed gap: median and 95% interval (bootstrapped over seeds; the range of fewer than six) of the
runs with a real gap, J_start - J_true_model >= {REAL_GAP:g} J_start, and their number; unstable are
runs whose loop with the true plant has a spectral radius above 1 at the origin, the largest of
which follows. All other entries are medians over all runs.
J: start to learned, with the true model in brackets. Distance: relative distance of C's predictions
from those of the nearest time-invariant MPC scheme. Zeros: share of C's entries above the band that
are exactly zero. Prediction error: root mean square over one step, of the corrupted (A, B) and of
that scheme's, and the number of runs in which the latter is smaller."""


def cases_table(sweep: pd.DataFrame) -> str:
    """Format a sweep by noise and case as a Markdown table."""
    lines = []
    for _, runs in sweep.groupby(["noise", "label"], sort=False):
        real = runs.query("real")["closed_gap"].to_numpy()
        gap = f"{np.median(real):.3f} {spread([real]).text()}" if len(real) else "-"
        loose = runs.query("radius > 1")["radius"]
        shown = f"; {len(loose)} unstable: {loose.max():.3f}" if len(loose) else ""
        median: Any = runs.median(numeric_only=True)
        start, best, true = (cost_text(median[f"J_{x}"]) for x in ("start", "best", "true_model"))
        errors = f"{median['prediction_error_start']:.3f} to {median['prediction_error']:.3f}"
        nearer = (runs["prediction_error"] < runs["prediction_error_start"]).sum()
        lines.append(
            [
                escaped(f"{runs['label'].iloc[0]}, {runs['noise'].iloc[0]}"),
                f"{gap} ({len(real)} of {len(runs)}){shown}",
                f"{start} to {best} ({true})",
                f"{median['canonical_distance']:.3f}",
                f"{median['zeros_above']:.2f}",
                f"{errors} ({nearer} of {len(runs)})",
            ]
        )
    return table(["case, noise", "closed gap", "J", "distance", "zeros", "prediction error"], lines)


def overall(sweep: pd.DataFrame) -> str:
    """Format the closed gap over the paper's cases that learn C, bootstrapped by case."""
    lines = []
    for noise, runs in sweep.query("real").groupby("noise"):
        cases = [runs.loc[runs["label"] == case, "closed_gap"].to_numpy() for case in CASES[1:]]
        if all(map(len, cases)):
            mean = interquartile_mean(np.concatenate(cases))
            ends = spread(cases, interquartile_mean).text()
            lines.append(f"{escaped(noise)} noise {mean:.3f} {ends}")
    if not lines:
        return ""
    return f"Interquartile mean over the paper's four cases that learn C: {'; '.join(lines)}."


def section(sweep: pd.DataFrame) -> str:
    """Format a sweep's table and, below it, its overall closed gap."""
    return "\n\n".join(filter(None, (cases_table(sweep), overall(sweep))))


def figures(sweep: pd.DataFrame) -> Iterator[tuple[str, Figure]]:
    """Yield the figures of a sweep of at most `SIDE_BY_SIDE` cases, each with its name."""
    if len({*sweep["label"]}) > SIDE_BY_SIDE:
        return
    for noise, runs in sweep.groupby("noise"):
        yield f"learning-{noise}", plots.learning_figure(runs)
        if len(learned := runs.query("constraint != 'fixed'")):
            yield f"constraints-{noise}", plots.constraints_figure(learned)
    if any(sweep["prediction_error"].notna()):  # the true model is known
        yield "meaning", plots.meaning_figure(sweep)


def write(frame: pd.DataFrame, folder: Path) -> str:
    """Write the report into ``folder``; return its tables."""
    pages = [CAPTION]
    for name, sweep in frame.groupby("sweep"):
        (folder / str(name)).mkdir(parents=True, exist_ok=True)
        pages.append(f"## {escaped(name)}\n\n{section(sweep)}")
        for title, figure in figures(sweep):
            # The noise is a name from the folder, which may have slashes.
            file = Path(str(name)) / re.sub(r"[^\w.,=-]+", "_", f"{title}.png")
            figure.savefig(folder / file, dpi=100)
            pages.append(f"![{escaped(title)}]({quote(file.as_posix())})")
    write_whole(folder / "report.md", "\n\n".join([*pages, ""]).encode())
    return "\n\n".join(page for page in pages if not page.startswith("!["))


def main(arguments: list[str] | None = None) -> None:
    about = "Write tables and figures of finished runs."
    parser = argparse.ArgumentParser(prog="python -m torch_qpmpc.report", description=about)
    parser.add_argument("folder", type=Path, metavar="RUNS_FOLDER", help="runs at any depth")
    folder = parser.parse_args(arguments).folder
    try:
        print(f"{write(collect(folder), folder / 'report')}\n\n{folder / 'report'}")
    except QPError as error:
        raise SystemExit(str(error)) from None
