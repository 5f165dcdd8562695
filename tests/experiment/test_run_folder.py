"""A run's folder holds everything that was logged, also if the run is interrupted."""

from __future__ import annotations

import errno
import json
import math
import os
import re
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from matplotlib.figure import Figure
from omegaconf import OmegaConf
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from tests.runs import CONFIGS, SMALL, make_config, run_command
from torch_qpmpc import QPError
from torch_qpmpc.experiment.checkpoint import load_checkpoint
from torch_qpmpc.experiment.config import flatten
from torch_qpmpc.experiment.run_folder import RunFolder, read_metrics, unwritable


def events(folder: Path) -> EventAccumulator:
    found = EventAccumulator(str(folder / "tensorboard"), size_guidance={"scalars": 0, "images": 0})
    found.Reload()
    return found


def scalars(found: EventAccumulator, tag: str) -> dict[int, float]:
    return {event.step: event.value for event in found.Scalars(tag)}


def a_figure() -> Figure:
    figure = Figure(figsize=(2, 1))
    figure.subplots().plot([0, 1], [1, 0])
    return figure


def test_folder_has_everything_logged(tmp_path):
    cfg = make_config("seed=7")
    with RunFolder(tmp_path / "new" / "run", cfg) as run:
        for update in range(1, 301):
            run.log({"loss/value": 1 / update, "train/reward": -update}, update)
            if update % 100 == 0:
                run.log({"eval/J": 1000.0 - update}, update)
        run.figure("structure/C", a_figure(), 300)
        run.finish({"J_final": 700.0, "closed_gap": 0.5, "seed": 7, "constraint": "combined"})
    folder = tmp_path / "new" / "run"
    assert run.path == folder.resolve()
    assert OmegaConf.load(folder / "config.yaml") == OmegaConf.create(
        OmegaConf.to_container(cfg, resolve=True)
    )

    table: Any = read_metrics(folder)
    assert list(table.index) == list(range(1, 301)), "one row for an update"
    assert list(table.columns) == ["loss/value", "train/reward", "eval/J"]
    assert table["loss/value"][7] == 1 / 7, "to the last digit"
    assert table["eval/J"].dropna().to_dict() == {100: 900.0, 200: 800.0, 300: 700.0}

    found = events(folder)
    assert {"loss/value", "train/reward", "eval/J"} <= set(found.Tags()["scalars"])
    assert len(found.Scalars("loss/value")) == 300, "TensorBoard lost none"
    assert scalars(found, "eval/J") == {100: 900.0, 200: 800.0, 300: 700.0}
    assert found.Tags()["images"] == ["structure/C"]
    assert found.Images("structure/C")[0].step == 300

    text = found.Tensors("config/text_summary")[0].tensor_proto.string_val[0].decode()
    assert "seed: 7" in text
    assert "damping: 0.03" in text
    assert scalars(found, "hparam/J_final") == {0: 700.0}
    assert scalars(found, "hparam/closed_gap") == {0: 0.5}
    plugin = found.SummaryMetadata("_hparams_/session_start_info").plugin_data.content
    for key in flatten(OmegaConf.to_container(cfg)):
        assert key.encode() in plugin, key

    summary = json.loads((folder / "summary.json").read_text())
    assert summary == {"J_final": 700, "closed_gap": 0.5, "seed": 7, "constraint": "combined"}


def test_summary_is_strict_json(tmp_path):
    with RunFolder(tmp_path, make_config()) as run:
        run.finish({"closed_gap": math.nan, "J_start": 1.5, "rivals": {"zero action": math.inf}})

    def refuse(constant):
        raise AssertionError(constant)

    text = (tmp_path / "summary.json").read_text()
    summary = json.loads(text, parse_constant=refuse)
    assert summary == {"closed_gap": None, "J_start": 1.5, "rivals": {"zero action": None}}


@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError])
def test_the_log_survives_an_interruption(tmp_path, error):
    def interrupted() -> None:
        with RunFolder(tmp_path, make_config()) as run:
            for update in range(1, 20):
                run.log({"eval/J": float(update)}, update)
            raise error

    threads = threading.active_count()
    with pytest.raises(error):
        interrupted()
    assert threading.active_count() == threads, "the writer's thread has ended"
    assert pd.read_csv(tmp_path / "metrics.csv")["eval/J"].tolist() == list(range(1, 20))
    assert len(events(tmp_path).Scalars("eval/J")) == 19
    assert not (tmp_path / "summary.json").exists(), "there is none of half a run"


def test_metrics_are_there_during_the_run(tmp_path):
    with RunFolder(tmp_path, make_config()) as run:
        run.log({"eval/J": 3.0}, 1)
        run.flush()
        assert pd.read_csv(tmp_path / "metrics.csv")["eval/J"].tolist() == [3.0]
        assert scalars(events(tmp_path), "eval/J") == {1: 3.0}
        assert not list(tmp_path.glob("*.partial"))


def test_column(tmp_path):
    with RunFolder(tmp_path, make_config()) as run:
        for update in (0, 5, 10):
            run.log({"loss/value": 0.0}, update)
            if update != 5:
                run.log({"eval/J": 2.0 * update}, update)
        assert run.column("eval/J") == ([0, 10], [0.0, 20.0])
        assert run.column("eval/none") == ([], [])


def test_relative_folder_is_kept_when_the_working_directory_changes(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with RunFolder("run", make_config()) as run:
        (tmp_path / "elsewhere").mkdir()
        monkeypatch.chdir(tmp_path / "elsewhere")
        run.log({"eval/J": 1.0}, 1)
    assert (tmp_path / "run" / "metrics.csv").exists()
    assert scalars(events(tmp_path / "run"), "eval/J") == {1: 1.0}


# --- Resuming ------------------------------------------------------------------------------------

ROWS = "update,eval/J\n0,3.0\n2,2.0\n4,1.0\n"


@pytest.mark.parametrize(
    ("text", "wrong"),
    [
        (None, r"\[Errno 2\] No such file or directory"),
        ("", "its last line is cut off"),
        (ROWS[:-3], "its last line is cut off"),
        (ROWS[:-6], "no row for update 4"),
        (ROWS[:14], "no row for update 0, 2, 4"),
        ("some,table\n1,2\n", ".*'update' not found in columns"),
        (ROWS.replace("2.0", "two"), "could not convert string to float: 'two'"),
        (ROWS.replace("2.0", "2.0,7,8"), "Error tokenizing data"),
        (ROWS + ROWS[14:], "its updates do not increase"),
    ],
)
def test_a_run_does_not_resume_from_damaged_metrics(tmp_path, text, wrong):
    cfg = make_config("eval_interval=2", "log_interval=4")
    if text is not None:
        (tmp_path / "metrics.csv").write_text(text)
    sentence = (
        rf"^metrics\.csv: got {re.escape(str(tmp_path))}/metrics\.csv \({wrong}.*\), "
        r"expected the table that a run wrote\. Restore the file, resume from a copy of the "
        r"folder, or start a new run with hydra\.run\.dir=FOLDER\.$"
    )
    with pytest.raises(QPError, match=sentence):
        RunFolder(tmp_path, cfg, after=4)
    assert not (tmp_path / "tensorboard").exists(), "nothing has been written"


def test_later_rows_are_dropped_on_resume(tmp_path):
    (tmp_path / "metrics.csv").write_text(ROWS + "6,0.5\n")
    with RunFolder(tmp_path, make_config("eval_interval=2", "log_interval=4"), after=4) as run:
        assert run.column("eval/J") == ([0, 2, 4], [3.0, 2.0, 1.0])


# --- Faults --------------------------------------------------------------------------------------


def command(folder: Path, *more: str) -> subprocess.CompletedProcess[str]:
    """Run train.py in ``folder`` with files limited to 1000 bytes after the first checkpoint."""
    limited = (
        "import resource, sys, train\n"
        "save = train.save_checkpoint\n"
        "def limit(*given):\n"
        "    save(*given)\n"
        "    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))\n"
        "train.save_checkpoint = limit\n"
        "train.main()\n"
    )
    arguments = ["--config-path", str(CONFIGS), *SMALL, "task.eval_steps=5"]
    return subprocess.run(
        [sys.executable, "-c", limited, *arguments, f"hydra.run.dir={folder}", *more],
        cwd=CONFIGS.parent,
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )


@pytest.mark.slow
def test_a_full_disk_ends_in_a_sentence_and_keeps_the_last_checkpoint(tmp_path):
    ended = command(tmp_path / "run")
    assert ended.returncode == 1
    sentence = ended.stderr.splitlines()[-1]
    assert re.match(
        r"folder: got .*/run, where writing failed \(.*File too large.*\), exp", sentence
    )
    assert sentence.endswith(f"free space, then python train.py resume={tmp_path / 'run'}.")
    assert "Traceback" not in ended.stderr
    assert load_checkpoint(tmp_path / "run" / "checkpoint.pt")["update"] == 2
    assert not list((tmp_path / "run").glob("*.partial"))


def test_a_failed_write_is_reported(tmp_path):
    error = unwritable(tmp_path, OSError(errno.EROFS, "Read-only file system", "x.csv"))
    assert str(error) == (
        f"folder: got {tmp_path}, where writing failed ([Errno 30] Read-only file system: 'x.csv')"
        ", expected a writable folder. Choose another folder with hydra.run.dir=FOLDER."
    )


@pytest.mark.parametrize("mode", [("run",), ("sweep", "-m")], ids=lambda mode: mode[0])
def test_a_folder_that_cannot_be_made_ends_in_a_sentence(tmp_path, mode):
    key, *multirun = mode
    (tmp_path / "file").touch()
    sentence = (
        r"^folder: got .*/file/run, where writing failed \(.*Not a directory.*\), "
        r"expected a writable folder\. "
        rf"Choose another folder with hydra\.{key}\.dir=FOLDER\.$"
    )
    with pytest.raises(SystemExit, match=sentence):
        run_command(*multirun, f"hydra.{key}.dir={tmp_path}/file/run")


@pytest.mark.parametrize("name", ["config.yaml", "metrics.csv", "summary.json"])
def test_a_file_is_as_it_was_when_writing_fails(tmp_path, monkeypatch, name):
    with RunFolder(tmp_path, make_config()) as run:
        run.log({"eval/J": 1.0}, 1)
        run.finish({"J_final": 1.0})
    before = (tmp_path / name).read_bytes()

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"), RunFolder(tmp_path, make_config()) as run:
        run.finish({"J_final": 2.0})
    assert (tmp_path / name).read_bytes() == before
    assert not list(tmp_path.glob("*.partial"))
