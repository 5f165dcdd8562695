import json
import shutil

import pytest

import train
from tests.benchmarks import paper
from tests.experiment.conftest import store_task  # noqa: F401 - a fixture
from tests.runs import SMALL, make_config
from tests.study.tables import made_up
from torch_qpmpc.study import report
from torch_qpmpc.study.runs import collect


def test_a_case_is_a_row_with_median_interval_and_both_ends():
    frame = made_up({("gaussian", "free"): [0.9] * 6 + [0.1], ("brownian", "si"): [0.5]})
    *_, free, si = report.cases_table(frame).splitlines()
    ends = "285.0 to 50.00 (46.97)"
    errors = "0.400 | 1.00 | 0.050 to 0.080 (2 of 7)"
    assert free == f"| free, gaussian | 0.900 [0.900, 0.900] (6 of 7) | {ends} | {errors} |"
    assert si == f"| si, brownian | - (0 of 1) | {ends} | 0.100 | 1.00 | 0.050 to 0.020 (1 of 1) |"


def test_a_loop_that_is_unstable_with_the_true_plant_is_said_to_be():
    frame = made_up({("gaussian", "free"): [0.9] * 3})
    frame.loc[1, "radius"] = 1.217
    assert "(2 of 3); 1 unstable: 1.217 |" in report.cases_table(frame)


def test_fewer_than_six_runs_have_a_range():
    frame = made_up({("gaussian", case): [0.7, 0.9, 0.8, 0.1] for case in report.CASES})
    assert "| 0.800 (range of 3: 0.700 to 0.900) (3 of 4) |" in report.cases_table(frame)
    assert report.overall(frame).endswith("noise 0.800 (range of 12: 0.700 to 0.900).")


def test_the_overall_gap_weighs_the_learned_cases_equally():
    gaps = {"free": 0.9, "deviation": 0.8, "si": 1.0, "combined": 0.9, "fixed": -3.0}
    frame = made_up({("gaussian", case): [gap] * 7 for case, gap in gaps.items()})
    text = report.overall(frame)
    # Each case is a stratum without spread, so the interval has zero width.
    assert text.endswith("four cases that learn C: gaussian noise 0.900 [0.900, 0.900].")
    assert report.overall(frame.query("label != 'si'")) == ""


def test_the_command_writes_every_table_and_figure(study, tmp_path, capsys):
    page = tmp_path / "paper.md"
    page.write_text(f"# A\n<!-- {study.name} -->\nold\n<!-- /{study.name} -->\nend\n")
    report.main([str(study)])
    paper.main([str(study), "--page", str(page)])

    printed, frame = capsys.readouterr().out, collect(study)  # the report's folder is not a run
    whole = (study / "report" / "report.md").read_text()
    for name, sweep in frame.groupby("sweep"):
        table = report.cases_table(sweep)
        assert all(table in text for text in (printed, whole, page.read_text()))
        figures = {f"{x}-{y}.png" for x in ("learning", "constraints") for y in {*sweep["noise"]}}
        figures |= {"meaning.png"}
        assert {path.name for path in (study / "report" / str(name)).iterdir()} == figures
        assert all(f"]({name}/{figure})" in whole for figure in figures)
    assert "old" not in page.read_text()
    assert page.read_text().endswith(f"<!-- /{study.name} -->\nend\n")
    assert (tmp_path / f"{study.name}.png").exists()


@pytest.mark.usefixtures("store_task")
def test_a_report_of_runs_with_previews(tmp_path):
    settings = ("task=store", "constraint=free", "task.eval_steps=5")
    train.train(make_config(*SMALL, *settings), str(tmp_path / "free"), quiet=True)
    frame = collect(tmp_path)
    start = frame["run"].iloc[0].start
    assert (start.n_x, start.n_d) == (2, 2)
    assert frame["zeros_above"].item() < 1
    assert "nan to nan (0 of 1)" in report.write(frame, tmp_path / "report")
    drawn = {path.name for path in (tmp_path / "report" / tmp_path.name).iterdir()}
    assert drawn == {"learning-none.png", "constraints-none.png"}


def test_many_settings_have_no_figure_side_by_side():
    frame = made_up({("gaussian", f"combined, c_2={i}"): [0.9, 0.8] for i in range(9)})
    assert not list(report.figures(frame))


def test_a_report_has_runs_with_missing_numbers(study, tmp_path, capsys):
    """A summary writes null for what is not finite, and may have entries of other programs."""
    run = next((study / "weights").rglob("summary.json")).parent
    copy = shutil.copytree(run, tmp_path / "sweep" / "run")
    summary = json.loads((copy / "summary.json").read_text())
    missing = ("J_best", "J_start", "J_true_model", "closed_gap", "canonical_distance")
    nulls = dict.fromkeys(missing) | {"proof": "proved"}
    (copy / "summary.json").write_text(json.dumps(summary | nulls))
    report.main([str(tmp_path)])
    assert "nan" in capsys.readouterr().out


def test_errors_are_one_line(tmp_path):
    with pytest.raises(SystemExit, match="without a finished run"):
        report.main([str(tmp_path)])
