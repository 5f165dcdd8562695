"""A lock on a run's folder, so that only one process writes to it."""

from __future__ import annotations

import contextlib
import os
import socket
from collections.abc import Iterator
from pathlib import Path

from torch_qpmpc.errors import QPError

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

#: The locked file. The operating system releases the lock of a killed process.
LOCK = ".lock"

#: Settings that choose another folder: for a single run, and for a sweep.
ELSEWHERE, ELSEWHERE_IN_SWEEP = "hydra.run.dir=FOLDER", "hydra.sweep.dir=FOLDER"


@contextlib.contextmanager
def locked(folder: str | Path, elsewhere: str = ELSEWHERE) -> Iterator[None]:
    """Hold the lock on ``folder`` inside a ``with`` block.

    Platforms without ``fcntl`` and file systems without locks do not lock.

    Args:
        folder: a run's existing folder.
        elsewhere: the setting that chooses another folder, for the message.

    Raises:
        QPError: another run holds the lock.
        OSError: the lock file cannot be written.
    """
    path = Path(folder) / LOCK
    file = None if fcntl is None else _acquire(path, elsewhere)
    try:
        yield
    finally:
        if file is not None:
            # Unlink before unlocking: a process that has opened the old file then retries.
            with contextlib.suppress(OSError):
                path.unlink()
            os.close(file)


def _acquire(path: Path, elsewhere: str) -> int | None:
    """Open and lock ``path``; return its descriptor, or None if the file system has no locks."""
    assert fcntl is not None
    while True:
        file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666)
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            owner = os.read(file, 1000).decode(errors="replace") or "another process"
            os.close(file)
            remedy = f"Wait until that run has ended, or choose another folder with {elsewhere}."
            got = f"{path.parent}, in use by {owner}"
            raise QPError.expected("folder", got, "one that no run is using", remedy) from None
        except OSError:
            os.close(file)
            return None
        if _is_at(path, file):
            break
        os.close(file)
    with contextlib.suppress(OSError):  # on a full disk, the owner remains unnamed
        os.truncate(file, 0)
        os.write(file, f"process {os.getpid()} on {socket.gethostname()}".encode())
    return file


def _is_at(path: Path, file: int) -> bool:
    """Return False if another run has removed ``path`` since it was opened as ``file``."""
    try:
        return os.path.samestat(os.fstat(file), path.stat())
    except FileNotFoundError:
        return False
