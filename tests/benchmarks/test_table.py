"""The tables' formatting, on results made up."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from tests.benchmarks.table import REFERENCE, main
from torch_qpmpc import QPError

BEGIN, END = "<!-- benchmark -->", "<!-- /benchmark -->"


def _result(test: str, seconds: float, **extra: Any) -> dict[str, Any]:
    return {"name": f"{test}[case]", "stats": {"median": seconds}, "extra_info": extra}


@pytest.fixture
def results(tmp_path: Path) -> Path:
    right = {"value_error": 1e-12, "wrong": 0, "solved": 64, "gradient_error": 1e-9}
    wrong = right | {"value_error": 2e-5, "wrong": 17}
    sizes = {"dense": True, "batch": 4, "dimensions": [4, 2]}
    benchmarks = [
        _result("test_gradient", 0.4, row=REFERENCE, dense=True, batch=32, **wrong),
        _result(
            "test_gradient", 0.002, row="daqp", dense=True, batch=32, reference_seconds=0.3, **right
        ),
        *(
            _result("test_value", 1e-6 * N**2, row="daqp", horizon=N, **sizes, **right)
            for N in (10, 20, 40)
        ),
        _result("test_share_outside_the_solver", 1, row="daqp", batch=256, outside=0.25),
        _result("test_decisions", 0.001, row="daqp", batch=32),
    ]
    machine = {
        "cpu": {"count": 2, "brand_raw": "a processor"},
        "python_version": "3.11.1",
        "versions": {"torch": "2.13"},
    }
    path = tmp_path / "results.json"
    path.write_text(json.dumps({"machine_info": machine, "benchmarks": benchmarks}))
    return path


def test_the_tables_replace_text_between_the_markers(results: Path, tmp_path: Path) -> None:
    page = tmp_path / "benchmarks.md"
    page.write_text(f"above\n{BEGIN}\nold\n{END}\nbelow\n")
    for _ in range(2):
        main(["--json", str(results), "--page", str(page)])
    text = page.read_text()
    assert text.startswith(f"above\n{BEGIN}\n\n")
    assert text.endswith(f"{END}\nbelow\n")
    assert "old" not in text
    assert f"| {REFERENCE} | 400 | 2e-05, 17 of 64 wrong | 1e-09 |" in text
    assert "| daqp | 2.00 (150x) | 1e-12 | 1e-09 |" in text
    assert "| daqp, dense C, (4, 2) | 0.0250 | 0.100 | 0.400 | 2.0 |" in text
    assert "| daqp | 25% | 32,000 |" in text
    assert "2 cores (a processor" in text
    assert "torch 2.13" in text


def test_a_page_without_markers_is_refused(results: Path, tmp_path: Path) -> None:
    page = tmp_path / "benchmarks.md"
    page.write_text("nothing\n")
    with pytest.raises(QPError, match=f"expected one line {BEGIN} and below it one line {END}"):
        main(["--json", str(results), "--page", str(page)])
