"""The tables of tasks on which learning wins, on made-up costs."""

from __future__ import annotations

from tests.benchmarks.learning import HEADER, rows
from tests.benchmarks.table import two_tables
from torch_qpmpc.study.markdown import replaced


def test_rows_of_the_page_are_read_from_both_tables():
    page = "before\n<!-- learning -->\n\n<!-- /learning -->\nafter | not a row |\n"
    lines = {name: [f"{i}", *"234567", "", "10 of 10"] for i, name in enumerate(("a, N = 1", "b"))}
    tables = two_tables(HEADER, [[name, *line] for name, line in lines.items()], 7)
    assert rows(replaced(page, tables, "learning")) == lines
