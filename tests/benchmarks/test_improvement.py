"""The tables of what learning adds, on made-up costs, and one short run."""

from __future__ import annotations

import pandas as pd
import pytest

from tests.benchmarks import improvement
from tests.benchmarks.improvement import CASES, FIELDS, METHOD_CASES, METHODS, WAYS, Case
from tests.runs import SMALL
from torch_qpmpc.experiment.config import check_config

TANKS = "Four tanks, identified"


def row(way: str, seed: int, best: float, case: str = TANKS) -> dict[str, object]:
    counts = {"transitions": 100, "simulated": 20, "accepted": 1, "rejected": 2, "seconds": 3.0}
    ends = {"start": 10.0, "best": best, "final": best, "true model": 5.0, "reference": 4.0}
    return {"case": case, "way": way, "seed": seed, **ends, **counts}


ROWS = pd.DataFrame(
    [row(way, seed, 2 * seed + k) for k, way in enumerate(WAYS) for seed in (1, 2, 3)]
)


PAIRS = [(case, way) for case in CASES for way in WAYS]
PAIRS += [(case, way) for case in METHOD_CASES for way in METHODS]


@pytest.mark.parametrize(("case", "way"), PAIRS)
def test_every_case_is_a_valid_configuration(case, way):
    check_config(improvement.configuration(case, way, seed=1))


def test_outcomes_are_relative_to_the_start():
    *_, line = improvement.outcome_table(ROWS).splitlines()
    cells = [cell.strip() for cell in line.strip("|").split("|")]
    assert cells[:3] == [TANKS, "3", "10.00"]
    assert cells[3] == "40.0 (range of 3: 20.0 to 60.0), 60.0"
    assert cells[4] == "50.0 (range of 3: 30.0 to 70.0), 70.0"


def test_gaps_are_those_of_the_default():
    costs, effort = improvement.reference_table(ROWS).split("\n\n")
    *_, line = costs.splitlines()
    assert line == f"| {TANKS} | 10.00 | 5.000 | 5.000 | 4.000 | 1.00 | 0.83 |"
    *_, line = effort.splitlines()
    assert line == f"| {TANKS} | 100 | 20 | 3 of 9 |"


def test_a_start_as_good_as_the_other_controller_leaves_no_gap():
    rows = ROWS.assign(**{"true model": 10.0})
    costs, _ = improvement.reference_table(rows).split("\n\n")
    *_, line = costs.splitlines()
    cells = [cell.strip() for cell in line.strip("|").split("|")]
    assert cells[3:7] == ["10.00", "4.000", "", "0.83"]


def test_methods_have_their_median_and_worst_seed():
    method = next(iter(METHODS))
    rows = pd.concat([ROWS, pd.DataFrame([row(method, seed, seed) for seed in (1, 2)])])
    head, _, line = improvement.method_table(rows).splitlines()
    names, numbers = ([cell.strip() for cell in x.strip("|").split("|")] for x in (head, line))
    assert numbers[0] == TANKS
    cells = dict(zip(names, numbers, strict=True))
    # The third seed has no run of the method.
    assert cells["seeds"] == "2"
    assert cells["Q-learning"] == "30.0 (range of 2: 20.0 to 40.0), 40.0"
    assert cells["default"] == "40.0 (range of 2: 30.0 to 50.0), 50.0"
    assert cells[method] == "15.0 (range of 2: 10.0 to 20.0), 20.0"
    assert not any(cells[way] for way in METHODS if way != method)


def test_a_finished_run_is_not_repeated_and_fills_the_page(tmp_path, monkeypatch):
    short = ("task=four_tanks", *SMALL, "start.transitions=200")
    monkeypatch.setitem(CASES, TANKS, Case(short))
    page, results = tmp_path / "page.md", tmp_path / "rows.csv"
    empty = "".join(f"<!-- {x} -->\n\n<!-- /{x} -->\n" for x in ("improvement", "methods"))
    page.write_text(empty)
    arguments = ["--cases", TANKS, "--ways", "Q-learning", "--seeds", "7"]
    arguments += ["--page", str(page), "--results", str(results)]
    improvement.main(arguments)
    first = results.read_text()
    assert first.splitlines()[0] == ",".join(FIELDS)
    assert len(first.splitlines()) == 2
    assert f"| {TANKS} | 1 |" in page.read_text()
    improvement.main(arguments)
    assert results.read_text() == first
