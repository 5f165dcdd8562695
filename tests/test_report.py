from __future__ import annotations

import json
import sys

import pytest

from torch_qpmpc import QPError, report


def write_runs(folder, gaps):
    for (noise, constraint, seed), gap in gaps.items():
        run = folder / f"{noise}-{constraint}" / str(seed)
        run.mkdir(parents=True)
        summary = {"noise": noise, "constraint": constraint, "seed": seed, "closed_gap": gap}
        summary |= {"J_start": 285.04, "J_final": 50.0, "J_true_model": 46.97, "unsolved": 0}
        (run / "summary.json").write_text(json.dumps(summary | {"train_seconds": 3.21}))


@pytest.fixture
def runs(tmp_path):
    gaps = {("gaussian", "free", seed): 0.9 + seed / 100 for seed in (1, 2, 5)}
    gaps |= {("gaussian", "fixed", 1): -0.2, ("brownian", "free", 1): 0.8}
    write_runs(tmp_path, gaps)
    return tmp_path


def test_every_run_is_a_row_in_the_papers_order(runs):
    frame = report.collect(runs)
    assert list(zip(frame["noise"], frame["constraint"], frame["seed"], strict=True)) == [
        ("brownian", "free", 1),
        ("gaussian", "fixed", 1),
        ("gaussian", "free", 1),
        ("gaussian", "free", 2),
        ("gaussian", "free", 5),
    ]
    assert "| gaussian | fixed | 1 | 285.0 | 50.0 | 47.0 | -0.2 | 0 | 3.2 |" in report.runs_table(
        frame
    )


def test_cases_show_median_and_range(runs):
    table = report.cases_table(report.collect(runs))
    assert "| free | 0.80 (0.80 to 0.80) | 0.92 (0.91 to 0.95) |" in table
    assert "| fixed | - | -0.20 (-0.20 to -0.20) |" in table


def test_the_command_prints_both_tables(runs, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["report", str(runs)])
    report.main()
    printed = capsys.readouterr().out
    assert "J_true_model" in printed
    assert "over seeds [1, 2, 5]" in printed


def test_a_folder_without_runs_is_named(tmp_path, monkeypatch):
    with pytest.raises(QPError, match=r"RUNS_FOLDER: got .* without a finished run"):
        report.collect(tmp_path)
    monkeypatch.setattr(sys, "argv", ["report", str(tmp_path)])
    with pytest.raises(SystemExit, match="without a finished run"):
        report.main()
