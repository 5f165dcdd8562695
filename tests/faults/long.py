"""Train for long: ``python -m tests.faults.long [key=value ..]``, with overrides of train.py.

It fails if memory grows by more than 5 % after the first tenth, if the last tenth's updates take
over 10 % more processor time than the second's, or if more QPs are unsolved at the end.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import train
from tests.runs import make_config

UPDATES = 20_000
SETTINGS = ("optimizer=adam", "solver=daqp", "figures=false")


class Watch:
    """A progress bar that records time and memory at each hundredth of the updates."""

    def __init__(self, total: int, **_: object) -> None:
        self.every, self.done = total // 100, 0
        self.seconds: list[float] = []
        self.memory: list[float] = []

    def __enter__(self) -> Watch:
        self.note()
        return self

    def __exit__(self, *_: object) -> None:
        """Stay as it is."""

    def update(self) -> None:
        self.done += 1
        if self.done % self.every == 0:
            self.note()

    def note(self) -> None:
        self.seconds.append(time.process_time())
        self.memory.append(resident())
        if len(self.memory) % 10 == 1:
            print(f"{len(self.memory) - 1:3} %: {self.memory[-1]:.1f} MB", flush=True)

    def set_postfix(self, *_: object, **__: object) -> None:
        """Show nothing."""


def resident() -> float:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1]) / 1024
    raise RuntimeError("no VmRSS")


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.faults.long", description=__doc__)
    parser.add_argument("--updates", type=int, default=UPDATES)
    parser.add_argument("settings", nargs="*", help="of train.py")
    options = parser.parse_args(arguments)
    sizes = (f"updates={options.updates}", f"eval_interval={options.updates // 4}")
    cfg, watches = make_config(*SETTINGS, *sizes, *options.settings), []

    def watch(**options: Any) -> Watch:
        watches.append(Watch(**options))
        return watches[-1]

    train.tqdm = watch  # pyright: ignore[reportAttributeAccessIssue] -- what is used of it is there
    with tempfile.TemporaryDirectory() as folder:
        train.train(cfg, folder)
        unsolved = pd.read_csv(Path(folder) / "metrics.csv")["qp/unsolved"].dropna().to_numpy()
    (found,) = watches
    tenths = np.diff(np.array(found.seconds)[::10])
    slower, growth = tenths[-1] / tenths[1], max(found.memory[-10:]) / found.memory[10]
    parts = [int(part.sum()) for part in np.array_split(unsolved, 10)]
    print(f"{options.updates} updates, {found.seconds[-1] - found.seconds[0]:.0f} s of processor")
    print(f"memory {found.memory[10]:.1f} MB after a tenth, times {growth:.3f} in the last")
    print(f"the last tenth's time is {slower:.3f} of the second's")
    print(f"unsolved in each tenth {parts}")
    assert growth <= 1.05, "memory grows"
    assert parts[-1] <= 2 * max(parts[1], 1), "ever more QPs stay unsolved"


if __name__ == "__main__":
    main()
