"""Lock, signals and errors of a launch, and the text of `python train.py --help`."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import OmegaConf

import train
from tests.runs import CONFIGS, SMALL, choices, compose_config, make_config
from tests.stops import assert_same_numbers, go_on
from torch_qpmpc import QPError
from torch_qpmpc.experiment import evaluation
from torch_qpmpc.experiment.launch import LOCK, Interrupt, launched, locked
from torch_qpmpc.files import load_file
from torch_qpmpc.learning.replay import Replay
from torch_qpmpc.mpc.state import KIND
from torch_qpmpc.qp.pipeline.solve import SolveLog

HOLD = """
import sys
from filelock import FileLock
with FileLock(sys.argv[1]):
    print("held", flush=True)
    input()
"""


def test_a_live_process_holds_the_lock_and_a_killed_one_does_not(tmp_path):
    command = [sys.executable, "-c", HOLD, str(tmp_path / LOCK)]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == "held\n"
        message = f"^folder: got {tmp_path}, in use by another process, .* with KEY.$"
        with pytest.raises(QPError, match=message), locked(tmp_path, "KEY"):
            pass
    finally:
        process.kill()
        process.communicate()
    with pytest.raises(KeyboardInterrupt), locked(tmp_path, "KEY"):
        raise KeyboardInterrupt
    with locked(tmp_path, "KEY"):
        pass


@pytest.mark.parametrize(
    ("error", "sentence"),
    [
        (QPError("seed: got x"), "^seed: got x$"),
        (OSError(28, "No space left"), r"^folder: got .*where writing failed \(.*No space left\)"),
    ],
)
def test_an_error_of_the_user_is_one_sentence(tmp_path, monkeypatch, error, sentence):
    hydra: Any = SimpleNamespace(
        mode=RunMode.RUN,
        runtime=SimpleNamespace(output_dir=str(tmp_path)),
    )
    monkeypatch.setattr(HydraConfig, "get", lambda: hydra)
    with launched() as launch:
        assert launch == (str(tmp_path), False)
        with pytest.raises(QPError, match="in use"), locked(tmp_path, ""):
            pass
    with pytest.raises(SystemExit, match=sentence), launched():
        raise error
    hydra.mode = RunMode.MULTIRUN
    with pytest.raises(type(error), match=str(error.args[-1])), launched():
        raise error


# --- Signals -------------------------------------------------------------------------------------

RUN = (*SMALL, "updates=5", "eval_interval=3", "task.eval_steps=5")


@pytest.fixture
def listening() -> Iterator[None]:
    """Restore Ctrl-C's default handler, which a shell's background jobs and children lack."""
    usual = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, usual)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Finish a run without a signal."""
    folder = tmp_path_factory.mktemp("whole")
    train.train(make_config(*RUN), str(folder), quiet=True)
    return folder


def test_the_first_signal_is_noted_and_the_second_acts(listening):
    with Interrupt() as interrupt:
        signal.raise_signal(signal.SIGINT)
        assert interrupt.signum == signal.SIGINT
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.parametrize(
    ("module", "name", "call", "signum", "said"),
    [
        (train, "make_physics", 1, signal.SIGTERM, "before the first update"),
        (Replay, "extend", 1, signal.SIGINT, "before the first update"),
        (Replay, "extend", 4 + 2, signal.SIGTERM, "after update 2"),
        (train, "save_file", 1, signal.SIGTERM, "after update 3"),
    ],
)
def test_a_run_stops_cleanly_wherever_the_signal_comes(
    tmp_path, monkeypatch, capsys, listening, whole, module, name, call, signum, said
):
    """The signal arrives at start, or while warming up, learning, evaluating or saving."""
    folder = tmp_path / "run"
    with monkeypatch.context() as patch:
        signal_at(patch, module, name, call, signum)
        with pytest.raises(SystemExit) as ended:
            train.train(make_config(*RUN), str(folder))
    assert ended.value.code == 128 + signum
    sentence = f"Stopped {said}: go on with python train.py hydra.run.dir={folder}"
    assert capsys.readouterr().out.splitlines()[-1] == sentence
    assert (folder / "checkpoint.pt").exists() == ("after" in said)
    go_on(folder)
    assert_same_numbers(folder, whole)


def signal_at(patch: Any, module: Any, name: str, call: int, signum: int, times: int = 1) -> None:
    """Send ``signum`` in the given call of a function."""
    function, calls = getattr(module, name), []

    def signalled(*args: Any, **named: Any) -> Any:
        calls.append(name)
        for _ in range(times if len(calls) == call else 0):
            signal.raise_signal(signum)
        return function(*args, **named)

    patch.setattr(module, name, signalled)


def test_a_signal_in_the_last_update_lets_the_run_finish(tmp_path, monkeypatch):
    signal_at(monkeypatch, train, "save_file", 2, signal.SIGTERM)
    assert train.train(make_config(*RUN), str(tmp_path))["updates"] == 5


def test_a_second_ctrl_c_keeps_the_log_and_the_last_checkpoint(tmp_path, monkeypatch, listening):
    signal_at(monkeypatch, SolveLog, "__enter__", 5, signal.SIGINT, times=2)
    with pytest.raises(KeyboardInterrupt):
        train.train(make_config(*RUN), str(tmp_path))
    assert load_file(tmp_path / "checkpoint.pt", KIND)["update"] == 3


def test_one_run_of_a_sweep_leaves_signals_to_its_launcher(tmp_path, monkeypatch, listening):
    signal_at(monkeypatch, evaluation, "evaluate", 1, signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        train.train(make_config(*RUN), str(tmp_path / "run"), quiet=True)
    assert not (tmp_path / "run").exists()


# --- Help ----------------------------------------------------------------------------------------


def help_text() -> str:
    with initialize_config_dir(str(CONFIGS), version_base="1.3"):
        cfg = compose("config", return_hydra_config=True)
    OmegaConf.set_readonly(cfg, False)
    return cfg.hydra.help.template


def test_the_help_fits_on_two_screens_and_lists_every_choice():
    lines = help_text().splitlines()
    assert len(lines) <= 60
    assert max(map(len, lines)) <= 100
    words = {*" ".join(lines).replace(",", " ").replace(";", " ").split()}
    for group in ("constraint", "task", "noise", "optimizer"):
        assert {*choices(group)} <= words, group


def test_the_helps_defaults_are_those_of_the_configuration():
    cfg, text = compose_config(), help_text()
    settings = text[text.index("Keys\n") : text.index("All keys")].splitlines()[1:]
    shown = dict(line.split()[0].split("=", 1) for line in settings if line.strip())
    del shown["hydra.run.dir"]
    words = {True: "true", False: "false", None: "null"}
    for key, value in shown.items():
        x = OmegaConf.select(cfg, key)
        assert value == (words[x] if isinstance(x, bool | None) else str(x)), key
