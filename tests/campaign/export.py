"""The exported C against an exact solver: ``python -m tests.campaign.export --count 100000``.

A tenth of the states is ten times as large. The interior point certifies values, which determine
actions less well: where one of its actions differs from that of C, a sharper solution decides.
``--write`` puts the rows into the table of docs/reliability/measured.md.
"""

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from tests.benchmarks.table import DOCS, table, write_section
from tests.campaign.exports import PROBLEMS
from tests.exported import read
from torch_qpmpc import export_c
from torch_qpmpc.export.comparison import actions, reference, sharpen
from torch_qpmpc.qp.program import Status as Outcome

PAGE = DOCS / "reliability" / "measured.md"
#: The bounds on differences of actions, and of values relative to 1 + |V|.
LARGEST = 1e-6, 1e-8
CHUNK = 5000
TITLES = (
    "problem",
    "rows",
    "largest difference of u",
    "of the value",
    "solved, infeasible, not certified",
    "object, state",
)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.campaign.export", description=__doc__)
    parser.add_argument("--count", type=int, default=100_000, help="states per problem")
    parser.add_argument("--problem", choices=tuple(PROBLEMS), help="one problem; all by default")
    parser.add_argument("--write", action="store_true", help="write the table's rows into the docs")
    options = parser.parse_args(arguments)
    wrong = 0
    for name in [options.problem] if options.problem else PROBLEMS:
        row, good = judged(name, options.count)
        print(" | ".join(row), "" if good else "WRONG", flush=True)
        wrong += not good
        if options.write:
            write(row)
    return wrong


def judged(name: str, count: int) -> tuple[list[str], bool]:
    """Return the table's row of a problem, and True if no answer is wrong."""
    mpc, known, _ = PROBLEMS[name]()
    rng = np.random.default_rng(0)
    p = known(rng, count)
    p[: count // 10] *= 10
    p = rng.permutation(p)
    with tempfile.TemporaryDirectory() as folder:
        export = export_c(mpc, folder)
        library = read(Path(folder))
        size = object_size(Path(folder))
    counts, wrong, worst = np.zeros(3, dtype=int), 0, np.zeros(2)
    warm = library.states(1)
    for start in range(0, count, CHUNK):
        part = p[start : start + CHUNK]
        cold = library.steps(library.states(len(part)), part, mpc.n_u)
        again = [library.steps(warm, x[None], mpc.n_u) for x in part]
        both = cold, type(cold)(*map(np.concatenate, zip(*again, strict=True)))
        exact = reference(mpc, part, "torch")
        off = np.max([differences(steps, exact, actions(mpc, exact))[0] for steps in both], 0)
        doubtful = (off > LARGEST[0]) & (exact.status == Outcome.SOLVED)
        exact = sharpen(mpc, part, exact, np.flatnonzero(doubtful))
        for steps in both:
            u, value = differences(steps, exact, actions(mpc, exact))
            solved = (steps.codes == 0) & (exact.status == Outcome.SOLVED)
            worst = np.maximum(worst, [u[solved].max(initial=0), value[solved].max(initial=0)])
            infeasible = (steps.codes == 2) & (exact.status == Outcome.INFEASIBLE)
            limit = steps.codes == 1
            wrong += int((~(solved | infeasible | limit)).sum())
            counts += [x.sum() for x in (solved, infeasible, limit)]
    row = [name, f"{export.rows}", f"{worst[0]:.0e}", f"{worst[1]:.0e}"]
    row += [", ".join(f"{n}" for n in counts)]
    row += [f"{size / 1e3:.0f}, {library.state_bytes / 1e3:.1f} kB"]
    return row, not wrong and bool((worst <= LARGEST).all())


def differences(steps, exact, actions) -> tuple[np.ndarray, np.ndarray]:
    u = np.abs(steps.u - actions).max(-1)
    return u, np.abs(steps.value - exact.value) / (1 + np.abs(exact.value))


def object_size(folder: Path) -> int:
    """Return the bytes of code and tables that ``gcc -O2`` makes, without the self-test."""
    source = (folder / "policy.c").read_text()
    source = source[: source.index("/* States of the self-test")]
    (folder / "size.c").write_text(source)
    command = ["gcc", "-std=c99", "-O2", f"-I{folder}", "-c", str(folder / "size.c")]
    subprocess.run([*command, "-o", str(folder / "size.o")], check=True)
    sizes = subprocess.run(
        ["size", str(folder / "size.o")], check=True, capture_output=True, text=True
    )
    text, data, *_ = sizes.stdout.splitlines()[1].split()
    return int(text) + int(data)


def write(row: list[str]) -> None:
    """Replace the row of the same problem in the page's table, or append it."""
    text = PAGE.read_text(encoding="utf-8")
    old = text.split("<!-- export -->")[1].split("<!-- /export -->")[0]
    rows = [line.strip("| ").split(" | ") for line in old.strip().splitlines()[2:]]
    found = {cells[0]: cells for cells in rows} | {row[0]: row}
    ordered = [found[name] for name in PROBLEMS if name in found]
    write_section(PAGE, table(TITLES, ordered), "export")


if __name__ == "__main__":
    sys.exit(main())
