"""The notebooks run with small settings, and their stored outputs are small."""

import ast
import contextlib
import io
import json
import logging
import subprocess
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import matplotlib
import matplotlib.pyplot as plt
import pytest

from tests.runs import run_command
from torch_qpmpc.proofs import invariant

ROOT = Path(__file__).parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
#: Environment variables that shorten the notebooks.
SMALL = {"UPDATES": "2", "SEEDS": "1", "DAYS": "1"}
#: Settings that shorten the runs of train.py.
SHORT = ("rivals=false", "gate=false")

in_a_process = subprocess.run
pytestmark = pytest.mark.skipif(not NOTEBOOKS, reason="no notebooks, as in a wheel's tests")


def cells(path: Path) -> list[dict[str, Any]]:
    notebook = json.loads(path.read_text(encoding="utf-8"))
    return [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]


def run(command: list[str], **options: Any) -> Any:
    """Run ``python -m torch_qpmpc.train ..`` in this process and shortly, others as they are."""
    if command[1:3] != ["-m", "torch_qpmpc.train"]:
        return in_a_process(command, **options)
    with contextlib.redirect_stdout(io.StringIO()) as stdout:
        run_command(*command[3:], *SHORT)
    return SimpleNamespace(stdout=stdout.getvalue())


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_runs(path, monkeypatch):
    """Cell by cell in this process, which has imported everything."""
    for name, value in SMALL.items():
        monkeypatch.setenv(name, value)
    # Of the candidates of an invariant set, which take 20 seconds, the first; none is proved.
    for name in ("SCALES", "GAINS"):
        monkeypatch.setattr(invariant, name, (1.0,))
    monkeypatch.chdir(path.parent)
    monkeypatch.setattr(subprocess, "run", run)
    namespace: dict[str, Any] = {"__name__": path.stem}
    try:
        with matplotlib.rc_context():
            for number, cell in enumerate(cells(path), 1):
                source = "".join(line for line in cell["source"] if not line.startswith("%"))
                exec(compile(source, f"{path.name}, cell {number}", "exec"), namespace)
    finally:
        plt.close("all")
        logging.disable(logging.NOTSET)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_what_a_notebook_imports_exists(path):
    code = "".join(
        line for cell in cells(path) for line in (*cell["source"], "\n") if line[:1] != "%"
    )
    tree = ast.parse(code)
    tree.body = [x for x in tree.body if isinstance(x, ast.Import | ast.ImportFrom)]
    assert tree.body
    exec(compile(tree, path.name, "exec"), {"__name__": path.stem})


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_keeps_its_outputs_and_they_are_small(path):
    text, code = path.read_text(encoding="utf-8"), cells(path)
    counts = [cell["execution_count"] for cell in code]
    assert counts == list(range(1, len(code) + 1)), "run from the first cell to the last"
    assert any(cell["outputs"] for cell in code)
    assert len(text) < 400_000
    assert str(ROOT) not in text
