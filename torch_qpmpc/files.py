"""Files of tensors and plain values: written atomically, and read without running code."""

import io
import os
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torch_qpmpc.errors import QPError

#: Where a wheel has its copies of train.py and configs/; in a clone they are beside the package.
PACKAGED = Path(__file__).with_name("command")
#: The version of the format that `save_file` writes and `load_file` reads.
VERSION = 3
#: What to do about a damaged file of a run.
RESTORE = "Restore the file, or move the run's folder elsewhere."


def write_whole(path: Path, data: bytes | memoryview) -> None:
    """Write ``data`` to ``path`` atomically; a symbolic link is replaced, not followed."""
    partial = path.with_name(f"{path.name}.partial")
    if path.exists() and not (path.is_file() or path.is_symlink()):  # such as a device
        raise FileExistsError(f"{path} is no file, and is left as it is.")
    try:
        partial.unlink(missing_ok=True)
        with partial.open("xb") as file:  # a new file: no link is followed
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def read_tensors(path: Path) -> Any:
    """Read tensors and plain values; a damaged file raises an error of any type."""
    with zipfile.ZipFile(path) as file:  # torch.load does not verify checksums
        if damaged := file.testzip():
            raise zipfile.BadZipFile(damaged)
    return torch.load(path, map_location="cpu", weights_only=True)


def save_file(path: str | Path, kind: str, content: Mapping[str, Any]) -> None:
    """Write ``content``, tensors and plain values by name, as a file of a ``kind``."""
    buffer = io.BytesIO()
    torch.save({"kind": kind, "version": VERSION, **plain(dict(content))}, buffer)
    write_whole(Path(path), buffer.getbuffer())


def plain(value: Any) -> Any:
    """Return ``value`` with Python's numbers and strings in place of NumPy's, which are code."""
    if type(value) is dict:  # a TensorDict is a Mapping, too
        return {plain(name): plain(part) for name, part in value.items()}
    if type(value) in (list, tuple):
        return type(value)(map(plain, value))
    return value.tolist() if isinstance(value, np.generic | np.ndarray) else value


def load_file(path: str | Path, kind: str, writer: str = "") -> dict[str, Any]:
    """Read a file of a ``kind``, which ``writer`` wrote, by default that kind's ``save``."""
    expected = f"a file that {writer or f'{kind}.save'} wrote"
    try:
        content = read_tensors(Path(path))
    except FileNotFoundError as error:
        raise QPError.expected("path", f"{path}, which does not exist", expected) from error
    except Exception as error:  # damaged files raise errors of any type
        got = f"{path}, which cannot be read ({type(error).__name__})"
        remedy = "It may be damaged, or hold more than tensors and numbers."
        raise QPError.expected("path", got, expected, remedy) from error
    of = content.get("kind") if isinstance(content, dict) else None
    if of != kind:
        got = f"{path}, {'which another program wrote' if of is None else f'a saved {of}'}"
        remedy = f"{of}.load reads it." if of in ("Controller", "QPMPC") else ""
        raise QPError.expected("path", got, expected, remedy)
    if (version := content.get("version")) != VERSION:
        got, remedy = f"{path}, whose format has version {version!r}", "Make the file again."
        if version not in range(1, VERSION):  # which no release wrote
            remedy = "A newer release wrote it: pip install --upgrade torch-qpmpc."
        raise QPError.expected("path", got, f"version {VERSION}", remedy)
    return content


@contextmanager
def reading(file: str | Path, expected: str, remedy: str = RESTORE) -> Iterator[None]:
    """Raise `QPError`, with the reason, if a block cannot read a ``file``."""
    try:
        yield
    except Exception as error:  # damaged files raise errors of any type
        missing = f"it has no {error.args[0]}" if isinstance(error, KeyError) else ""
        reason = missing or " ".join(str(error).split()) or type(error).__name__
        got = f"{file} ({reason})"
        raise QPError.expected(Path(file).name, got, expected, remedy) from error
