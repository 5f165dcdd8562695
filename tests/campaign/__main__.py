"""Solve QPs whose outcome is known: ``python -m tests.campaign --count 100000 --solver daqp``.

It ends with two tables in Markdown of the latest counts: all families together by solver, and each
by itself. ``--write`` writes them to docs/reliability/measured.md. ``--solver`` without a name
solves nothing.
"""

import argparse
import functools
import json
import sys
import time
from pathlib import Path

import torch
from tqdm import tqdm

from tests.benchmarks.table import DOCS, ROOT, table, write_section
from tests.campaign.families import FAMILIES, Draw
from tests.campaign.tally import SLOW, Tally
from torch_qpmpc.qp.solvers import BACKENDS

#: QPs per batch; few for slow families, so that a batch stays below the time limit of a QP.
BATCH, FEW = 128, 16
LONG = (
    "unbounded",
    "mixed",
    "scaled mixed",
    "unstable model",
    "runaway prediction",
    "hopeless plant",
)
#: Counts of a family, with their names in the tables.
OUTCOMES = {
    "certified": "certified, and right",
    "named": "failed, and named for what they are",
    "missed": "not solved to tolerance",
    "wrong": "wrong",
}
PAGE = DOCS / "reliability" / "measured.md"
RESULTS = ROOT / "runs" / "campaign"


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.campaign", description=__doc__)
    parser.add_argument("--count", type=int, default=100_000, help="QPs for each solver")
    parser.add_argument(
        "--solver", nargs="*", default=list(BACKENDS), help="names, or 'NAME, warm'"
    )
    parser.add_argument("--family", nargs="*", default=list(FAMILIES), help="names of families")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--results", type=Path, default=RESULTS, help="a folder for the counts")
    parser.add_argument("--write", action="store_true", help="write the tables to the page")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    for solver in options.solver:
        campaign(solver, options.family, options.count, options.seed, options.results)
    tallies = load(options.results)
    parts = {"campaign": totals(tallies), "campaign-families": by_family(tallies)}
    for marker, text in parts.items():
        print(text, end="\n\n")
        if options.write:
            write_section(PAGE, text, marker)
    return int(any(tally.failures for of_one in tallies.values() for tally in of_one.values()))


def campaign(solver: str, families: list[str], count: int, seed: int, folder: Path) -> None:
    """Solve ``count`` QPs, equally many of each family, and save the counts to a file."""
    share = -(-count // len(families))
    with tqdm(total=share * len(families), desc=solver, mininterval=5) as progress:
        tallies = {}
        for family in families:
            tally = tallies[family] = Tally()
            began, position = time.process_time(), 0
            while tally.count < share:
                size = min(FEW if family in LONG else BATCH, share - tally.count)
                before = tally.count
                case = FAMILIES[family](Draw(seed + position), size)
                for line in tally.add(case, solver):
                    tqdm.write(f"{solver}, {family}, seed {seed + position}: {line}", sys.stderr)
                progress.update(tally.count - before)
                position += 1
            tally.settle(solver)
            tally.seconds = time.process_time() - began
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{solver.replace(':', '-').replace(', ', '-')}.json"
    record = {"solver": solver, "families": {k: t.record() for k, t in tallies.items()}}
    path.write_text(json.dumps(record, indent=1), encoding="utf-8")


def load(folder: Path) -> dict[str, dict[str, Tally]]:
    """Load the latest counts of each solver, in the order of `BACKENDS`."""
    records = [json.loads(path.read_text(encoding="utf-8")) for path in folder.glob("*.json")]
    names = [*BACKENDS, *sorted(r["solver"] for r in records if r["solver"] not in BACKENDS)]
    records.sort(key=lambda record: names.index(record["solver"]))
    return {
        record["solver"]: {name: Tally(**counts) for name, counts in record["families"].items()}
        for record in records
    }


def by_family(tallies: dict[str, dict[str, Tally]]) -> str:
    """Format the table of families by their counts; one that depends on the solver is a range."""
    lines: dict[tuple[str, ...], list[str]] = {}
    for family in FAMILIES:
        of_all = [of_one[family] for of_one in tallies.values() if family in of_one]
        if of_all:
            lines.setdefault((*(spread(of_all, name) for name in OUTCOMES),), []).append(family)
    rows = [[", ".join(families), *counts] for counts, families in lines.items()]
    return table(["each of", *OUTCOMES], rows)


def spread(tallies: list[Tally], name: str) -> str:
    least, most = (f(getattr(tally, name) for tally in tallies) for f in (min, max))
    return f"{least:,}" if least == most else f"{least:,} to {most:,}"


def totals(tallies: dict[str, dict[str, Tally]]) -> str:
    """Format the table of all families together, by solvers."""
    sums = [functools.reduce(Tally.plus, of_one.values()) for of_one in tallies.values()]
    lines = [
        ["QPs", *(f"{total.count:,}" for total in sums)],
        *([title, *(f"{getattr(x, name):,}" for x in sums)] for name, title in OUTCOMES.items()),
        ["with NaN or inf in a gradient", *(f"{total.not_finite:,}" for total in sums)],
        [f"slower than {SLOW} s", *(f"{total.slow:,}" for total in sums)],
        ["slowest, in seconds of one core", *(f"{total.slowest:.2f}" for total in sums)],
        ["largest error of a certified answer", *(f"{total.error:.0e}" for total in sums)],
    ]
    return table(["", *tallies], lines)


if __name__ == "__main__":
    sys.exit(main())
