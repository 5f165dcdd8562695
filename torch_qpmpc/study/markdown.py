"""Tables in Markdown, and their place in a file."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from torch_qpmpc.errors import QPError


def table(head: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    """The first column to the left and the others to the right."""
    rule = ["---"] + ["---:"] * (len(head) - 1)
    return "\n".join("| " + " | ".join(cells) + " |" for cells in (head, rule, *lines))


def replaced(text: str, new: str, marker: str) -> str:
    """``text`` with ``new`` between the lines ``<!-- marker -->`` and ``<!-- /marker -->``.

    Raises:
        QPError: it has not one of each, in this order.
    """
    begin, end = f"<!-- {marker} -->", f"<!-- /{marker} -->"
    counts = text.count(begin), text.count(end)
    if counts != (1, 1) or text.index(begin) > text.index(end):
        expected = f"one line {begin} and below it one line {end}"
        raise QPError.expected("the page", f"{counts[0]} and {counts[1]}", expected, "Add them.")
    before, after = text.split(begin)[0], text.split(end)[1]
    return f"{before}{begin}\n\n{new}\n\n{end}{after}"
