"""The evaluation of identified schemes on short episodes, and its table on made-up costs."""

from __future__ import annotations

from tests.benchmarks.identified import CASES, SCALES, Case, case_table, evaluated, logs


def test_each_log_has_a_cost_of_each_structure_and_a_picture(tmp_path):
    short = ("task=four_tanks", "task.horizon=6", "task.eval_steps=30", *logs(1, 300))
    found = evaluated(Case("Set point", short, "tanks"), [1, 2], tmp_path)
    assert {name for name, costs in found.items() if len(costs) == 2} == {
        *("from_data, free C", "from_data, tied C", "DeePC")
    }
    assert len(found["true model"]) == len(found["omniscient"]) == 1
    assert (tmp_path / "tanks.png").exists()


def test_each_case_has_the_scale_of_its_task():
    for page, cases in CASES.items():
        assert page in ("house", "tanks")
        assert all(case.configured().task.name in SCALES for case in cases)


def test_the_table_has_medians_extremes_and_ratios():
    found = {"omniscient": [2.0], "from_data": [3.0, 2.5, 9.0]}
    _, _, first, second = case_table("Room", found, "omniscient").splitlines()
    assert first == "| omniscient | 2.000 |  |  | 1.000 |"
    assert second == "| from_data | 3.000 | 2.500 | 9.000 | 1.500 |"
