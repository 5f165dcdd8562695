"""The whole loop of train.py: transitions a second.

    python -m tests.benchmarks.loop --write

Each row is a run of the point mass with the deviation penalty, without gate, figures and rivals, by
the wall clock; the kernels' compilation does not count.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

from tests.benchmarks.table import significant
from torch_qpmpc.study.markdown import replaced, table

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "benchmarks.md"
ENVIRONMENTS, UPDATES, STEPS = (16, 256, 4096), 25, 4
QUIET = ("constraint=deviation", "gate=false", "figures=false", "rivals=false")
TITLES = ["solver", "environments", "transitions a second", "ms an update"]


def measured(solver: str, count: int) -> list[str]:
    """Run train.py; return a row."""
    sizes = (f"num_envs={count}", f"replay_capacity={100 * count}", f"steps_per_update={STEPS}")
    length = (f"updates={UPDATES}", f"eval_interval={UPDATES}", "log_interval=1")
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        keys = [f"solver={solver}", f"hydra.run.dir={run}"]
        command = [sys.executable, "train.py", *keys, *sizes, *length, *QUIET]
        subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.DEVNULL)
        seconds = json.loads((run / "summary.json").read_text(encoding="utf-8"))["train_seconds"]
    rate = UPDATES * STEPS * count / seconds
    return [solver, f"{count:,}", significant(rate), significant(1e3 * seconds / UPDATES)]


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.loop", description=__doc__)
    parser.add_argument("--write", action="store_true", help="write the table into the docs")
    options = parser.parse_args(arguments)
    rows = []
    for solver in ("daqp", "proxqp"):
        for count in ENVIRONMENTS:
            rows.append(measured(solver, count))
            print(" | ".join(rows[-1]), flush=True)
    if options.write:
        text = replaced(PAGE.read_text(encoding="utf-8"), table(TITLES, rows), "loop")
        PAGE.write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
