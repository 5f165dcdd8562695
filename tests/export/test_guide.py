"""The C of the guide compiles with its own Makefile line, and runs."""

import shutil
import subprocess
from pathlib import Path

import pytest

from tests.pages import PAGES, fenced
from torch_qpmpc.export.library import compiler

PAGE = "docs/guides/export.md"
pytestmark = [
    pytest.mark.skipif(PAGE not in PAGES, reason="no docs, as in a wheel's tests"),
    pytest.mark.skipif(compiler() is None or not shutil.which("make"), reason="no compiler"),
]


def test_the_program_of_the_guide_controls_its_plant(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    namespace: dict[str, object] = {}
    exec(fenced(PAGES[PAGE], "python")[0][1], namespace)
    folder = Path("c")
    (program,), (makefile,) = (fenced(PAGES[PAGE], language) for language in ("c", "make"))
    assert len(program[1].splitlines()) <= 22
    (folder / "main.c").write_text(program[1])
    (folder / "Makefile").write_text(makefile[1])
    flags = "CFLAGS=-Wall -Wextra -Werror"
    subprocess.run(["make", "-C", "c", "main", flags], check=True, capture_output=True)
    ended = subprocess.run(["c/main"], check=True, capture_output=True, text=True)
    name, position, *_ = ended.stdout.split()
    assert name == "position"
    assert abs(float(position.rstrip(","))) < 0.2
