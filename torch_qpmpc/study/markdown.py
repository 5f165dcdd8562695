"""Markdown tables, and their insertion between markers."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path

from torch_qpmpc.errors import QPError, printable


def escaped(name: object) -> str:
    """Return a name from a run's folder as plain text for a page and a terminal.

    Example:
        >>> escaped("<b>![x](http://y)")
        '&#60;b&#62;!&#91;x](http://y)'
    """
    text = " ".join(printable(str(name)).split())
    return re.sub(r"[&<>|`\\\[]", lambda match: f"&#{ord(match[0])};", text)


def table(head: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    """Format a table with the first column left-aligned and the others right-aligned."""
    rule = ["---"] + ["---:"] * (len(head) - 1)
    return "\n".join("| " + " | ".join(cells) + " |" for cells in (head, rule, *lines))


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
