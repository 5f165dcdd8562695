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


class Docstrings(griffe.Extension):
    """Read ``Example:`` as doctests, and ``A, B: ..`` as two parameters, which Griffe does not."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        if obj.docstring is None:
            return
        text = re.sub(r"(?m)^Example:$", "Examples:", obj.docstring.value)
        # What follows a space would be taken for the type; a no-break space is part of the name.
        names = re.compile(r"(?m)^ {4}\w+(?:, \w+)+(?=:\s)")
        obj.docstring.value = names.sub(lambda m: m[0].replace(", ", ",\u00a0"), text)
