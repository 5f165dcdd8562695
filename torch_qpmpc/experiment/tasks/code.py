"""The code that the keys under ``task`` name: a user's script, and an environment's module.

A configuration from a run's folder is data: its code runs only if the command line names it, too.
"""

import importlib
import runpy
import sys
from collections.abc import Sequence
from pathlib import Path

from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig

from torch_qpmpc.errors import QPError
from torch_qpmpc.experiment.config import TASKS, Config, TaskSettings
from torch_qpmpc.files import PACKAGED

#: How train.py is started: by its path in a clone, and as a module from a wheel.
COMMAND = "python -m torch_qpmpc.train" if PACKAGED.exists() else "python train.py"


def has_run(task: TaskSettings) -> bool:
    """Return True if all code that ``task`` names has been run in this process."""
    return task.name in TASKS and {*task.modules} <= {*sys.modules}


def run_code(cfg: DictConfig) -> Config:
    """Run the code that the command line's ``task`` names, and return the configuration.

    Raises:
        QPError: the code cannot be run, or the configuration is invalid.
    """
    if (here := str(Path.cwd())) not in sys.path:  # where train.py need not be
        sys.path.append(here)
    name, file = str(cfg.task.get("name")), cfg.task.get("file")
    if file is not None and name not in TASKS:
        expected = f"the Python file that registers task={name}"
        if name not in _registered_by(str(file), expected):
            raise QPError.expected("task.file", f"{file!r}, which registers no {name!r}", expected)
    elif file is not None and TASKS[name].defaults is None:
        got = f"{file!r} with task={name}, which reads no file"
        remedy = "Leave out task to learn the one that the file registers."
        raise QPError.expected("task.file", got, "a task with a file", remedy)
    read = Config.of(cfg)
    own, colon, _ = getattr(read.task, "id", "").partition(":")
    for module in [*([own] if colon else []), *read.task.modules]:
        try:
            importlib.import_module(module)
        except ImportError as error:
            got = f"{cfg.task.id!r}, and cannot import {module} ({error})"
            remedy = "Start in the folder that has it, or install it."
            raise QPError.expected("task.id", got, "MODULE:ID with a module", remedy) from error
    return read


def named_task(arguments: Sequence[str]) -> list[str]:
    """Return the command line with ``task=NAME`` of the script in ``task.file=FILE``, which is run.

    A command line that names a task is returned unchanged.
    """
    named = {key: value for key, _, value in (x.partition("=") for x in arguments)}
    file = named.get("task.file")
    if file is None:
        return [*arguments]
    file = str(OverridesParser.create().parse_override(f"task.file={file}").value())
    expected = "a Python file that registers one task"
    names = _registered_by(file, expected)
    if "task" in named:
        return [*arguments]
    if len(names) != 1:
        got = f"{file!r}, which registers {', '.join(names) or 'none'}"
        raise QPError.expected("task.file", got, expected, "Or choose one with task=NAME.")
    place = next(i for i, x in enumerate(arguments) if x.startswith("task.file="))
    return [*arguments[:place], f"task={names[0]}", *arguments[place:]]


def _registered_by(file: str, expected: str) -> list[str]:
    """Run a script, and return the names of the tasks that it registers."""
    if not Path(file).exists() or Path(file).suffix != ".py":
        wrong = "is no .py file" if Path(file).exists() else "does not exist"
        remedy = "Set task.file to its path."
        raise QPError.expected("task.file", f"{file!r}, which {wrong}", expected, remedy)
    before = {**TASKS}
    runpy.run_path(file, run_name="task_file")
    return [name for name, task in TASKS.items() if before.get(name) is not task]
