"""A run's folder holds everything that was logged, also if the run is interrupted."""

import errno
import json
import math
import os
import re
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import train
from tests.runs import SMALL, make_config
from torch_qpmpc import QPError
from torch_qpmpc.experiment.run_folder import RunFolder, read_config, read_metrics, unwritable
from torch_qpmpc.files import load_file, save_file
from torch_qpmpc.mpc.state import KIND

PAGE = Path(__file__).parents[2] / "docs" / "guides" / "runs.md"


def test_folder_has_everything_logged(tmp_path, monkeypatch):
    cfg = make_config("seed=7")
    monkeypatch.chdir(tmp_path)
    with RunFolder("run", cfg) as run:
        monkeypatch.chdir("/")  # as a plant may do
        for update in range(1, 301):
            run.log({"loss/value": 1 / update, "train/reward": -update}, update)
            if update % 100 == 0:
                run.log({"eval/J": 1000.0 - update}, update)
        assert run.column("eval/J") == ([100, 200, 300], [900.0, 800.0, 700.0])
        run.finish({"J_final": 700.0, "closed_gap": math.nan, "rivals": {"zero": math.inf}})
    folder = tmp_path / "run"
    assert read_config(folder) == cfg
    table: Any = read_metrics(folder)
    assert list(table.index) == list(range(1, 301)), "one row for an update"
    assert list(table.columns) == ["loss/value", "train/reward", "eval/J"]
    assert table["loss/value"][7] == 1 / 7, "to the last digit"
    events = EventAccumulator(str(folder / "tensorboard"), size_guidance={"scalars": 0})
    events.Reload()
    assert len(events.Scalars("loss/value")) == 300, "TensorBoard lost none"
    assert "NaN" not in (folder / "summary.json").read_text(), "it is strict JSON"
    summary = json.loads((folder / "summary.json").read_text())
    assert summary == {"J_final": 700, "closed_gap": None, "rivals": {"zero": None}}


@pytest.mark.skipif(not PAGE.exists(), reason="no docs, as in a wheel's tests")
def test_the_page_names_each_scalar_file_and_key_of_the_summary(tmp_path):
    more = ("optimizer=gauss_newton", "gate=true", "constraint=combined", "figures=true")
    summary = train.train(make_config(*SMALL, *more), str(tmp_path), quiet=True)
    names = {*re.findall(r"`([\w./-]+)`", PAGE.read_text(encoding="utf-8"))}
    for scalar in read_metrics(tmp_path).columns:
        assert scalar in names or scalar.startswith(("theta/", "eval/J_")), scalar
    for file in tmp_path.iterdir():
        assert {file.name, f"{file.name}/"} & names, file.name
    for key in summary:
        assert key in names or key.startswith("J_discounted_"), key


# --- Resuming and faults -------------------------------------------------------------------------

ROWS = "update,eval/J\n0,3.0\n2,2.0\n4,1.0\n"


@pytest.mark.parametrize(
    ("text", "wrong"),
    [
        (None, r"\[Errno 2\] No such file or directory"),
        (ROWS[:-3], "its last line is cut off"),
        ("some,table\n1,2\n", ".*'update' not found in columns"),
        (ROWS.replace("2.0", "two"), "could not convert string to float: 'two'"),
    ],
)
def test_a_run_does_not_resume_from_damaged_metrics(tmp_path, text, wrong):
    cfg = make_config("eval_interval=2", "log_interval=4")
    if text is not None:
        (tmp_path / "metrics.csv").write_text(text)
    with pytest.raises(QPError, match=rf"^metrics\.csv: got .*/metrics\.csv \({wrong}.*\), expect"):
        RunFolder(tmp_path, cfg, after=4)
    assert not (tmp_path / "tensorboard").exists(), "nothing has been written"


def test_later_rows_are_dropped_on_resume(tmp_path):
    (tmp_path / "metrics.csv").write_text(ROWS + "6,0.5\n")
    with RunFolder(tmp_path, make_config("eval_interval=2", "log_interval=4"), after=4) as run:
        assert run.column("eval/J") == ([0, 2, 4], [3.0, 2.0, 1.0])


def test_a_failed_write_is_reported(tmp_path):
    error = OSError(errno.EROFS, "Read-only file system", "x.csv")
    with pytest.raises(QPError, match=r"writing failed .* folder. Choose another folder with hydr"):
        raise unwritable(tmp_path, error)
    (tmp_path / "checkpoint.pt").touch()
    with pytest.raises(QPError, match=f"then repeat the command with hydra.run.dir={tmp_path}.$"):
        raise unwritable(tmp_path, error)


@pytest.mark.parametrize("name", ["config.yaml", "metrics.csv", "summary.json", "checkpoint.pt"])
def test_a_file_is_as_it_was_when_writing_fails(tmp_path, monkeypatch, name):
    for update in (1, 2):  # the second checkpoint takes the first one's place
        save_file(tmp_path / "checkpoint.pt", KIND, {"update": update})
    with RunFolder(tmp_path, make_config()) as run:
        run.log({"eval/J": 1.0}, 1)
        run.finish({"J_final": 1.0})
    before = (tmp_path / name).read_bytes()

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"), RunFolder(tmp_path, make_config()) as run:
        run.finish({"J_final": 2.0})
    with pytest.raises(OSError, match="No space left"):
        save_file(tmp_path / "checkpoint.pt", KIND, {"update": 3})
    assert (tmp_path / name).read_bytes() == before
    assert not list(tmp_path.glob("*.partial"))
    assert load_file(tmp_path / "checkpoint.pt", KIND)["update"] == 2


def test_the_log_survives_an_interruption(tmp_path):
    run = RunFolder(tmp_path, make_config())
    run.log({"eval/J": 3.0}, 1)
    run.flush()
    assert pd.read_csv(tmp_path / "metrics.csv")["eval/J"].tolist() == [3.0]
    run.log({"eval/J": 2.0}, 2)
    with pytest.raises(KeyboardInterrupt), run:
        raise KeyboardInterrupt
    assert pd.read_csv(tmp_path / "metrics.csv")["eval/J"].tolist() == [3.0, 2.0]
    assert not (tmp_path / "summary.json").exists(), "there is none of half a run"


def test_damage_of_a_checkpoint_is_named_or_changes_nothing(tmp_path):
    path, refused = tmp_path / "checkpoint.pt", []
    save_file(path, KIND, {"C": torch.arange(99.0)})
    whole = path.read_bytes()
    # All bytes of the archive's directory at the end, and some of the rest.
    positions = sorted({*range(0, len(whole), 61), *range(len(whole) - 300, len(whole))})
    for position in positions:
        data = bytearray(whole)
        data[position] ^= 1 << 7
        path.write_bytes(data)
        try:
            found = load_file(path, KIND)
        except QPError as error:
            refused.append(str(error))
        else:
            assert torch.equal(found["C"], torch.arange(99.0)), position
    assert len(refused) > len(positions) / 4
    assert all("which cannot be read" in sentence for sentence in refused)
    for content in (whole[: len(whole) // 2], whole[:-5], b"", b"not a checkpoint"):
        path.write_bytes(content)
        with pytest.raises(QPError, match=r"path: got .*checkpoint.pt, which cannot be read"):
            load_file(path, KIND)
    path.unlink()
    with pytest.raises(QPError, match=r"path: got .*checkpoint.pt, which does not exist"):
        load_file(path, KIND)
