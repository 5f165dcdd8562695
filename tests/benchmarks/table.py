"""What the benchmarks' tables share."""

import math
from pathlib import Path

from torch_qpmpc.study.markdown import table, write_section

__all__ = ["DOCS", "PAGE", "ROOT", "significant", "table", "write_section"]

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGE = DOCS / "benchmarks.md"


def significant(x: float) -> str:
    """Format three significant digits below a hundred, whole numbers above."""
    if x >= 100:
        return f"{int(float(f'{x:.3g}')):,}"
    return f"{x:.{max(0, 2 - math.floor(math.log10(x)))}f}"
