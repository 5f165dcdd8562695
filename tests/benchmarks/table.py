"""Run the benchmarks and write their tables to the docs: ``python -m tests.benchmarks.table``."""

import argparse
import json
import math
import os
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from torch_qpmpc.study.markdown import table, write_section

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGE = DOCS / "benchmarks.md"
RESULTS = ROOT / "runs" / "benchmark.json"
REFERENCE = "ProxSuite's QPFunction"
#: The columns of times: whether C is dense, and the batch.
CASES = ((True, 1), (True, 256), (True, 1024), (False, 256))

Row = dict[str, Any]


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m tests.benchmarks.table", description="Write the benchmark's tables."
    )
    parser.add_argument("--json", type=Path, help="format these results instead of running")
    parser.add_argument("--page", type=Path, default=PAGE, help="the file that gets the tables")
    options = parser.parse_args(arguments)
    results = json.loads((options.json or run()).read_text(encoding="utf-8"))
    write_section(options.page, tables(results), "benchmark")


def run() -> Path:
    """Run the benchmarks in a separate process; return the file of their results."""
    RESULTS.parent.mkdir(exist_ok=True)
    command = [sys.executable, "-m", "pytest", "-q", str(Path(__file__).parent)]
    options = [f"--benchmark-json={RESULTS}", "--benchmark-columns=median,rounds"]
    # NumPy's threads would add to a row's number of threads.
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
    ended = subprocess.run(command + options, cwd=ROOT, env=environment, check=False)
    if ended.returncode:
        sys.exit("the benchmarks failed; no table was written")
    print(f"results: {RESULTS}")
    return RESULTS


def tables(results: dict[str, Any]) -> str:
    """Format all results as Markdown."""
    rows = [
        {**b["extra_info"], "test": b["name"].split("[")[0], "seconds": b["stats"]["median"]}
        for b in results["benchmarks"]
    ]
    parts = [
        conditions(results["machine_info"]),
        gradients([row for row in rows if row["test"] == "test_gradient"]),
    ]
    return "\n\n".join(part for part in parts if part)


def conditions(machine: dict[str, Any]) -> str:
    cpu = machine.get("cpu", {})
    versions = ", ".join(f"{name} {number}" for name, number in machine["versions"].items())
    return (
        f"Measured in one run on {cpu.get('count', '?')} cores ({cpu.get('brand_raw', 'unknown')}) "
        f"with Python {machine['python_version']}, {versions}. One thread; medians "
        "of wall-clock time after a warm-up."
    )


def gradients(rows: list[Row]) -> str:
    if not rows:
        return ""
    caption = (
        "Each time, in ms, covers V on the next states, Q on the visited pairs, and the gradient "
        "in all of theta; brackets have the speed-up over ProxSuite's layer, timed in turns. On "
        "the right are the largest relative errors for a dense C: of values, with the number wrong "
        "by more than 1e-6, and of gradients."
    )
    own = {_case(row): row["seconds"] for row in rows if row["row"] == REFERENCE}
    lines = []
    for name in _unique(row["row"] for row in rows):
        mine = {_case(row): row for row in rows if row["row"] == name}
        cells = [_timing(mine[x], own.get(x)) if x in mine else "" for x in CASES]
        dense = [row for row in mine.values() if row["dense"]]
        worst = max(dense, key=lambda row: (row["wrong"], row["value_error"]))
        gradient = max(row["gradient_error"] for row in dense)
        lines.append([name, *cells, _errors(worst), f"{gradient:.0e}"])
    head = ["batch of", *(f"{batch:,}" + ("" if dense else ", banded") for dense, batch in CASES)]
    return f"{caption}\n\n{table([*head, 'value', 'gradient'], lines)}"


def _case(row: Row) -> tuple[bool, int]:
    return row["dense"], row["batch"]


def _timing(row: Row, own: float | None) -> str:
    reference = row.get("reference_seconds", own)
    ratio = "" if reference is None or row["row"] == REFERENCE else reference / row["seconds"]
    return significant(1e3 * row["seconds"]) + (f" ({significant(ratio)}x)" if ratio else "")


def _errors(row: Row) -> str:
    wrong = f", {row['wrong']:,} of {row['solved']:,} wrong" if row["wrong"] else ""
    return f"{row['value_error']:.0e}{wrong}"


def _unique(items: Iterable[Any]) -> list[Any]:
    return list(dict.fromkeys(items))


def significant(x: float) -> str:
    """Format three significant digits below a hundred, whole numbers above."""
    if x >= 100:
        return f"{_round(x):,}"
    return f"{x:.{max(0, 2 - math.floor(math.log10(x)))}f}"


def _round(x: float) -> int:
    """Round to three significant digits."""
    return int(float(f"{x:.3g}"))


if __name__ == "__main__":
    main()
