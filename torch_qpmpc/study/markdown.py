"""Markdown tables, and their insertion between markers."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

from torch_qpmpc.errors import QPError, printable

#: Characters of a name that Markdown or HTML would read as more than text.
SPECIAL = {"&": "&amp;", "<": "&lt;", ">": "&gt;", "|": "&#124;", "`": "&#96;", "\n": " "}
SPECIAL |= {"\\": "&#92;", "](": "]&#40;", "\t": " "}


def escaped(name: object) -> str:
    """Return a name from a run's folder as plain text for a page and a terminal.

    Example:
        >>> escaped("<b>![x](http://y)")
        '&lt;b&gt;![x]&#40;http://y)'
    """
    return re.sub(r"\]\(|[&<>|`\\\n\t]", lambda match: SPECIAL[match[0]], printable(str(name)))


def table(head: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    """Format a table with the first column left-aligned and the others right-aligned."""
    rule = ["---"] + ["---:"] * (len(head) - 1)
    return "\n".join("| " + " | ".join(cells) + " |" for cells in (head, rule, *lines))


def replaced(text: str, new: str, marker: str) -> str:
    """Replace what ``text`` has between ``<!-- marker -->`` and ``<!-- /marker -->`` by ``new``.

    Raises:
        QPError: ``text`` does not have one of each, in this order.
    """
    begin, end = f"<!-- {marker} -->", f"<!-- /{marker} -->"
    counts = text.count(begin), text.count(end)
    if counts != (1, 1) or text.index(begin) > text.index(end):
        expected = f"one line {begin} and below it one line {end}"
        raise QPError.expected("the page", f"{counts[0]} and {counts[1]}", expected, "Add them.")
    before, after = text.split(begin)[0], text.split(end)[1]
    return f"{before}{begin}\n\n{new}\n\n{end}{after}"
