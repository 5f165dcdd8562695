"""The page of all configuration keys, from configs/ and its comments."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from torch_qpmpc.experiment.config import keys

CONFIGS = Path(__file__).parents[1] / "configs"
#: Files whose comments explain the keys that several files set.
FIRST = ("config", "optimizer/gauss_newton", "constraint/combined", "task/point_mass")
TITLE = """# All configuration keys

Set a key by `python train.py KEY=VALUE`, or several at once by a choice such as `task=pendulum`.
If several choices set a key, the last one in `defaults` of `configs/config.yaml` counts. Each row
has the usual value first, then the values of single choices. Units are the plant's unless the
meaning says otherwise.
"""
GROUPS = {
    "constraint": "Constraints and their penalties: `constraint=NAME`",
    "noise": "Noise: `noise=NAME`",
    "optimizer": "Optimizer: `optimizer=NAME`",
    "start": "Start: `start=NAME`",
    "task": "Task: `task=NAME`",
}


class Setting(NamedTuple):
    """A line of a file in configs/."""

    file: str
    value: str
    comment: str


def lines(path: Path) -> Iterator[tuple[str, str, str]]:
    """Yield the dotted key, the value and the comment of each line that sets a key."""
    text, parents = path.read_text(encoding="utf-8"), []
    if path.parent != CONFIGS and "@package _global_" not in text:
        parents.append((-1, path.parent.name))
    pattern = r"^( *)(\w+):(?: +([^ #].*?))?(?: +# (.*))?$"
    for indent, name, value, comment in re.findall(pattern, text, re.MULTILINE):
        while parents and parents[-1][0] >= len(indent):
            parents.pop()
        parents.append((len(indent), name))
        key = ".".join(parent for _, parent in parents)
        yield key, value, comment
        for inner, number in re.findall(r"(\w+): ([^,}]+)", value) if value[:1] == "{" else ():
            yield f"{key}.{inner}", number, comment


def settings() -> dict[str, list[Setting]]:
    """Return the settings of each key, those of ``FIRST`` first."""
    files = {
        path.relative_to(CONFIGS).with_suffix("").as_posix(): path
        for path in sorted(CONFIGS.rglob("*.yaml"))
        if path.relative_to(CONFIGS).parts[0] not in ("hydra", "study", "ablation")
    }
    of: dict[str, list[Setting]] = {key: [] for key in keys()}
    for file in (*FIRST, *(file for file in files if file not in FIRST)):
        for key, value, comment in lines(files[file]):
            if key in of:
                of[key].append(Setting(file.replace("/", "="), value, comment))
    return of


def meaning(of: list[Setting]) -> str:
    """Return the first comment."""
    return next((setting.comment for setting in of if setting.comment), "")


def values(of: list[Setting]) -> str:
    """List the values, the most frequent first, the others with their choices."""
    choices: dict[str, list[str]] = {}
    for setting in of:
        choices.setdefault(setting.value, []).append(setting.file)
    usual = max(choices, key=lambda value: ("config" in choices[value], len(choices[value])))
    others = [f"`{x}` ({', '.join(files)})" for x, files in choices.items() if x != usual]
    return "; ".join([f"`{usual}`", *others])


def page() -> str:
    """Return the page as Markdown."""
    text = [TITLE, "## Every run\n"]
    head = "| key | meaning | values |\n| --- | --- | --- |"
    for group in ("", *GROUPS):
        text += [f"\n## {GROUPS[group]}\n"] if group else []
        text.append(head)
        for key, of in settings().items():
            if key.rpartition(".")[0].partition(".")[0] == group and not key.endswith(".name"):
                cells = (f"`{key}`", meaning(of), values(of))
                text.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join(text) + "\n"
