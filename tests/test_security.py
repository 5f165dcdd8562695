"""A folder from a stranger runs no code, and nothing is written outside it.

Each payload only leaves a mark, a file, which must not appear.
"""

from __future__ import annotations

import contextlib
import importlib
import re
import runpy
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
from tests.runs import SMALL, make_config, run_command
from torch_qpmpc import QPMPC, QPError
from torch_qpmpc.experiment.checkpoint import load_checkpoint
from torch_qpmpc.experiment.config import load_config, settings
from torch_qpmpc.experiment.links import check_links
from torch_qpmpc.experiment.lock import LOCK, locked
from torch_qpmpc.experiment.start import stored_log
from torch_qpmpc.experiment.tasks import TASKS, make_mpc
from torch_qpmpc.export.__main__ import main as export
from torch_qpmpc.files import labelled, save_file, write_whole
from torch_qpmpc.study.report import main as report
from torch_qpmpc.study.runs import FinishedRun

TASK_OF_GYMNASIUM = "task=pendulum", "start=data", "start.transitions=100"


@pytest.fixture(scope="session")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Train a run of the point mass and one of a Gymnasium environment."""
    folder = tmp_path_factory.mktemp("from-a-stranger")
    linear = make_config(*SMALL, "gate=true", "gate_interval=4", "optimizer=gauss_newton")
    train.train(linear, str(folder / "linear"), quiet=True)
    train.train(make_config(*SMALL, *TASK_OF_GYMNASIUM), str(folder / "gym"), quiet=True)
    return folder


@pytest.fixture
def mark(tmp_path: Path) -> Path:
    return tmp_path / "mark"


@pytest.fixture
def folder(runs: Path, tmp_path: Path) -> Path:
    """Copy the run of the point mass."""
    return shutil.copytree(runs / "linear", tmp_path / "runs" / "sweep" / "run")


OWN_TASK = """
from torch_qpmpc.envs import GrosZanonLTI
from torch_qpmpc.experiment.tasks import Task, register
from torch_qpmpc.experiment.tasks.gros_zanon import true_scheme

register(Task("mine", lambda cfg: GrosZanonLTI(), true_scheme))
"""


def change(folder: Path, **changes: object) -> None:
    """Change keys of config.yaml and of the checkpoint, which resuming compares."""
    cfg = OmegaConf.load(folder / "config.yaml")
    state = load_checkpoint(folder / "checkpoint.pt")
    assert isinstance(cfg, DictConfig)
    for key, value in changes.items():
        OmegaConf.update(cfg, key.replace("__", "."), value, force_add=True)
    OmegaConf.save(cfg, folder / "config.yaml")
    state["config"] = settings(cfg)
    torch.save(state, folder / "checkpoint.pt")


def stop(folder: Path) -> None:
    """Make a finished run one that was stopped after its last update."""
    (folder / "summary.json").unlink()


def resume(folder: Path) -> None:
    stop(folder)
    run_command(f"resume={folder}")


COMMANDS: dict[str, Callable[[Path], None]] = {
    "export": lambda folder: export([str(folder)]),
    "report": lambda folder: report([str(folder)]),
    "resume": resume,
}


def script(folder: Path, mark: Path) -> None:
    (folder / "task.py").write_text(f"open({str(mark)!r}, 'w')")
    change(folder, task__name="theirs", task__file=str(folder / "task.py"))


def zipped(folder: Path, mark: Path) -> None:
    """Let a checkpoint be a program, too."""
    program = shutil.copy(folder / "checkpoint.pt", folder / "checkpoint-previous.pt")
    with zipfile.ZipFile(program, "a") as file:
        file.writestr("__main__.py", f"open({str(mark)!r}, 'w')")
    change(folder, task__name="theirs", task__file=str(program))


def module(folder: Path, mark: Path) -> None:
    (folder / "theirs.py").write_text(f"open({str(mark)!r}, 'w')")
    importlib.invalidate_caches()
    sys.modules.pop("theirs", None)
    change(folder, task__id="theirs:Id-v0")


@pytest.mark.parametrize("command", COMMANDS.values(), ids=COMMANDS)
@pytest.mark.parametrize("payload", [script, zipped, module])
def test_code_that_a_configuration_names_does_not_run(
    runs, folder, mark, monkeypatch, payload, command
):
    if payload is module:
        shutil.copytree(runs / "gym", folder, dirs_exist_ok=True)
        (folder / "best.pt").unlink()  # the other run's
    monkeypatch.syspath_prepend(folder)
    payload(folder, mark)
    with contextlib.suppress(SystemExit):
        command(folder)
    assert not mark.exists()


def test_a_script_runs_if_the_command_line_names_it(folder, mark):
    script(folder, mark)
    file = folder / "task.py"
    stop(folder)
    message = (
        f"resume: got {folder}, whose config.yaml names code (task.file='{file}'), expected code "
        "that the command line names, too. Read that code, which may not be yours; to run it: "
        f"python train.py resume={folder} task.file={file}"
    )
    with pytest.raises(SystemExit, match=f"^{re.escape(message)}$"):
        run_command(f"resume={folder}")
    assert not mark.exists()
    with pytest.raises(SystemExit, match=r"task\.file: got .*, which registers no 'theirs', exp"):
        run_command(f"resume={folder}", f"task.file={file}")
    assert mark.exists()


@pytest.mark.parametrize("word", ["task=gros_zanon", "task.file=mine.py", "task=pendulum"])
def test_a_run_that_names_no_code_resumes_alone(folder, word):
    stop(folder)
    with pytest.raises(SystemExit, match=f"^resume: got it together with {word}, expected no oth"):
        run_command(f"resume={folder}", word)


def test_a_module_is_imported_if_the_command_line_names_it(runs, tmp_path, mark, monkeypatch):
    folder = shutil.copytree(runs / "gym", tmp_path / "run")
    monkeypatch.syspath_prepend(folder)
    stop(folder)
    module(folder, mark)
    other = ("task=gymnasium", "task.id=theirs:Other-v0")
    for wrong, named in (((), "names code"), (other, "names other code")):
        message = f"to run it: python train.py resume={folder} task=gymnasium task.id=theirs:Id-v0$"
        with pytest.raises(SystemExit, match=f"{named} .*{message}"):
            run_command(f"resume={folder}", *wrong)
    assert not mark.exists()
    with pytest.raises(SystemExit, match=r"^task\.id: got 'theirs:Id-v0', expected an environment"):
        run_command(f"resume={folder}", "task=gymnasium", "task.id=theirs:Id-v0")
    assert mark.exists()


def test_a_module_in_an_environments_arguments_is_not_imported(runs, tmp_path, mark, monkeypatch):
    """Some environments make another one by its id, as those of shimmy do."""
    folder = shutil.copytree(runs / "gym", tmp_path / "run")
    monkeypatch.syspath_prepend(folder)
    stop(folder)
    module(folder, mark)
    change(folder, task__id="Pendulum-v1", task__kwargs={"env": ["theirs:Id-v0"]})
    message = r"names code \(task.id='Pendulum-v1' with task.kwargs={'env': \['theirs:Id-v0'\]}\)"
    with pytest.raises(SystemExit, match=message):
        run_command(f"resume={folder}")
    assert not mark.exists()


def test_an_own_task_is_exported_and_reported_without_its_code(tmp_path, monkeypatch):
    """From the stored QPs; what takes the plant is left out."""
    monkeypatch.delitem(TASKS, "mine", raising=False)
    file = tmp_path / "mine.py"
    file.write_text(OWN_TASK)
    runpy.run_path(str(file))
    for case in ("free", "mpc"):
        cfg = make_config(*SMALL, "task=mine", f"constraint={case}", "rivals=[]")
        cfg.release = 2 if case == "mpc" else None
        train.train(cfg, str(tmp_path / "runs" / case), quiet=True)
    known = FinishedRun(tmp_path / "runs" / "mpc")
    start = make_mpc(known.cfg, known.physics)
    assert known.has_plant
    assert torch.equal(known.start.C, start.C)

    del TASKS["mine"]
    file.write_text("raise AssertionError")
    run = FinishedRun(tmp_path / "runs" / "mpc")
    assert not run.has_plant
    assert run.true is None
    assert (run.start.structure, run.policy.structure) == (start.structure, "free")
    assert torch.equal(run.start.C, start.C)
    p = torch.ones(1, 2, dtype=torch.float64)
    torch.testing.assert_close(run.policy.policy(p), known.policy.policy(p))
    message = "^task.file: got '.*mine.py', which has not run, expected a script that has registere"
    with pytest.raises(QPError, match=message):
        _ = run.physics
    report([str(tmp_path / "runs")])
    drawn = {path.name for path in (tmp_path / "runs" / "report" / "runs").iterdir()}
    assert drawn == {"learning-none.png", "constraints-none.png"}
    export([str(run.folder)])
    assert (run.folder / "c" / "policy.c").exists()


def test_a_policy_that_is_no_qp_is_not_exported(folder):
    save_file(folder / "best.pt", "network", {"policy": {}})
    message = r"^path: got .*best.pt, a saved network, expected a file that QPMPC.save wrote"
    with pytest.raises(SystemExit, match=message):
        export([str(folder)])


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
    torch.save(labelled("QPMPC", content), folder / name)
    read: Callable[[Path], Any] = {
        "checkpoint.pt": resume,
        "best.pt": COMMANDS["export"],
        "log.pt": lambda folder: stored_log(folder / name),
        "mine.qpmpc": lambda folder: QPMPC.load(folder / name),
    }[name]
    match = (
        rf"^(path|checkpoint|start\.file): got .*{name}, which cannot be read \(UnpicklingError\)"
    )
    with pytest.raises((QPError, SystemExit), match=match):
        read(folder)
    assert not mark.exists()


def test_tags_of_a_configuration_run_no_code(folder, mark):
    with (folder / "config.yaml").open("a") as file:
        file.write(f"more: !!python/object/apply:os.mkdir ['{mark}']\n")
    for command in (COMMANDS["report"], resume):
        with pytest.raises(SystemExit, match=r"config.yaml: got .* \(could not determine a con"):
            command(folder)
    assert not mark.exists()


def test_interpolations_are_not_resolved(folder, monkeypatch):
    monkeypatch.setenv("SECRET", "hunter2")
    file = folder / "config.yaml"
    file.write_text(file.read_text().replace("ablation: null", "ablation: ${oc.env:SECRET}"))
    message = (
        r"^config.yaml: got ablation='\$\{oc.env:SECRET\}' in .*config.yaml, expected values, as "
        r"train.py writes them. Interpolations of a saved configuration are not resolved"
    )
    for command in (COMMANDS["report"], resume):
        with pytest.raises(SystemExit, match=message):
            command(folder)


@pytest.mark.parametrize("text", ["[]", "", "task: 3", "[: x"])
def test_a_configuration_without_settings_is_named(folder, text):
    (folder / "config.yaml").write_text(text)
    with pytest.raises(QPError, match=r"^config.yaml: got .*config.yaml \(.*\), expected the conf"):
        load_config(folder / "config.yaml")


# Links


@pytest.mark.parametrize(
    "name", [LOCK, "train.log", "metrics.csv.partial", "summary.png", "wandb-id.txt", "tensorboard"]
)
def test_a_resumed_run_writes_nothing_through_a_link(folder, tmp_path, name):
    outside = tmp_path / "outside"
    if name == "tensorboard":
        shutil.rmtree(folder / name)
        outside.mkdir()
    elif name != "wandb-id.txt":  # the link to a missing file
        outside.write_text("mine")
    (folder / name).unlink(missing_ok=True)
    (folder / name).symlink_to(outside)
    message = f"^folder: got {folder}/{name}, a symbolic link out of {folder}, expected a folder w"
    with pytest.raises(SystemExit, match=message):
        resume(folder)
    if name == "tensorboard":
        assert not list(outside.iterdir())
    else:
        assert outside.exists() == (name != "wandb-id.txt")
        assert not outside.exists() or outside.read_text() == "mine"


@pytest.mark.parametrize("part", ["c", "report"])
def test_an_export_and_a_report_write_nothing_through_a_link(folder, tmp_path, part):
    outside = tmp_path / "outside"
    outside.mkdir()
    (folder / part).symlink_to(outside)
    with pytest.raises(SystemExit, match=f"^folder: got {folder}/{part}, a symbolic link out of"):
        COMMANDS["export" if part == "c" else "report"](folder)
    assert not list(outside.iterdir())


def test_a_report_writes_no_figure_elsewhere(folder, tmp_path):
    """The noise of a task whose code has not run may have any name."""
    noise = "x/../../../../../../outside"
    change(folder, task__name="theirs", task__file="theirs.py", noise__name=noise)
    (folder / "report" / folder.name / "learning-x").mkdir(parents=True)
    report([str(folder)])
    assert not (tmp_path / "outside.png").exists()
    drawn = {path.name for path in (folder / "report" / folder.name).glob("*.png")}
    assert "learning-x_.._.._.._.._.._.._outside.png" in drawn


def test_links_that_stay_inside_are_allowed(tmp_path):
    (tmp_path / "file").touch()
    (tmp_path / "link").symlink_to("file")
    check_links(tmp_path)
    (tmp_path / "loop").symlink_to("loop")
    with pytest.raises(QPError, match="loop, a symbolic link out of"):
        check_links(tmp_path)


def test_single_writes_do_not_follow_links(tmp_path):
    outside = tmp_path / "outside"
    outside.write_text("mine")
    for name in ("file", "file.partial", "policy.c", "policy.h", "mine.qpmpc", LOCK):
        (tmp_path / name).symlink_to(outside)
    write_whole(tmp_path / "file", b"ours")
    QPMPC(1, 1, 2).save(tmp_path / "mine.qpmpc")
    QPMPC(1, 1, 2, stage_weight=[1.0, 1.0]).export_c(tmp_path)
    with pytest.raises(OSError, match="symbolic links"), locked(tmp_path):
        pass
    assert outside.read_text() == "mine"
    assert (tmp_path / "file").read_bytes() == b"ours"
    assert "real" in (tmp_path / "policy.c").read_text()


# Text


def test_text_of_a_folder_is_escaped(folder, tmp_path, capsys):
    named = folder.parent.rename(folder.parents[1] / "<b>![x](y)\x1b[31m|") / "run"
    second = shutil.copytree(named, named.with_name("second"))
    change(named, ablation="<script>`\x1b]0;x\x07|\n# head $")
    change(second, ablation="other")
    report([str(tmp_path / "runs")])
    pages = [(tmp_path / "runs" / "report" / name).read_text() for name in ("report.md", "runs.md")]
    for text in (capsys.readouterr().out.replace(str(tmp_path), ""), *pages):
        assert not re.search(r"<script|<b>|\x1b|\x07|!\[x\]\(|^# head", text, re.MULTILINE)
        assert "&lt;script&gt;&#96;&#92;x1b]0;x&#92;x07&#124; # head" in text


def test_text_of_an_error_does_not_control_the_terminal():
    assert "\x1b" not in str(QPError.expected("x", "\x1b[2J\u202e", "y"))
    assert r"\x1b[2J\u202e" in str(QPError.expected("x", "\x1b[2J\u202e", "y"))
