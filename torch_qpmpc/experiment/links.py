"""Symbolic links in a run's folder, which may come from a stranger: writes do not leave it."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from torch_qpmpc.errors import QPError

#: Folder whose logger makes links of its own, to its cache.
OWN_LINKS = "wandb"


def check_links(folder: str | Path, part: str = ".") -> None:
    """Raise `QPError` if ``part`` of ``folder`` has a link to something outside ``folder``."""
    root = Path(folder).resolve()
    for path in _entries(root / part):
        if path.is_symlink() and not _within(path, root):
            got = f"{path}, a symbolic link out of {folder}"
            remedy = "Writing would change files elsewhere: remove the link."
            raise QPError.expected("folder", got, "a folder without such links", remedy)


def _within(path: Path, root: Path) -> bool:
    try:
        return path.resolve().is_relative_to(root)
    except (OSError, RuntimeError):  # a loop
        return False


def _entries(path: Path) -> Iterator[Path]:
    """Yield ``path`` and all that is below it, without following links."""
    yield path
    if path.is_symlink() or not path.is_dir() or path.name == OWN_LINKS:
        return
    for entry in sorted(os.listdir(path)):
        yield from _entries(path / entry)
