"""The tables of Q-learning beside its rivals, on made-up costs, and one short run."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from tests.benchmarks import improvement
from tests.benchmarks.improvement import CASES, COSTS, Case, compared
from tests.runs import SMALL
from torch_qpmpc.experiment.config import check_config

CASE = "Pendulum"


def row(seed: int, learned: float) -> dict[str, object]:
    costs = dict(zip(COSTS, (20.0, 10.0 + seed, 12.5, learned, 6.0, 5.0), strict=True))
    return {"case": CASE, "seed": seed, **costs, "transitions": 3000}


ROWS = pd.DataFrame([row(seed, 7.0 + 2 * seed) for seed in (1, 2, 3)])


@pytest.mark.parametrize("case", CASES)
def test_every_case_is_a_valid_configuration(case):
    check_config(improvement.configuration(CASES[case], seed=1))


def test_learning_is_compared_with_the_best_without_it():
    costs, outcome = improvement.comparison(ROWS).split("\n\n")
    *_, line = costs.splitlines()
    assert line == f"| {CASE} | 20.00 | 12.00 | 12.50 | 11.00 | 6.000 | 5.000 |"
    *_, line = outcome.splitlines()
    # 9, 11 and 13 beside 11, 12 and 12.5.
    assert line == f"| {CASE} | 13.00 | 0.14 | 2 of 3 | 0.250 | 3,000 |"


def test_a_small_gap_has_no_share():
    learned, fair = np.array([9.0, 9.5]), np.array([10.0, 10.0])
    assert compared(learned, fair, fair - 1.0)[0] == "0.75"
    assert compared(learned, fair, fair - 0.05)[0] == ""
    assert compared(learned, fair, np.full(2, np.nan))[0] == ""


def test_a_finished_run_is_not_repeated_and_fills_the_page(tmp_path, monkeypatch):
    short = (*SMALL, "start.transitions=200", "task=pendulum", "rivals=[identification]")
    monkeypatch.setitem(CASES, CASE, Case(short))
    page, results = tmp_path / "page.md", tmp_path / "rows.csv"
    page.write_text("<!-- improvement -->\n\n<!-- /improvement -->\n")
    arguments = ["--cases", CASE, "--seeds", "7"]
    arguments += ["--page", str(page), "--results", str(results)]
    improvement.main(arguments)
    first = results.read_text()
    assert len(first.splitlines()) == 2
    assert "| 0 of 1 |" in page.read_text() or "| 1 of 1 |" in page.read_text()
    improvement.main(arguments)
    assert results.read_text() == first
