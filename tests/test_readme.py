"""The documentation's examples run: README.md's Python and every docstring's example."""

from __future__ import annotations

import doctest
import importlib
import json
import os
import pkgutil
import re
import subprocess
import sys
from pathlib import Path

import pytest

import torch_qpmpc
from tests.runs import SMALL
from torch_qpmpc.experiment.tasks import TASKS

README = Path(__file__).parents[1] / "README.md"
MODULES = sorted(
    module.name for module in pkgutil.walk_packages(torch_qpmpc.__path__, "torch_qpmpc.")
)


def python_blocks(text: str) -> list[tuple[int, str]]:
    """List the fenced Python blocks, each with its first line's number."""
    fence = re.compile(r"^```python[^\n]*\n(.*?)^```", re.DOTALL | re.MULTILINE)
    return [(text.count("\n", 0, m.start(1)), m.group(1)) for m in fence.finditer(text)]


def test_blocks_are_found():
    text = "a\n```bash\nls\n```\n```python\nx = 1\n```\nb\n```python title\ny = 2\n\nz = 3\n```\n"
    assert python_blocks(text) == [(5, "x = 1\n"), (9, "y = 2\n\nz = 3\n")]


@pytest.mark.skipif(not README.exists(), reason="README.md is not there, as in a wheel's tests")
def test_readme_runs(tmp_path, monkeypatch):
    """Run all blocks in one session, as a reader would paste them."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delitem(TASKS, "pole", raising=False)  # monkeypatch also removes it afterwards
    blocks = python_blocks(README.read_text(encoding="utf-8"))
    assert blocks, "README.md shows no Python"
    namespace: dict[str, object] = {"__name__": "readme"}
    for line, code in blocks:
        # Leading blank lines give tracebacks README.md's line numbers.
        exec(compile("\n" * line + code, str(README), "exec"), namespace)


@pytest.mark.skipif(not README.exists(), reason="README.md is not there, as in a wheel's tests")
def test_the_readmes_own_task_trains(tmp_path):
    """Run the script as a sweep, whose runs are separate processes."""
    blocks = [code for _, code in python_blocks(README.read_text(encoding="utf-8"))]
    (script,) = (code for code in blocks if "register(" in code)
    (tmp_path / "my_task.py").write_text(script, encoding="utf-8")
    small = (*SMALL, "task.horizon=10", "figures=false", "hydra.launcher.n_jobs=2")
    command = [sys.executable, "my_task.py", "-m", "task=pole", "seed=1,2", *small]
    ended = subprocess.run(
        [*command, "hydra.sweep.dir=sweep"],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(README.parent)},
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert ended.returncode == 0, ended.stderr
    summary = json.loads((tmp_path / "sweep/none-deviation-seed2/summary.json").read_text())
    assert (summary["task"], summary["seed"], summary["updates"]) == ("pole", 2, 4)
    assert summary["J_true_model"] < summary["J_start"]


@pytest.mark.skipif(not README.exists(), reason="README.md is not there, as in a wheel's tests")
def test_every_test_named_in_the_readme_exists():
    text = README.read_text(encoding="utf-8")
    table = text.split("<!-- pytorch -->")[1].split("<!-- /pytorch -->")[0]
    named = re.findall(r"\[(test_\w+)\]\((tests/[\w/]+\.py)\)", table)
    assert len(named) == table.count("](") > 20
    for test, path in named:
        source = (README.parent / path).read_text(encoding="utf-8")
        assert f"\ndef {test}(" in source, f"{path}::{test}"


@pytest.mark.parametrize("name", ["torch_qpmpc", *MODULES])
def test_docstrings_run(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    results = doctest.testmod(
        importlib.import_module(name),
        optionflags=doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS,
    )
    assert results.failed == 0, f"{results.failed} of {results.attempted} examples of {name}"


PUBLIC = [getattr(torch_qpmpc, name) for name in torch_qpmpc.__all__]


@pytest.mark.parametrize("public", PUBLIC, ids=lambda x: x.__name__)
def test_public_names_are_documented(public):
    assert public.__module__.startswith("torch_qpmpc")
    assert len((public.__doc__ or "").strip().splitlines()[0]) > 20
