"""Run the commands whose numbers pages quote: ``python -m tests.claims``, hours, or ``--quick``.

claims.yaml lists each command with its numbers: where a number is read, the interval that it must
lie in, and the pages that quote it, with the quoted text and the number in braces. A number outside
its interval makes these pages stale: the command names them, and fails. ``FOLDER`` in a command is
an empty folder, and so is the run's folder of ``python train.py``.
"""

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).parents[2]
CLAIMS = Path(__file__).with_name("claims.yaml")


@dataclass(frozen=True)
class Number:
    """A number that a command makes.

    Attributes:
        within: the interval that it must lie in.
        pages: the quoted text by page, with the number in braces.
        summary: its key in summary.json, with dots between levels.
        output: without ``summary``, a regular expression whose group is the number in the output.
    """

    within: tuple[float, float]
    pages: dict[str, str]
    summary: str | None = None
    output: str | None = None

    @property
    def name(self) -> str:
        return self.summary or str(self.output)

    def quotes(self) -> Iterator[tuple[str, str, float]]:
        """Return each page, the text that it must contain, and the number in it."""
        for page, text in self.pages.items():
            (number,) = re.findall(r"\{(.+?)\}", text)
            yield page, text.replace(f"{{{number}}}", number), value(number)

    def read(self, output: str, folder: Path) -> float:
        if self.summary is None:
            match = re.search(str(self.output), output, re.MULTILINE)
            return value(match[1]) if match else float("nan")
        found: Any = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
        for key in self.summary.split("."):
            found = found[key]
        return float(found)

    def holds(self, number: float) -> bool:
        low, high = self.within
        return low <= number <= high


@dataclass(frozen=True)
class Claim:
    command: str
    numbers: list[Number]
    quick: bool = False

    def run(self, folder: Path) -> list[str]:
        """Run the command; return a line for each page that is stale."""
        command = self.command.replace("FOLDER", str(folder))
        if re.match(r"python train.py (?!-m )", command):
            command += f" hydra.run.dir={folder}"
        path = os.pathsep.join((str(Path(sys.executable).parent), os.environ["PATH"]))
        options: dict[str, Any] = {"shell": True, "capture_output": True, "text": True, "cwd": ROOT}
        done = subprocess.run(command, env={**os.environ, "PATH": path}, **options)
        if done.returncode:
            pages = sorted({page for number in self.numbers for page in number.pages})
            return [f"{', '.join(pages)}: the command failed.\n{done.stderr[-2000:]}"]
        stale = []
        for number in self.numbers:
            now = number.read(done.stdout, folder)
            print(f"  {number.name}: {now:g}, {'in' if number.holds(now) else 'NOT IN'} ", end="")
            print(f"[{number.within[0]:g}, {number.within[1]:g}]", flush=True)
            if not number.holds(now):
                stale += [f"{page}: '{text}' is now {now:g}" for page, text, _ in number.quotes()]
        return stale


def value(text: str) -> float:
    """Read a number with commas between thousands."""
    return float(text.replace(",", ""))


def load(path: Path = CLAIMS) -> list[Claim]:
    claims = yaml.safe_load(path.read_text(encoding="utf-8"))
    return [
        Claim(**{**x, "numbers": [Number(**number) for number in x["numbers"]]}) for x in claims
    ]


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.claims", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="only the commands marked quick")
    parser.add_argument("--only", default="", help="only commands that contain this text")
    parser.add_argument("--claims", type=Path, default=CLAIMS, help="the list of claims")
    options = parser.parse_args(arguments)
    stale: list[str] = []
    for claim in load(options.claims):
        if options.only not in claim.command or (options.quick and not claim.quick):
            continue
        print(claim.command, flush=True)
        began = time.perf_counter()
        with tempfile.TemporaryDirectory() as folder:
            stale += claim.run(Path(folder))
        print(f"  {time.perf_counter() - began:.0f} s", flush=True)
    print("\n".join(["", "Stale:", *stale]) if stale else "\nNo page is stale.")
    return int(bool(stale))


if __name__ == "__main__":
    sys.exit(main())
