"""Run README.md's Python examples, block after block, with the torch_qpmpc that is installed.

python .github/readme_examples.py, from a folder without the package's sources.
"""

import re
import sys
from pathlib import Path

import torch_qpmpc

README = Path(__file__).parents[1] / "README.md"

if README.parent in Path(torch_qpmpc.__file__).parents:
    sys.exit(f"expected an installed torch_qpmpc, got the sources: {torch_qpmpc.__file__}")
blocks = re.findall(r"^```python[^\n]*\n(.*?)^```", README.read_text("utf-8"), re.DOTALL | re.M)
if not blocks:
    sys.exit("README.md shows no Python")
namespace = {"__name__": "readme"}
for block in blocks:
    exec(compile(block, str(README), "exec"), namespace)
print(f"{len(blocks)} examples ran with {torch_qpmpc.__file__}")
