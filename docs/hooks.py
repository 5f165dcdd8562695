"""Additions to mkdocs.yml: files from outside docs/, made pages, and the examples of docstrings."""

from __future__ import annotations

import re
import sys
from importlib.resources import files as package_files
from pathlib import Path
from typing import Any

import griffe
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.plugins import event_priority
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "docs"))
from keys import page  # noqa: E402, a file beside this one


@event_priority(100)  # before mkdocs-jupyter, which turns notebooks into pages
def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the notebooks, MathJax from its Python package, and the page of configuration keys."""
    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        place = f"notebooks/{path.name}"
        files.append(File(place, str(ROOT), config.site_dir, config.use_directory_urls))
    mathjax = package_files("mathjax") / "static" / "mathjax" / "es5" / "tex-svg.js"
    files.append(File.generated(config, "javascripts/tex-svg.js", abs_src_path=str(mathjax)))
    files.append(File.generated(config, "guides/keys.md", content=page()))
    return files


def on_page_content(html: str, page: Any, **_: Any) -> str:
    """Rank the guides above the reference and the notebooks, which have more words, in searches."""
    if page.file.src_uri.startswith(("api/", "notebooks/")):
        page.meta["search"] = {"boost": 0.1}
    return html


def described_fields(lines: list[str]) -> list[str]:
    """Return what comments at the fields of a class say, ``#:`` of all up to the next comment."""
    found: list[list[str]] = []
    above: list[str] = []
    for line in lines:
        if comment := re.match(r"    #: (.*)", line):
            above.append(comment[1])
        elif field := re.match(r"    (\w+): .*?(?:  # (?!pyright|noqa)(.*))?$", line):
            if above or field[2] or not found:
                found.append([field[1], field[2] or " ".join(above), *above])
            elif len(found[-1]) > 2:
                found[-1][0] += f", {field[1]}"
            above = []
    return [f"    {names}: {text}" for names, text, *_ in found if text]


class Docstrings(griffe.Extension):
    """Read ``Example:`` as doctests, ``A, B: ..`` as two parameters, and comments at fields."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        if obj.docstring is None:
            return
        text = re.sub(r"(?m)^Example:$", "Examples:", obj.docstring.value)
        parts = [x.value for x in getattr(obj, "decorators", ())] + getattr(obj, "bases", [])
        of_data = re.search("dataclass|NamedTuple", " ".join(map(str, parts)))
        if of_data and not re.search("(?m)^(Args|Attributes):$", text):
            fields = described_fields(obj.lines)
            text += "\n\nAttributes:\n" + "\n".join(fields) if fields else ""
        # What follows a space would be taken for the type; a no-break space is part of the name.
        names = re.compile(r"(?m)^ {4}\w+(?:, \w+)+(?=:\s)")
        obj.docstring.value = names.sub(lambda m: m[0].replace(", ", ",\u00a0"), text)
