"""A benchmark program of one table on the page about proofs, with a row for each name."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import torch

from torch_qpmpc.study.markdown import replaced, table

PAGE = Path(__file__).parents[2] / "docs" / "guides" / "prove.md"


def write(mark: str, titles: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Write a table into the page."""
    text = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(replaced(text, table(titles, rows), mark), encoding="utf-8")


def main(
    program: str,
    mark: str,
    titles: Sequence[str],
    names: Iterable[str],
    measured: Callable[[str], list[str]],
) -> bool:
    """Measure the rows that the command line names, all by default; True if they are written."""
    parser = argparse.ArgumentParser(prog=f"python -m tests.benchmarks.{program}")
    parser.add_argument("--rows", nargs="*", default=list(names))
    parser.add_argument("--write", action="store_true", help="write the table into the docs")
    options = parser.parse_args()
    torch.set_num_threads(1)
    rows: list[list[str]] = []
    for name in options.rows:
        rows.append(measured(name))
        print(" | ".join(rows[-1]), flush=True)
    if options.write:
        write(mark, titles, rows)
    return options.write
