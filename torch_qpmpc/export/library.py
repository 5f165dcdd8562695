"""Exported C, compiled and loaded into Python."""

from __future__ import annotations

import ctypes
import importlib.util
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from torch_qpmpc.errors import QPError
from torch_qpmpc.export.writer import filled

FLAGS = ("-std=c99", "-O3", "-fPIC", "-shared")


def compiler() -> list[str] | None:
    """Return the command of $CC, cc, gcc, clang or ziglang, the first that exists, else None."""
    command = os.environ.get("CC", "")
    try:
        if named := shlex.split(command):
            return named if shutil.which(named[0]) else None
    except ValueError as error:
        got = f"{command!r}: {error}"
        raise QPError.expected("$CC", got, "a command", "Correct or unset it.") from error
    for name in ("cc", "gcc", "clang"):
        if path := shutil.which(name):
            return [path]
    if importlib.util.find_spec("ziglang"):
        return [sys.executable, "-m", "ziglang", "cc"]
    return None


def required_compiler() -> list[str]:
    """Return the command of a C compiler.

    Raises:
        QPError: there is none.
    """
    if (command := compiler()) is None:
        got, remedy = "none on the PATH", "Install one, or pip install ziglang, which has clang."
        if named := shlex.split(os.environ.get("CC", "")):
            remedy += f" $CC is {' '.join(named)!r}; {named[0]!r} does not exist: unset it."
        raise QPError.expected("compiler", got, "a C compiler: $CC, cc, gcc or clang", remedy)
    return command


class Steps(NamedTuple):
    """The results of one step of each of B controllers.

    Attributes:
        u: the actions, ``(B, n_u)``.
        codes: 0 if solved, 1 if not certified within the limit of iterations, 2 if infeasible, and
            3 if p is invalid, ``(B,)``.
        value, gap, violation, iterations: the costs to go, the bounds on their errors, the largest
            violations of a hard row, and the changes of the active set, ``(B,)``.
    """

    u: np.ndarray
    codes: np.ndarray
    value: np.ndarray
    gap: np.ndarray
    violation: np.ndarray
    iterations: np.ndarray


class Library:
    """The functions of an exported policy, compiled into a shared library.

    Its copies share the functions; a pickle has the source, and is compiled when it is loaded.
    """

    def __init__(
        self, files: Mapping[str, str], name: str, dtype: str, flags: Sequence[str] = ()
    ) -> None:
        flags = tuple(flags or FLAGS)
        self._made_of, self.real = (files, name, dtype, flags), np.dtype(dtype)
        library = compiled({**files, "wrapper_.c": filled("wrapper.c", name)}, flags)
        self._steps = library[f"{name}_steps"]
        self._resets = library[f"{name}_resets"]
        self.selftest = library[f"{name}_selftest"]
        size = library[f"{name}_state_size"]
        size.restype = ctypes.c_ulong
        self.state_bytes = int(size())
        pointer, long = ctypes.c_void_p, ctypes.c_long
        self._steps.argtypes = [pointer] * 5 + [long]
        self._resets.argtypes = [pointer, long]
        reals = [(n, self.real) for n in ("value", "gap", "violation")]
        self._info = np.dtype([*reals, ("iterations", np.int32)], align=True)

    def __deepcopy__(self, memo: dict[int, Any]) -> Library:
        return self

    def __reduce__(self) -> tuple[Any, ...]:
        return Library, self._made_of

    def states(self, count: int) -> np.ndarray:
        """Return the reset states of ``count`` controllers, as bytes."""
        states = np.zeros(count * self.state_bytes, dtype=np.uint8)
        self._resets(states.ctypes.data, count)
        return states

    def multipliers(self, states: np.ndarray, rows: int) -> np.ndarray:
        """Return the multipliers of each controller's last step, ``(count, rows)``."""
        lam = states.reshape(-1, self.state_bytes)[:, : rows * self.real.itemsize]
        return np.ascontiguousarray(lam).view(self.real)

    def steps(self, states: np.ndarray, p: np.ndarray, n_u: int) -> Steps:
        """Step each controller with its p ``(count, n_p)``."""
        p = np.ascontiguousarray(p, dtype=self.real)
        u = np.empty((len(p), n_u), dtype=self.real)
        info, codes = np.empty(len(p), dtype=self._info), np.empty(len(p), dtype=np.int32)
        self._steps(*(x.ctypes.data for x in (states, p, u, info, codes)), len(p))
        return Steps(u, codes, *(info[name] for name in self._info.names or ()))


def written(folder: str | Path, files: Mapping[str, str]) -> tuple[Path, ...]:
    """Write texts by file name into a folder, which may be new; return the paths."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    for file, text in files.items():
        (folder / file).unlink(missing_ok=True)  # may be a link, which would be followed
        (folder / file).write_text(text, encoding="utf-8")
    return tuple(map(folder.joinpath, files))


def built(files: Mapping[str, str], flags: Sequence[str], target: Path) -> Path:
    """Compile files as C, also with a compiler of C++, into the library ``target``.

    Raises:
        QPError: there is no compiler, or it fails.
    """
    command, paths = required_compiler(), written(target.parent, files)
    sources = [str(path) for path in paths if path.suffix == ".c"]
    line = [*command, *flags, f"-I{target.parent}", "-o", str(target), "-x", "c", *sources]
    try:
        ended = subprocess.run(line, capture_output=True, text=True, check=False)
    except OSError as error:
        raise QPError.expected("compiler", f"{error}", "a command that runs") from error
    if ended.returncode:
        got = f"an error of {' '.join(command)}: {ended.stderr.strip()[-500:]}"
        raise QPError.expected("compiler", got, "a compiled policy")
    return target


def compiled(files: Mapping[str, str], flags: Sequence[str]) -> ctypes.CDLL:
    """Compile files as `built` does, and load them."""
    with tempfile.TemporaryDirectory() as folder:
        target = built(files, flags, Path(folder) / "policy.so")
        try:
            return ctypes.CDLL(str(target))
        except OSError as error:
            got = f"{folder}, from which a library does not load: {error}"
            remedy = "Set TMPDIR to another one, as this may be mounted with noexec, or check $CC."
            raise QPError.expected("TMPDIR", got, "a folder of programs", remedy) from error
