"""One step of the exported C beside ``mpc.policy``.

    python -m tests.benchmarks.export --write

Warm is a closed loop of 32 starts with 50 steps, cold random states without a warm start. A step's
time is its median over several passes, in which the contenders take turns.
"""

import argparse
import ctypes
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from tests.benchmarks.table import PAGE, significant, write_section
from tests.campaign.exports import PROBLEMS
from torch_qpmpc import QPMPC, CompiledPolicy, export_c
from torch_qpmpc.export.comparison import actions, reference
from torch_qpmpc.export.library import required_compiler

HERE = Path(__file__).parent
CHOSEN = ("point mass, N = 10", "12 states, 4 actions, N = 10")
PASSES, COLD = 5, 1000
#: Steps of the contender in Python.
FEW = 200


class Times(NamedTuple):
    """Microseconds of each step, ``(steps,)``, and the actions if they are compared."""

    steps: np.ndarray
    u: np.ndarray | None = None

    def __str__(self) -> str:
        p50, p99 = np.percentile(self.steps, [50, 99])
        return " / ".join(map(significant, (p50, p99, self.steps.max())))


def library(folder: Path, source: Path, *more: str) -> ctypes.CDLL:
    target = folder / f"{source.stem}.so"
    flags = ["-std=c99", "-O3", "-fPIC", "-shared", f"-I{folder}", *more]
    command = [*required_compiler(), *flags, str(source), "-o", str(target)]
    subprocess.run(command, check=True)
    return ctypes.CDLL(str(target))


def pointer(x: np.ndarray) -> ctypes.c_void_p:
    return x.ctypes.data_as(ctypes.c_void_p)


def compiled(mpc: QPMPC, folder: Path) -> Callable[[np.ndarray, bool], Times]:
    """Return a function that times the exported C at p ``(steps, n_p)``, warm or cold."""
    export = export_c(mpc, folder)
    timed = library(folder, HERE / "timing.c", str(folder / "policy.c"))
    assert export.state_bytes is not None  # there is a compiler
    state = np.zeros(export.state_bytes // 8 + 8)

    def run(p: np.ndarray, cold: bool) -> Times:
        p, n = np.ascontiguousarray(p), len(p)
        u, times = np.empty((n, mpc.n_u)), np.empty(n)
        codes, iterations = np.empty(n, np.int32), np.empty(n, np.int32)
        arrays = [pointer(x) for x in (times, codes, iterations)]
        starts = (ctypes.c_long(n), ctypes.c_int(cold))
        timed.policy_timed(pointer(state), pointer(p), pointer(u), *starts, *arrays)
        assert not codes.any()
        return Times(times / 1e3, u)

    return run


def in_python(mpc: QPMPC) -> Callable[[np.ndarray, bool], Times]:
    """Return a function that times ``mpc.policy``, which has no warm start."""

    @torch.no_grad()
    def run(p: np.ndarray, cold: bool) -> Times:
        times = np.empty(len(p))
        for i, s in enumerate(torch.as_tensor(p)):
            start = time.perf_counter()
            mpc.policy(s)
            times[i] = time.perf_counter() - start
        return Times(1e6 * times)

    return run


def measured(name: str) -> list[list[str]]:
    """Measure all contenders on a problem: rows of the table."""
    mpc, known, loop = PROBLEMS[name]()
    mpc.solver = "daqp"
    states = loop(CompiledPolicy(mpc)).transpose(0, 1)
    warm = states.reshape(-1, mpc.n_p).numpy()
    cold = known(np.random.default_rng(2), COLD)
    with tempfile.TemporaryDirectory() as temporary:
        contenders: dict[str, Any] = {
            "C": compiled(mpc, Path(temporary)),
            "mpc.policy, daqp": in_python(mpc),
        }
        times: dict[str, list[list[Times]]] = {who: [] for who in contenders}
        for _ in range(PASSES):
            for who, run in contenders.items():
                few = None if who == "C" else FEW
                times[who].append([run(warm[:few], False), run(cold[:few], True)])
    rows = []
    for who, passes in times.items():
        both = [Times(np.median([x[i].steps for x in passes], axis=0)) for i in (0, 1)]
        error = ""
        if (u := passes[-1][1].u) is not None:
            exact = actions(mpc, reference(mpc, cold[: len(u)]))
            error = f"{np.abs(u - exact).max():.0e}"
        rows.append([name, who, *map(str, both), error])
    return rows


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.export", description=__doc__)
    parser.add_argument("--problem", choices=CHOSEN)
    parser.add_argument("--write", action="store_true", help="write the table into the docs")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    kinds = (f"{kind}: p50 / p99 / max" for kind in ("warm", "cold"))
    titles = ["problem", "step of", *kinds, "error of u"]
    rows = []
    for name in [options.problem] if options.problem else CHOSEN:
        rows += measured(name)
        print("\n".join(" | ".join(row) for row in rows[-2:]), flush=True)
    if options.write:
        lines = [titles, ["---", "---", *["---:"] * 3], *rows]
        table = "\n".join(f"| {' | '.join(cells)} |" for cells in lines)
        write_section(PAGE, table, "export")
    return 0


if __name__ == "__main__":
    sys.exit(main())
