"""What the benchmarks' tables share."""

import argparse
import math
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import pandas as pd

from torch_qpmpc.errors import QPError
from torch_qpmpc.study.markdown import table

__all__ = ["DOCS", "PAGE", "ROOT", "keep", "options_of", "publish", "significant", "table"]
__all__ += ["write_section"]

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGE = DOCS / "benchmarks.md"


def significant(x: float) -> str:
    """Format three significant digits below a hundred, whole numbers above."""
    if x >= 100:
        return f"{int(float(f'{x:.3g}')):,}"
    return f"{x:.{max(0, 2 - math.floor(math.log10(x)))}f}"


def publish(text: str, marker: str, write: bool, page: Path = PAGE) -> None:
    """Print a table, and ``write`` it to its place in a page."""
    print(text)
    if write:
        write_section(page, text, marker)


def options_of(
    parser: argparse.ArgumentParser,
    arguments: Iterable[str] | None,
    seeds: Iterable[int],
    results: Path,
    page: Path,
) -> Any:
    """Parse ``arguments`` of a program that keeps the rows of each seed in a file."""
    parser.add_argument("--seeds", type=int, nargs="+", default=list(seeds))
    parser.add_argument("--results", type=Path, default=results, help="the file of all rows")
    parser.add_argument("--page", type=Path, default=page, help="the file that gets the tables")
    return parser.parse_args(None if arguments is None else list(arguments))


def keep(
    path: Path,
    keys: Iterable[tuple[str, int]],
    run: Callable[[str, int], dict[str, Any]],
    by: str = "case",
    na_rep: str = "",
) -> Any:
    """Return the rows of a file ``by`` and seed, with those that it lacks, each kept at once."""
    rows: Any = pd.read_csv(path) if path.exists() else pd.DataFrame()
    done = {*rows[[by, "seed"]].itertuples(index=False, name=None)} if len(rows) else {}
    for key in keys:
        if key not in done:
            rows = pd.concat([rows, pd.DataFrame([row := run(*key)])])
            rows.to_csv(path, index=False, float_format="%.6g", na_rep=na_rep)
            print(*row.values(), flush=True)
    return rows


def write_section(page: Path, new: str, marker: str) -> None:
    """Replace what ``page`` has between ``<!-- marker -->`` and ``<!-- /marker -->`` by ``new``."""
    text = page.read_text(encoding="utf-8")
    begin, end = f"<!-- {marker} -->", f"<!-- /{marker} -->"
    counts = text.count(begin), text.count(end)
    if counts != (1, 1) or text.index(begin) > text.index(end):
        expected = f"one line {begin} and below it one line {end}"
        raise QPError.expected(str(page), f"{counts[0]} and {counts[1]}", expected, "Add them.")
    before, after = text.split(begin)[0], text.split(end)[1]
    page.write_text(f"{before}{begin}\n\n{new}\n\n{end}{after}", encoding="utf-8")
