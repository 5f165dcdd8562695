"""A folder from a stranger runs no code. Each payload only leaves a mark, which must not appear."""

import contextlib
import importlib
import os
import re
import shutil
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from omegaconf import DictConfig, OmegaConf

import train
from tests.problems import drawn_mpc
from tests.runs import SMALL, make_config, run_command
from torch_qpmpc import QPMPC, QPError, export_c, load_run
from torch_qpmpc.experiment.config import flatten
from torch_qpmpc.experiment.start import stored_log
from torch_qpmpc.files import VERSION, load_file, write_whole
from torch_qpmpc.mpc.state import KIND
from torch_qpmpc.study.report import main as report

LINEAR = ("gate=true", "gate_interval=4")


@pytest.fixture(scope="session")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("from-a-stranger")
    gym = ("task=pendulum", "start=data", "start.transitions=100")
    for name, more in (("linear", LINEAR), ("gym", gym)):
        train.train(make_config(*SMALL, *more), str(folder / name), quiet=True)
    return folder


@pytest.fixture
def mark(tmp_path: Path) -> Path:
    return tmp_path / "mark"


@pytest.fixture
def folder(runs: Path, tmp_path: Path) -> Path:
    return shutil.copytree(runs / "linear", tmp_path / "runs" / "sweep" / "run")


def change(folder: Path, **changes: object) -> None:
    """Change keys of config.yaml and of the checkpoint, which resuming compares."""
    cfg, state = OmegaConf.load(folder / "config.yaml"), load_file(folder / "checkpoint.pt", KIND)
    assert isinstance(cfg, DictConfig)
    for key, value in changes.items():
        OmegaConf.update(cfg, key.replace("__", "."), value, force_add=True)
    OmegaConf.save(cfg, folder / "config.yaml")
    settings = flatten(OmegaConf.to_container(cfg, resolve=True))
    torch.save(state | {"config": settings}, folder / "checkpoint.pt")


def resume(folder: Path) -> None:
    (folder / "summary.json").unlink(missing_ok=True)
    run_command(*SMALL, *LINEAR, f"hydra.run.dir={folder}")


COMMANDS: dict[str, Callable[[Path], object]] = {
    "learned": lambda folder: load_run(folder).policy,
    "report": lambda folder: report([str(folder)]),
    "plant": lambda folder: load_run(folder).physics,
    "resume": resume,
}


def script(folder: Path, mark: Path) -> None:
    program = shutil.copy(folder / "checkpoint.pt", folder / "checkpoint-previous.pt")
    with zipfile.ZipFile(program, "a") as file:
        file.writestr("__main__.py", f"open({str(mark)!r}, 'w')")
    (folder / "task.py").write_text(f"open({str(mark)!r}, 'w')")
    change(folder, task__name="theirs", task__file=str(program))


def module(folder: Path, mark: Path) -> None:
    (folder / "theirs.py").write_text(f"open({str(mark)!r}, 'w')")
    importlib.invalidate_caches()
    sys.modules.pop("theirs", None)
    change(folder, task__id="theirs:Id-v0")


@pytest.mark.parametrize(
    "keys",
    [
        {"id": "theirs:"},
        {"id": "theirs:-x"},
        {"id": "Pendulum-v1", "kwargs": {"env": "theirs:"}},
        {"id": "Pendulum-v1", "kwargs": {"env": "${task.name}:x", "name": "theirs"}},
        {"id": "${oc.env:THEIRS}:Id-v0"},
    ],
)
def test_whatever_a_module_is_followed_by_it_is_not_imported(
    runs, tmp_path, mark, monkeypatch, keys
):
    """Gymnasium imports what stands before a colon, before it reads the rest."""
    folder = shutil.copytree(runs / "gym", tmp_path / "run")
    monkeypatch.syspath_prepend(folder)
    monkeypatch.setenv("THEIRS", "theirs")
    module(folder, mark)
    change(folder, **{f"task__{key}": value for key, value in keys.items()})
    with pytest.raises(QPError):
        _ = load_run(folder).physics
    assert not mark.exists()


@pytest.mark.parametrize(
    ("payload", "command"),
    [(script, "learned"), (module, "report"), (script, "resume"), (module, "plant")],
)
def test_code_that_a_configuration_names_does_not_run(
    runs, folder, mark, monkeypatch, payload, command
):
    if payload is module:
        shutil.copytree(runs / "gym", folder, dirs_exist_ok=True)
    monkeypatch.syspath_prepend(folder)
    payload(folder, mark)
    with contextlib.suppress(SystemExit, QPError):
        COMMANDS[command](folder)
    assert not mark.exists()


def test_the_code_of_the_command_line_runs_before_a_folder_is_compared(folder, mark):
    script(folder, mark)
    file = folder / "task.py"
    change(folder, task__file=str(file))
    with pytest.raises(
        SystemExit, match=r"holds a run with task\.name=theirs, task\.file=.*, expect"
    ):
        resume(folder)
    assert not mark.exists()
    with pytest.raises(SystemExit, match=r"task\.file: got .*, which registers none, exp"):
        run_command(f"task.file={file}", f"hydra.run.dir={folder}")
    assert mark.exists()


def test_a_number_of_the_summary_is_not_evaluated(folder, mark):
    """A report chooses runs by seed."""
    file = folder / "summary.json"
    code = f"@pd.io.common.os.mkdir('{mark}')"
    file.write_text(file.read_text().replace('"seed": 1', f'"seed": "{code}"'))
    with contextlib.suppress(Exception, SystemExit):
        report([str(folder)])
    assert not mark.exists()


class Payload:
    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> tuple:
        return open, (str(self.mark), "w")


@pytest.mark.parametrize("name", ["checkpoint.pt", "best.pt", "log.pt", "mine.qpmpc"])
def test_pickles_run_no_code(folder, mark, name):
    content = {"action": torch.zeros(3, 1), "mpc": Payload(mark)}
    torch.save({"kind": "QPMPC", "version": VERSION, **content}, folder / name)
    read: dict[str, Callable[[Path], Any]] = {
        "checkpoint.pt": resume,
        "best.pt": COMMANDS["learned"],
        "log.pt": lambda folder: stored_log(folder / name),
        "mine.qpmpc": lambda folder: QPMPC.load(folder / name),
    }
    with pytest.raises((QPError, SystemExit), match=rf"{name}, .* read \(UnpicklingError\)"):
        read[name](folder)
    assert not mark.exists()


@pytest.mark.parametrize("command", [COMMANDS["report"], resume])
def test_tags_run_no_code_and_interpolations_are_not_resolved(folder, mark, monkeypatch, command):
    monkeypatch.setenv("SECRET", "hunter2")
    file = folder / "config.yaml"
    text = file.read_text()
    file.write_text(f"{text}more: !!python/object/apply:os.mkdir ['{mark}']\n")
    with pytest.raises(SystemExit, match=r"config.yaml: got .* \(could not determine a con"):
        command(folder)
    assert not mark.exists()
    file.write_text(text.replace("ablation: null", "ablation: ${oc.env:SECRET}"))
    message = r"^config.yaml: got .* \(ablation is an interpolation: write its value\)"
    with pytest.raises(SystemExit, match=message):
        command(folder)


def test_files_are_written_beside_their_links_targets(tmp_path):
    outside = tmp_path / "outside"
    outside.write_text("mine")
    for name in ("file", "file.partial", "policy.c", "policy.h", "mine.qpmpc"):
        (tmp_path / name).symlink_to(outside)
    write_whole(tmp_path / "file", b"ours")
    os.mkfifo(tmp_path / "pipe")
    for other in (tmp_path / "pipe", tmp_path):
        with pytest.raises(FileExistsError, match="is no file, and is left as it is"):
            write_whole(other, b"ours")
    mpc = drawn_mpc(1, 1, 2, stage_weight=[1.0, 1.0])
    mpc.save(tmp_path / "mine.qpmpc")
    export_c(mpc, tmp_path)
    assert outside.read_text() == "mine"
    assert (tmp_path / "file").read_bytes() == b"ours"


def test_text_of_a_folder_is_escaped(folder, tmp_path, capsys):
    named = folder.parent.rename(folder.parents[1] / "<b>![x](y)\x1b[31m|") / "run"
    second = shutil.copytree(named, named.with_name("second"))
    theirs = {"task__name": "theirs", "task__file": "theirs.py", "noise__name": "x/../../outside"}
    change(named, ablation="<script>`\x1b]0;x\x07|\n# head $", **theirs)
    change(second, ablation="other")
    (tmp_path / "runs" / "report" / named.parent.name / "learning-x").mkdir(parents=True)
    report([str(tmp_path / "runs")])
    assert not [*tmp_path.rglob("outside.png")]
    page = tmp_path / "runs" / "report" / "report.md"
    for text in (capsys.readouterr().out.replace(str(tmp_path), ""), page.read_text()):
        assert not re.search(r"<script|<b>|\x1b|\x07|!\[x\]\(|^# head", text, re.MULTILINE)
        assert "&#60;script&#62;" in text
    assert "\x1b" not in str(QPError.expected("x", "\x1b[2J\u202e", "y"))
