"""The first lines of a run: what it does and where, and what it waits for."""

from __future__ import annotations

import sys
from contextlib import AbstractContextManager
from typing import Any

from numba.core import event
from omegaconf import DictConfig
from tqdm import tqdm

from torch_qpmpc.errors import printable

COMPILING = "Compiling the QP's kernels for this CPU: up to a minute, the first time only."


def announcement(cfg: DictConfig, folder: str, done: int = 0) -> str:
    """Describe a run that has made ``done`` of its updates already."""
    task = " ".join(filter(None, (cfg.task.name, cfg.task.get("id"))))
    parts = [f"{group} {cfg[group].name}" for group in ("noise", "constraint", "optimizer")]
    parts = [f"task {task}", *parts, f"solver {cfg.solver}", f"seed {cfg.seed}"]
    updates = f"{cfg.updates} updates" + (f", {done} of them done" if done else "")
    lines = [f"{updates}: {', '.join(parts)}", f"Folder: {folder}"]
    return printable("\n".join(lines))


def compilation_named() -> AbstractContextManager[None]:
    """Print a line when Numba compiles a kernel of the package; nothing if its cache has all."""
    return event.install_listener("numba:compile", _Notice())


class _Notice(event.Listener):
    def __init__(self) -> None:
        self.printed = False

    def on_start(self, event: event.Event) -> None:
        data: Any = event.data
        function = data["dispatcher"].py_func
        if not self.printed and function.__module__.startswith("torch_qpmpc"):
            self.printed = True
            tqdm.write(COMPILING)  # above a progress bar, if there is one
            sys.stdout.flush()

    def on_end(self, event: event.Event) -> None:
        """Do nothing: the kernels that follow are part of the same wait."""
