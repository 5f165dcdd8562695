"""Tables and figures of finished runs: ``python -m torch_qpmpc.report RUNS_FOLDER``.

The report is written to RUNS_FOLDER/report, with a folder for each sweep: the paper's figures with
intervals or ranges over seeds (1 and 3: learning-NOISE.png, 2 and 4: constraints-NOISE.png),
closed-loop paths, slices of value and policy, model errors, and for swept settings the frontier and
the ablations.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import quote

import pandas as pd
from matplotlib.figure import Figure

from torch_qpmpc.envs.closed_loop import cost_text, gap_text
from torch_qpmpc.errors import QPError
from torch_qpmpc.experiment.links import check_links
from torch_qpmpc.files import write_whole
from torch_qpmpc.study.markdown import escaped, replaced, table
from torch_qpmpc.study.plots import (
    ablation_figure,
    constraints_figure,
    frontier_figure,
    learning_figure,
    meaning_figure,
    policies_figure,
    readme_figure,
    trajectories_figure,
)
from torch_qpmpc.study.runs import CASES, REAL_GAP, chosen, collect, has_real
from torch_qpmpc.study.statistics import interquartile_mean, spread

#: Largest number of settings that fit side by side in a figure.
SIDE_BY_SIDE = 8
CAPTION = f"""\
Closed gap: median and 95% interval (bootstrapped over seeds; the range of fewer than six) of the
runs with a real gap, J_start - J_true_model >= {REAL_GAP:g} J_start, and their number. All other
entries are medians over all runs.
J: start to learned, with the true model in brackets. Distance: relative distance of C's predictions
from those of the nearest time-invariant MPC scheme. Zeros: share of C's entries above the band that
are exactly zero. Prediction error: root mean square over one step, of the corrupted (A, B) and of
that scheme's, and the number of runs in which the latter is smaller."""


def runs_table(frame: pd.DataFrame) -> str:
    """Format all runs as a Markdown table."""
    costs = ("J_start", "J_best", "J_true_model")
    head = ["sweep", "noise", "case", "seed", *costs, "closed_gap"]
    head += [
        "canonical_distance",
        "prediction_error",
        "prediction_error_start",
        "unsolved",
        "train_seconds",
    ]
    digits = {"train_seconds": ".1f", "canonical_distance": ".3f"}
    digits |= dict.fromkeys(("prediction_error", "prediction_error_start"), ".4f")
    ends = (frame[name] for name in ("closed_gap", *costs))
    gaps = [gap_text(*values) for values in zip(*ends, strict=True)]
    rows = frame.assign(case=frame["label"], closed_gap=gaps)[head].itertuples(index=False)
    lines = [
        [
            cost_text(value) if name in costs else escaped(f"{value:{digits.get(name, '')}}")
            for name, value in zip(head, row, strict=True)
        ]
        for row in rows
    ]
    return table(head, lines)


def cases_table(sweep: pd.DataFrame) -> str:
    """Format a sweep by noise and case as a Markdown table."""
    lines = []
    for noise, label in dict.fromkeys(zip(sweep["noise"], sweep["label"], strict=True)):
        runs = chosen(sweep, noise=noise, label=label)
        real = runs.query("real")["closed_gap"].to_numpy()
        median = runs.median(numeric_only=True)
        nearer = (runs["prediction_error"] < runs["prediction_error_start"]).sum()
        gap = "-"
        if len(real):
            gap = f"{pd.Series(real).median():.3f} {spread([real]).text()}"
        errors = f"{median['prediction_error_start']:.3f} to {median['prediction_error']:.3f}"
        lines.append(
            [
                escaped(f"{label}, {noise}"),
                f"{gap} ({len(real)} of {len(runs)})",
                _ends(median, "J"),
                f"{median['canonical_distance']:.3f}",
                f"{median['zeros_above']:.2f}",
                f"{errors} ({nearer} of {len(runs)})",
            ]
        )
    head = ["case, noise", "closed gap", "J", "distance", "zeros", "prediction error"]
    return table(head, lines)


def _ends(median: pd.Series, name: str) -> str:
    start, best, true = (median[f"{name}_{end}"] for end in ("start", "best", "true_model"))
    return f"{cost_text(start)} to {cost_text(best)} ({cost_text(true)})"


def overall(sweep: pd.DataFrame) -> str:
    """Format the closed gap over the paper's cases that learn C, bootstrapped by case."""
    lines = []
    for noise, runs in sweep.query("real").groupby("noise"):
        cases = [chosen(runs, label=case)["closed_gap"].to_numpy() for case in CASES[1:]]
        if not all(map(len, cases)):
            continue
        mean = interquartile_mean(pd.Series([gap for case in cases for gap in case]).to_numpy())
        lines.append(
            f"{escaped(noise)} noise {mean:.3f} {spread(cases, interquartile_mean).text()}"
        )
    if not lines:
        return ""
    return f"Interquartile mean over the four cases that learn C: {'; '.join(lines)}."


def has_ablations(sweep: pd.DataFrame) -> bool:
    """Return True if the sweep compares ablations and has a real gap."""
    return "ablation" in sweep and len({*sweep["ablation"]}) > 1 and has_real(sweep)


def figures(sweep: pd.DataFrame) -> Iterator[tuple[str, Figure]]:
    """Yield the figures of a sweep, each with its name."""
    if len({*sweep["label"]}) <= SIDE_BY_SIDE:
        for noise, runs in sweep.groupby("noise"):
            yield f"learning-{noise}", learning_figure(runs)
            qps = runs.query("actor == 'qp'")
            learned = qps.query("constraint != 'fixed'")
            if len(learned):
                yield f"constraints-{noise}", constraints_figure(learned)
            qps = qps.assign(simulated=[run.has_plant for run in qps["run"]]).query("simulated")
            if len(qps):
                yield f"trajectories-{noise}", trajectories_figure(qps)
            if len(qps) and qps["run"].iloc[0].start.n_x > 1:
                yield f"policies-{noise}", policies_figure(qps)
        if any(sweep["prediction_error"].notna()):  # the true model is known
            yield "meaning", meaning_figure(sweep)
    elif has_real(sweep):
        yield "frontier", frontier_figure(sweep)
    if has_ablations(sweep):
        yield "ablation", ablation_figure(sweep)


def write(frame: pd.DataFrame, folder: Path) -> str:
    """Write the report into ``folder``; return its tables."""
    parts = []
    for name, sweep in frame.groupby("sweep"):
        own_folder = folder / str(name)
        own_folder.mkdir(parents=True, exist_ok=True)
        links = []
        for title, figure in figures(sweep):
            # The noise is a name from the folder, which may have slashes.
            file = re.sub(r"[^\w.,=-]+", "_", f"{title}.png")
            figure.savefig(own_folder / file, dpi=100)
            links.append(f"![{escaped(title)}]({quote((Path(str(name)) / file).as_posix())})")
        parts.append(((f"## {escaped(name)}", section(sweep)), links))
    tables = "\n\n".join("\n\n".join(text) for text, _ in parts)
    whole = "\n\n".join("\n\n".join([*text, *links]) for text, links in parts)
    write_whole(folder / "report.md", f"{CAPTION}\n\n{whole}\n".encode())
    write_whole(folder / "runs.md", f"{runs_table(frame)}\n".encode())
    return f"{CAPTION}\n\n{tables}"


def section(sweep: pd.DataFrame) -> str:
    """Format a sweep's table and, below it, its overall closed gap and what was proved."""
    texts = cases_table(sweep), overall(sweep), proofs(sweep)
    return "\n\n".join(text for text in texts if text)


def proofs(sweep: pd.DataFrame) -> str:
    """Format the answers of ``prove=BOUND``, a line for each run that has one."""
    if "proof" not in sweep:
        return ""
    runs = zip(sweep["run"], sweep["label"], sweep["seed"], sweep["proof"], strict=True)
    lines = [
        f"- {escaped(label)}, seed {seed}, |nu| <= {run.cfg.prove:g}: {escaped(proof)}"
        for run, label, seed, proof in runs
        if isinstance(proof, str)
    ]
    return "\n".join(["From every start:", "", *lines]) if lines else ""


def write_page(frame: pd.DataFrame, page: Path, name: str) -> None:
    """Write the tables between the markers ``name`` of a Markdown file, and NAME.png beside it."""
    text = page.read_text(encoding="utf-8")
    tables = [
        f"**{escaped(title)}**\n\n{section(sweep)}" for title, sweep in frame.groupby("sweep")
    ]
    page.write_text(replaced(text, "\n\n".join([*tables, CAPTION]), name), encoding="utf-8")
    first = max(frame.groupby("sweep"), key=lambda pair: pair[1]["closed_gap"].median())[1]
    headline(first).savefig(page.with_name(f"{name}.png"), dpi=90)


def headline(sweep: pd.DataFrame) -> Figure:
    """Draw a sweep in one figure."""
    if has_ablations(sweep):
        return ablation_figure(sweep)
    if len({*sweep["label"]}) > SIDE_BY_SIDE:
        return frontier_figure(sweep)
    return readme_figure(sweep)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m torch_qpmpc.report",
        description="Write tables and figures of finished runs.",
    )
    parser.add_argument(
        "folder", type=Path, metavar="RUNS_FOLDER", help="folder of the runs, at any depth"
    )
    parser.add_argument(
        "--page", type=Path, help="Markdown file whose <!-- RUNS_FOLDER --> section gets the tables"
    )
    options = parser.parse_args(arguments)
    try:
        frame = collect(options.folder)
        if options.page:
            write_page(frame, options.page, options.folder.resolve().name)
        check_links(options.folder, "report")
        print(write(frame, options.folder / "report"))
    except QPError as error:
        raise SystemExit(str(error)) from None
    print(f"\n{options.folder / 'report'}")


if __name__ == "__main__":
    main()
