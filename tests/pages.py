"""The pages of the documentation, and their blocks of code."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = {
    path.relative_to(ROOT).as_posix(): path.read_text(encoding="utf-8")
    for path in (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(DOCS.rglob("*.md")))
    if path.exists()
}

needs_docs = pytest.mark.skipif(not DOCS.exists(), reason="no docs, as in a wheel's tests")


def fenced(text: str, language: str) -> list[tuple[int, str]]:
    """Return the fenced blocks in a language, each with the line that it starts on."""
    fence = re.compile(rf"^```{language}[^\n]*\n(.*?)^```", re.DOTALL | re.MULTILINE)
    return [(text.count("\n", 0, m.start(1)), m.group(1)) for m in fence.finditer(text)]
