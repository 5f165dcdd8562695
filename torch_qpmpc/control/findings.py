"""The findings of a review, as text and as pages."""

from __future__ import annotations

import base64
import html
from collections.abc import Mapping
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PAGE = """<!doctype html>
<meta charset="utf-8">
<title>Review of a controller</title>
<style>
body {{ font-family: sans-serif; max-width: 60em; margin: 2em auto }}
td, th {{ text-align: left; vertical-align: top; padding: 0.2em 1em 0.2em 0 }}
img {{ max-width: 100% }}
</style>
<h1>Review of a controller</h1>
<table>
<tr><th>Finding</th><th></th><th>Numbers</th><th>Remedy</th></tr>
{table}
</table>
{images}
"""


@dataclass(frozen=True)
class Finding:
    """One question to a design.

    Attributes:
        name: the subject, such as ``"stability"``.
        ok: False if it is a fault.
        numbers: the answer, by name.
        remedy: what mends the fault; empty if it is none.
    """

    name: str
    ok: bool
    numbers: Mapping[str, Any]
    remedy: str = ""

    @property
    def text(self) -> str:
        """The numbers in words."""
        return "; ".join(f"{key} {_number(x)}" for key, x in self.numbers.items())


@dataclass(frozen=True)
class Review:
    """The findings about a controller; ``print`` shows them.

    Attributes:
        findings: all of them; those that need a definite cost or a stable loop only with one.
    """

    findings: list[Finding] = field(default_factory=list)

    @property
    def faults(self) -> list[Finding]:
        """The findings that are not ok."""
        return [finding for finding in self.findings if not finding.ok]

    def __getitem__(self, name: str) -> Finding:
        return {finding.name: finding for finding in self.findings}[name]

    def __str__(self) -> str:
        lines = [f"{len(self.faults)} faults in {len(self.findings)} findings"]
        for finding in self.findings:
            lines.append(f"{'ok   ' if finding.ok else 'FAULT'} {finding.name}: {finding.text}")
            lines += [f"      {finding.remedy}"] * (not finding.ok)
        return "\n".join(lines)

    def to_html(self, path: str | Path, *figures: Figure) -> None:
        """Write a page with a table of the findings and ``figures`` below it, such as a `Run`'s.

        It is one file, and loads nothing from elsewhere.

        Raises:
            OSError: writing failed.
        """
        rows = [(x.name, "ok" if x.ok else "fault", x.text, x.remedy) for x in self.findings]
        table = "\n".join(
            "<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>"
            for row in rows
        )
        images = []
        for figure in figures:
            figure.savefig(buffer := BytesIO(), format="png")
            data = base64.b64encode(buffer.getvalue()).decode()
            images.append(f'<img alt="" src="data:image/png;base64,{data}">')
        Path(path).write_text(PAGE.format(table=table, images="\n".join(images)), encoding="utf-8")


def _number(x: Any) -> str:
    if isinstance(x, np.ndarray):
        return "[" + ", ".join(f"{y:.4g}" for y in x.ravel()) + "]"
    return x if isinstance(x, str) else f"{x:.4g}"
