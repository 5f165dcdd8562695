"""Lock, Ctrl-C and errors of a launch, and the text of `python train.py --help`."""

import contextlib
import logging
import signal
import subprocess
import sys
from types import SimpleNamespace
from typing import Any

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import OmegaConf

from tests.runs import CONFIGS, SMALL, choices, compose_config, run_command
from tests.stops import interrupt
from torch_qpmpc import QPError
from torch_qpmpc.experiment.launch import LOCK, launched, locked
from torch_qpmpc.files import load_file
from torch_qpmpc.mpc.state import KIND

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
        mode=RunMode.RUN, runtime=SimpleNamespace(output_dir=str(tmp_path))
    )
    monkeypatch.setattr(HydraConfig, "get", lambda: hydra)
    captured: list[bool] = []
    monkeypatch.setattr(logging, "captureWarnings", captured.append)
    with launched() as launch:
        assert launch == (str(tmp_path), False)
        with pytest.raises(QPError, match="in use"), locked(tmp_path, ""):
            pass
        assert captured == [True]  # train.log gets warnings
    assert captured == [True, False]
    with pytest.raises(SystemExit, match=sentence), launched():
        raise error
    hydra.mode = RunMode.MULTIRUN
    with pytest.raises(type(error), match=str(error.args[-1])) as raised, launched():
        raise error
    assert raised.value.__notes__ == [f"The run is that of {tmp_path}."]


def test_ctrl_c_stops_at_once_and_names_the_command_that_goes_on(tmp_path, monkeypatch, capsys):
    overrides = (*SMALL, "updates=5", "eval_interval=3", "task.eval_steps=5")
    interrupt(monkeypatch, update=5)
    folder = f"hydra.run.dir={tmp_path}/my run"
    with pytest.raises(SystemExit) as ended:
        run_command(*overrides, folder)
    assert ended.value.code == 128 + signal.SIGINT
    said = f"\nStopped: go on with python train.py {' '.join(overrides)} '{folder}'\n"
    assert capsys.readouterr().out.endswith(said)
    assert load_file(tmp_path / "my run" / "checkpoint.pt", KIND)["update"] == 3


def test_sigterm_stops_a_run_whatever_a_library_makes_of_it(tmp_path, monkeypatch):
    """Compiled code makes a SystemError of it."""

    def raised(*_: Any, **__: Any) -> None:
        with contextlib.suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGTERM)
        raise SystemError

    monkeypatch.setattr("train.train", raised)
    with pytest.raises(SystemExit) as ended:
        run_command(*SMALL, f"hydra.run.dir={tmp_path}")
    assert ended.value.code == 128 + signal.SIGTERM
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


def test_ctrl_c_is_left_to_the_launcher_of_a_sweep(tmp_path, monkeypatch):
    interrupt(monkeypatch, update=1)
    with pytest.raises(KeyboardInterrupt):
        run_command("-m", "hydra/launcher=basic", *SMALL, f"hydra.sweep.dir={tmp_path}")


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
