"""Answers under other rounding: ``python -m tests.campaign.rounding --count 5000``.

Each QP and each random controller is solved again with its data one unit in the last place away,
and by the linear algebra of other machines, in processes of their own. Rounding may decide nothing:
the status and the export's acceptance are the same, a value is right, and a first move is within
`MOVE` of its range. The command prints the seed of each difference, and fails if there is one.
"""

import argparse
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tests.campaign.families import FAMILIES, Case, Draw
from tests.campaign.outcomes import judge
from tests.campaign.tally import solve
from torch_qpmpc import Controller, LinearMPC, QPError, QuadraticProgram, Status
from torch_qpmpc.qp.solvers import BACKENDS
from torch_qpmpc.study.markdown import table

#: Settings of other processors, by name; MKL does torch's linear algebra, OpenBLAS numpy's.
VARIANTS: dict[str, dict[str, str]] = {
    "this machine": {},
    "MKL: COMPATIBLE": {"MKL_CBWR": "COMPATIBLE"},
    "MKL: AVX2": {"MKL_CBWR": "AVX2"},
    "OpenBLAS: Prescott": {"OPENBLAS_CORETYPE": "Prescott"},
}
#: The largest difference of a first move, relative to its range; QPs of a batch; the share of
#: controllers that is exported.
MOVE, BATCH, EXPORTED = 1e-6, 32, 50
#: QPs by name, each with its solver's; and answers by name: of QPs their status and True where they
#: are wrong, of controllers the first moves and what their export says.
Cases = dict[str, tuple[str, Case]]
Answers = dict[str, Any]


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.campaign.rounding", description=__doc__)
    parser.add_argument("--count", type=int, default=5000, help="QPs")
    parser.add_argument("--controllers", type=int, default=300, help="controllers")
    parser.add_argument("--seed", type=int, default=0, help="the first seed")
    parser.add_argument("--variants", nargs="*", default=list(VARIANTS), choices=list(VARIANTS))
    parser.add_argument("--answer", type=Path, help=argparse.SUPPRESS)  # in a variant's process
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    if options.answer:
        cases, seeds = torch.load(options.answer / "cases.pt", weights_only=False)
        found = [answers(cases, seeds, nudged) for nudged in (False, True)]
        torch.save(found, options.answer / "answers.pt")
        return 0
    first, wrong = {}, 0
    with tempfile.TemporaryDirectory() as folder:
        seeds = range(options.seed, options.seed + options.controllers)
        torch.save((drawn(options.count, options.seed), seeds), f"{folder}/cases.pt")
        for name in options.variants:
            command = [sys.executable, "-m", "tests.campaign.rounding", f"--answer={folder}"]
            subprocess.run(command, env=os.environ | VARIANTS[name], check=True)
            plain, nudged = torch.load(f"{folder}/answers.pt", weights_only=False)
            first = first or plain
            rows = [["", "QPs", "controllers", "differences"]]
            for label, other in {name: plain, f"{name}, moved data": nudged}.items():
                lines = list(differences(first, other))
                qps = sum(len(x) for x, _ in other.values() if isinstance(x, Tensor))
                rows.append([label, f"{qps:,}", f"{options.controllers}", f"{len(lines)}"])
                wrong += len(lines)
                print(*(f"{label}: {line}" for line in lines), sep="\n", flush=True)
            print(table(rows[0], rows[1:]), flush=True)
    return int(wrong > 0)


def drawn(count: int, seed: int) -> Cases:
    """Draw QPs, equally many of each family, once: what training gives depends on rounding."""
    cases: Cases = {}
    size = min(BATCH, -(-count // len(FAMILIES)))
    for k in range(-(-count // (size * len(FAMILIES)))):
        for i, (family, make) in enumerate(FAMILIES.items()):
            solver = list(BACKENDS)[(i + k) % len(BACKENDS)]
            cases[f"{solver}, {family}, seed {seed + k}"] = solver, make(Draw(seed + k), size)
    return cases


def answers(cases: Cases, seeds: Iterable[int], nudged: bool) -> Answers:
    found: Answers = {}
    for i, (name, (solver, case)) in enumerate(cases.items()):
        parts = [moved(x, i) if nudged else x for x in (*case.known.qp.tensors(), case.known.fixed)]
        qp = QuadraticProgram(*parts[:-1], check_values=False)
        solution = solve(qp, parts[-1], solver)
        found[name] = solution.status.clone(), judge(case, solution).wrong
    return found | {f"controller {seed}": begun(seed, nudged) for seed in seeds}


def moved(x: Tensor, seed: int) -> Tensor:
    """Return a tensor whose entries are one unit in the last place larger, smaller or the same."""
    signs = torch.randint(-1, 2, x.shape, generator=torch.Generator().manual_seed(seed))
    if x.ndim > 1 and x.shape[-1] == x.shape[-2]:  # H stays symmetric
        signs = torch.triu(signs) + torch.triu(signs, 1).mT
    near = torch.nextafter(x, torch.where(signs > 0, torch.inf, -torch.inf).to(x))
    return torch.where((signs == 0) | (x == 0) | x.isinf(), x, near)


def begun(seed: int, nudged: bool) -> tuple[Any, ...]:
    """Return three first moves of a random controller, and what its export says."""
    rng = np.random.default_rng(seed)
    n, m = int(rng.integers(1, 5)), int(rng.integers(1, 3))
    n_y = int(rng.integers(1, min(n, m) + 1))
    A = rng.normal(size=(n, n))
    A *= rng.uniform(0.5, 1.02) / np.abs(np.linalg.eigvals(A)).max()
    B, C = rng.normal(size=(n, m)), rng.normal(size=(n_y, n))
    if nudged:
        A, B, C = (moved(torch.from_numpy(x), seed).numpy() for x in (A, B, C))
    options: dict[str, Any] = {"Q": 1.0, "R": float(rng.choice([0.0, 0.1])), "dR": 0.1}
    if seed % 3 == 0:
        options["y_bounds"] = (-2.0, 2.0)
    options |= {"u_bounds": (-1.0, 1.0), "du_bounds": (-0.5, 0.5)}
    try:
        mpc = LinearMPC((A, B, C), int(rng.integers(3, 16)), **options)
        steps = rng.normal(size=(3, 2, n_y))
        moves = [np.array(Controller(mpc).step(y, r)) for y, r in steps]
    except Exception as error:
        return f"{type(error).__name__}: {str(error)[:60]}", ""
    if seed % EXPORTED:
        return np.stack(moves), ""
    try:
        with tempfile.TemporaryDirectory() as folder:
            Controller(mpc).export_c(folder)
        return np.stack(moves), "exported"
    except QPError as error:
        return np.stack(moves), str(error).partition(":")[0]


def differences(first: Answers, other: Answers) -> Iterator[str]:
    """Yield a line for each answer that is not the first one's."""
    for name, (one, export) in first.items():
        two, again = other[name]
        if isinstance(one, Tensor):
            for i in ((one != two) | again).nonzero().flatten().tolist():
                was, now = Status(int(one[i])).name, Status(int(two[i])).name
                yield f"{name}, QP {i}: {was}, then {now}{', wrong' * bool(again[i])}"
        elif type(one) is not type(two) or export != again or (isinstance(one, str) and one != two):
            yield f"{name}: {one} {export}, then {two} {again}"
        elif isinstance(one, str):
            continue
        elif (off := np.abs(one - two).max()) > 2 * MOVE:
            yield f"{name}: a first move is off by {off:.1e}"


if __name__ == "__main__":
    sys.exit(main())
