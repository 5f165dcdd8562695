"""Draw the guides' pictures by their own Python: ``python docs/pictures.py [NAME..]``."""

from __future__ import annotations

import contextlib
import re
import shutil
import sys
import tempfile
from pathlib import Path

GUIDES = Path(__file__).parent / "guides"
PYTHON = re.compile(r"^```python\n(.*?)^```", re.DOTALL | re.MULTILINE)


def draw(page: Path) -> None:
    """Run the page's Python in an empty folder, and keep the pictures that it shows."""
    text = page.read_text(encoding="utf-8")
    drawn, shown = re.findall(r'savefig\("(.+?)"', text), re.findall(r"!\[.*\]\((.+)\)", text)
    if not (names := {*drawn} & {*shown}):
        return
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        exec(compile("\n".join(PYTHON.findall(text)), page, "exec"), {"__name__": "page"})
        for name in names:
            shutil.copy(name, GUIDES)


if __name__ == "__main__":
    for page in sorted(GUIDES.glob("*.md")):
        if page.stem in sys.argv[1:] or not sys.argv[1:]:
            draw(page)
