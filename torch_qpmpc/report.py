"""Tables of finished runs: ``python -m torch_qpmpc.report RUNS_FOLDER``."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import pandas as pd

from torch_qpmpc.errors import QPError

CASES = ("fixed", "free", "deviation", "si", "combined")
COLUMNS = ("J_start", "J_final", "J_true_model", "closed_gap", "unsolved", "train_seconds")


def collect(folder: str | Path) -> pd.DataFrame:
    """The summary.json of every run below ``folder``, one row a run.

    Raises:
        QPError: there is none.
    """
    files = sorted(Path(folder).rglob("summary.json"))
    if not files:
        raise QPError.expected(
            "RUNS_FOLDER", f"{folder}, without a finished run", "a folder that train.py wrote to"
        )
    frame = pd.DataFrame([json.loads(file.read_text(encoding="utf-8")) for file in files])
    known = pd.Categorical(
        frame["constraint"], [*CASES, *sorted({*frame["constraint"]} - {*CASES})]
    )
    return frame.assign(constraint=known).sort_values(["noise", "constraint", "seed"])


def runs_table(frame: pd.DataFrame) -> str:
    """Every run with its two ends, as Markdown."""
    rows = pd.DataFrame({name: frame[name] for name in ("noise", "constraint", "seed", *COLUMNS)})
    for name, digits in (("closed_gap", 3), ("train_seconds", 1)):
        rows[name] = rows[name].round(digits)
    for name in ("J_start", "J_final", "J_true_model"):
        rows[name] = rows[name].round(1)
    return _markdown(rows)


def cases_table(frame: pd.DataFrame) -> str:
    """Median, and range over the seeds, of the closed gap by case and noise, as Markdown."""
    groups = frame.groupby(["constraint", "noise"], observed=True)["closed_gap"]
    cells = groups.agg(lambda gap: f"{gap.median():.2f} ({gap.min():.2f} to {gap.max():.2f})")
    return _markdown(cells.unstack(fill_value="-").reset_index())


def _markdown(frame: pd.DataFrame) -> str:
    lines = [[str(name) for name in frame.columns], ["---"] * frame.shape[1]]
    lines += [[str(value) for value in row] for row in frame.itertuples(index=False)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", metavar="RUNS_FOLDER", help="searched with all its subfolders")
    try:
        frame = collect(parser.parse_args().folder)
    except QPError as error:
        raise SystemExit(str(error)) from None
    seeds = sorted({*frame["seed"]})
    print(f"{runs_table(frame)}\n\nClosed gap, median and range over seeds {seeds}:\n")
    print(cases_table(frame))


if __name__ == "__main__":
    main()
