"""Markdown tables."""

import re
from collections.abc import Iterable, Sequence

from torch_qpmpc.errors import printable


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
