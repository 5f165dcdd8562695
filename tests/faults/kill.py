"""Kill and resume runs: ``python -m tests.faults.kill --count 20``.

SIGKILL comes at seeded random moments: while the run starts, between two updates, or while a
checkpoint is written. Each run goes on by the same command until it has finished, and must have the
numbers of an undisturbed run. The processes are forks of this one, which has imported everything,
so that they start within a second.
"""

import argparse
import multiprocessing
import os
import random
import sys
import tempfile
import time
from collections import Counter
from contextlib import redirect_stderr, redirect_stdout
from multiprocessing.process import BaseProcess as Process
from pathlib import Path

import train
from tests.runs import CONFIGS, SMALL
from tests.stops import assert_same_numbers

#: Overrides that write a checkpoint every few updates.
RUN = (*SMALL, "constraint=combined", "updates=200", "eval_interval=4")
RUN += ("log_interval=3", "num_envs=16", "replay_capacity=4000", "task.eval_steps=5")
#: When a process is killed, and how often.
MOMENTS = {"starting": 1, "training": 2, "writing a checkpoint": 2}
STARTS, TRAINS = (0.0, 3.0), (0.0, 3.0)  # seconds from which the moments are drawn


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.faults.kill", description=__doc__)
    parser.add_argument("--count", type=int, default=20, help="of kills")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        campaign(Path(folder), options.count, random.Random(options.seed))


def campaign(folder: Path, count: int, rng: random.Random, settings: tuple[str, ...] = RUN) -> None:
    """Run, kill and resume runs in ``folder`` until there have been ``count`` kills."""
    finish(start(folder / "whole", settings))
    kills, runs = Counter(), 0
    while kills.total() < count:
        place, runs = folder / f"killed-{runs}", runs + 1
        process = start(place, settings)
        while kills.total() < count and (moment := kill(process, place, rng)):
            kills[moment] += 1
            print(f"{kills.total()}: killed while {moment}, {reached(place)}", flush=True)
            process = start(place, settings)
        finish(process)
        assert_same_numbers(place, folder / "whole")
    print(f"{count} kills in {runs} runs {dict(kills)}:")
    print("every number is that of the run that was left alone")


def start(place: Path, settings: tuple[str, ...]) -> Process:
    settings = (*settings, f"hydra.run.dir={place}")
    process = multiprocessing.get_context("fork").Process(target=command, args=(settings,))
    process.start()
    return process


def command(settings: tuple[str, ...]) -> None:
    sys.argv = ["train.py", "--config-path", str(CONFIGS), "hydra/job_logging=disabled", *settings]
    with open(os.devnull, "w") as nowhere, redirect_stdout(nowhere), redirect_stderr(nowhere):
        train.main()


def kill(process: Process, place: Path, rng: random.Random) -> str | None:
    (moment,) = rng.choices(list(MOMENTS), list(MOMENTS.values()))
    began, before = time.monotonic(), files(place)
    delay = rng.uniform(*(STARTS if moment == "starting" else TRAINS))
    while process.is_alive():
        trains = files(place) > before
        if moment == "starting" or trains:
            if time.monotonic() - began >= delay and (
                moment != "writing a checkpoint" or (place / "checkpoint.pt.partial").exists()
            ):
                process.kill()
                process.join()
                return moment
        else:
            began = time.monotonic()
        time.sleep(0.0005)
    return None


def files(place: Path) -> int:
    return len(list((place / "tensorboard").glob("*")))


def finish(process: Process) -> None:
    process.join()
    if process.exitcode:
        raise SystemExit(f"a run ended with {process.exitcode}")


def reached(place: Path) -> str:
    found = sorted(path.name for path in place.glob("*")) if place.exists() else []
    return ", ".join(found) or "nothing written"


if __name__ == "__main__":
    main()
