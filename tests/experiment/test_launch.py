"""Errors of a launch: one sentence for users' errors, a traceback for others.

test_train.py and test_sweeps.py test the folders and the lock.
"""

from __future__ import annotations

import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode

from torch_qpmpc import QPError
from torch_qpmpc.experiment.launch import launched
from torch_qpmpc.experiment.lock import LOCK


@pytest.fixture
def hydra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Set Hydra's configuration to a single run in ``tmp_path``."""
    hydra: Any = SimpleNamespace(
        mode=RunMode.RUN,
        runtime=SimpleNamespace(output_dir=str(tmp_path)),
        overrides=SimpleNamespace(task=["seed=2"]),
    )
    monkeypatch.setattr(HydraConfig, "get", lambda: hydra)
    return hydra


def test_a_launch_has_the_folder_and_its_lock(hydra, tmp_path):
    with launched() as launch:
        assert (launch.folder, launch.overrides, launch.sweep) == (str(tmp_path), ["seed=2"], False)
        assert (tmp_path / LOCK).exists()
    assert not (tmp_path / LOCK).exists()


@pytest.mark.parametrize(
    ("error", "sentence"),
    [
        (QPError("seed: got x"), "^seed: got x$"),
        (OSError(28, "No space left"), r"^folder: got .*where writing failed \(.*No space left\)"),
    ],
)
def test_an_error_of_the_user_is_one_sentence(hydra, error, sentence):
    with pytest.raises(SystemExit, match=sentence), launched():
        raise error
    hydra.mode = RunMode.MULTIRUN
    with pytest.raises(type(error), match=str(error.args[-1])), launched():
        raise error


@pytest.mark.parametrize("error", [OSError("disk"), ValueError("bug")])
def test_a_threads_error_is_printed_unless_the_run_raises_it(hydra, monkeypatch, error):
    """The hook of before sees the other errors, and is back after the run."""
    seen = []

    def before(args: threading.ExceptHookArgs) -> None:
        seen.append(args.exc_value)

    def fail() -> None:
        raise error

    def run_thread() -> None:
        thread = threading.Thread(target=fail)
        thread.start()
        thread.join()

    monkeypatch.setattr(threading, "excepthook", before)
    with launched():
        run_thread()
    assert seen == ([error] if isinstance(error, ValueError) else [])
    with pytest.raises(SystemExit), launched():
        raise QPError("seed: got x")
    assert threading.excepthook is before
