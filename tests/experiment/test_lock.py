"""One process at a time holds a folder's lock, and a killed process releases it."""

from __future__ import annotations

import errno
import fcntl
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import torch_qpmpc
from torch_qpmpc import QPError
from torch_qpmpc.experiment import lock
from torch_qpmpc.experiment.lock import ELSEWHERE_IN_SWEEP, LOCK, locked

PACKAGE = Path(torch_qpmpc.__file__).parent
#: Imports the lock without the package's ``__init__``, which imports torch for seconds.
HOLD = """
import sys, types
sys.modules["torch_qpmpc"] = package = types.ModuleType("torch_qpmpc")
package.__path__ = [sys.argv[2]]
from torch_qpmpc.experiment.lock import locked
with locked(sys.argv[1]):
    print("held", flush=True)
    input()
"""


def hold(folder: Path) -> subprocess.Popen[str]:
    """Start a process that holds the lock until it reads a line or dies."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(folder), str(PACKAGE)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "held\n"
    return process


def test_a_live_process_is_named_and_a_killed_one_leaves_no_lock(tmp_path):
    process = hold(tmp_path)
    try:
        message = (
            rf"^folder: got {re.escape(str(tmp_path))}, in use by process {process.pid} on .+, "
            r"expected one that no run is using\. Wait until that run has ended, or choose "
            r"another folder with hydra\.run\.dir=FOLDER\.$"
        )
        with pytest.raises(QPError, match=message), locked(tmp_path):
            pass
    finally:
        process.kill()
        process.communicate()
    assert (tmp_path / LOCK).exists(), "the file alone locks nothing"
    with locked(tmp_path):
        pass
    assert not list(tmp_path.iterdir())


def test_a_sweeps_message_names_its_own_setting(tmp_path):
    with (
        locked(tmp_path),
        pytest.raises(QPError, match=r"with hydra\.sweep\.dir=FOLDER\."),
        locked(tmp_path, ELSEWHERE_IN_SWEEP),
    ):
        pass


def test_an_error_inside_frees_the_lock(tmp_path):
    with pytest.raises(KeyboardInterrupt), locked(tmp_path):
        raise KeyboardInterrupt
    with locked(tmp_path):
        assert f"process {os.getpid()} on " in (tmp_path / LOCK).read_text()


def test_a_lock_file_that_was_removed_meanwhile_is_opened_again(tmp_path, monkeypatch):
    """The holder removes the file after this process has opened it."""
    flock, opened = fcntl.flock, []

    def late(file: int, operation: int) -> None:
        opened.append(file)
        if len(opened) == 1:
            (tmp_path / LOCK).unlink()
        flock(file, operation)

    monkeypatch.setattr(fcntl, "flock", late)
    with locked(tmp_path):
        assert len(opened) == 2
        with pytest.raises(QPError, match="in use by process"), locked(tmp_path):
            pass


def test_without_locks_runs_continue(tmp_path, monkeypatch):
    def unsupported(*_: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", unsupported)
    with locked(tmp_path), locked(tmp_path):
        pass
    monkeypatch.setattr(lock, "fcntl", None)
    with locked(tmp_path), locked(tmp_path):
        pass
