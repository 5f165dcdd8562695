"""The tables and the figure of the comparison with networks, on made-up costs."""

from __future__ import annotations

from pathlib import Path

from tests.benchmarks import networks
from tests.benchmarks.networks import CASES, TABLES, budgets_table, costs, figure, read, seeds_table
from tests.runs import SMALL, make_config, run_command
from torch_qpmpc.experiment.config import check_config

QP = {1: {5: 9.0, 10: 4.0}, 2: {5: 7.0, 10: 6.0}}
TD3 = {1: {100: 7.0, 900: 5.0, 1000: 8.0}, 2: {100: 6.0, 900: 6.0, 1000: 6.0}}
COMPARED = {"QP": QP, "TD3": TD3}


def test_every_case_is_a_valid_configuration_and_every_task_has_a_table():
    assert list(CASES) == list(TABLES)
    for cases in CASES.values():
        for overrides in cases.values():
            check_config(make_config(*overrides))


def test_budgets_have_medians_extremes_and_the_seeds_that_reach_the_first_case():
    _, _, qp, td3 = budgets_table(COMPARED).splitlines()
    assert qp == "| QP | 5.000 [4.000, 6.000] |  |  |"
    assert td3 == "| TD3 |  | 7.000 [6.000, 8.000] | 1 of 2, after 900 |"


def test_seeds_have_the_last_cost_of_each():
    _, _, qp, td3 = seeds_table(COMPARED).splitlines()
    assert qp == "| QP | 5.000 | 4.000 | 6.000 |"
    assert td3 == "| TD3 | 7.000 | 8.000 | 6.000 |"


def test_the_figure_has_a_line_for_each_case():
    (axes,) = figure({"point_mass": COMPARED}).axes
    assert [line.get_label() for line in axes.lines] == ["QP", "TD3"]


def test_costs_are_those_of_the_evaluations_of_a_finished_run(tmp_path):
    run_command(*SMALL, "rivals=false", f"hydra.run.dir={tmp_path}")
    seeds, transitions, J = zip(*costs(tmp_path), strict=True)
    assert seeds == (1, 1, 1)
    assert transitions == (16, 24, 32)  # 4 environments, each with 4 steps of warm-up
    assert all(cost > 0 for cost in J)


def test_curves_are_read_by_task_case_and_seed(tmp_path):
    file = tmp_path / "networks.csv"
    file.write_text("task,case,seed,transitions,J\npoint_mass,QP,1,5,9\npoint_mass,QP,1,10,4\n")
    assert read(file) == {"point_mass": {"QP": {1: {5: 9.0, 10: 4.0}}}}


def test_runs_replace_their_seeds_and_all_others_stay_in_the_file(tmp_path, monkeypatch):
    file = tmp_path / "networks.csv"
    before = {
        "point_mass": {"QP": {1: {5: 9.0}, 2: {5: 8.0}}},
        "pendulum": {"network by TD3": {1: {5: 7.0}}},
    }
    monkeypatch.setattr(
        networks,
        "costs",
        lambda folder: [(2, 8, 3.0)] if folder.parts[-2:] == ("point_mass", "QP") else [],
    )
    networks.write(networks.update(before, Path("runs")), file)
    found = read(file)
    assert found["pendulum"] == before["pendulum"]
    assert found["point_mass"] == {"QP": {1: {5: 9.0}, 2: {8: 3.0}}}
