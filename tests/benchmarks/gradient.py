"""One Q-learning gradient (eq:thup), ours and others': ``python -m tests.benchmarks.gradient``.

A gradient is V on the next states, Q on the visited pairs, and the derivative of half the mean
squared TD error in all of theta. Up to batch 256 each contender's rounds have rounds of ProxSuite's
layer between them; theta moves in its last digits before each, so that nothing computed from it can
be used twice. Packages that are not installed are left out.
"""

import argparse
import os
import platform
import time
from collections.abc import Callable
from functools import cache, partial
from importlib.metadata import version
from importlib.util import find_spec
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from tests.benchmarks.peers import PEERS, Values
from tests.benchmarks.problems import GAMMA, PAPER, Transitions, make_mpc, move, nudge, transitions
from tests.benchmarks.reference import WRONG, reference_values, relative_error
from tests.benchmarks.table import publish, significant, table
from torch_qpmpc import QPMPC, QuadraticProgram
from torch_qpmpc.qp.solvers import BACKENDS

#: The columns of times: whether C is dense, and the batch.
CASES = ((True, 1), (True, 256), (True, 1024), (False, 256))
REFERENCE = next(iter(PEERS))
#: Our rounds by batch, and the number of them between two of the reference; others' rounds.
ROUNDS, PEERS_ROUNDS = {1: (60, 15), 256: (60, 15), 1024: (9, 9)}, {1: 5, 256: 1, 1024: 1}
#: The largest batch of peers for which larger ones take minutes.
PATIENCE = {"qpth": 256, "cvxpylayers": 256}
#: Relative change of theta since the solutions that warm starts use.
MOVED = 1e-3
#: Packages that are timed, or that times depend on.
PACKAGES = ("torch", "numpy", "proxsuite", "daqp", "qpth", "cvxpylayers", "diffcp", "clarabel")
PACKAGES += ("qpsolvers",)


class Gradient(NamedTuple):
    """A gradient: `step` returns V(s+) and Q(s, a), and sets theta's ``grad``."""

    mpc: QPMPC
    batch: Transitions
    value: Callable[[Tensor, QuadraticProgram], Tensor]
    action_value: Callable[[Tensor, Tensor, QuadraticProgram], Tensor]

    def step(self) -> tuple[Tensor, Tensor]:
        for parameter in self.mpc.parameters():
            parameter.grad = None
        qp = self.mpc.quadratic_program()
        with torch.no_grad():
            V = self.value(self.batch.following, qp)
        Q = self.action_value(self.batch.s, self.batch.a, qp)
        value = Q.detach()
        minus_delta = (value - self.batch.cost).sub_(V, alpha=GAMMA)
        Q.backward(minus_delta.div_(float(len(V))))  # by an integer, torch would make a tensor
        return V, value

    def flat(self) -> Tensor:
        return torch.cat([p.grad.flatten() for p in self.mpc.parameters() if p.grad is not None])


def cold(mpc: QPMPC, batch: Transitions) -> Gradient:
    return Gradient(mpc, batch, mpc.value, mpc.action_value)


def warm(mpc: QPMPC, batch: Transitions) -> Gradient:
    """Warm-start from the same transitions' active sets at a theta changed by 0.1 %."""
    with torch.no_grad():
        theta = {name: p.clone() for name, p in mpc.named_parameters()}
        move(mpc, MOVED)
        of_V, of_Q = mpc.solve(batch.following).active, mpc.solve(batch.s, batch.a).active
        for name, parameter in mpc.named_parameters():
            parameter.copy_(theta[name])
    return Gradient(
        mpc,
        batch,
        lambda s, qp: mpc.solve(s, warm_start=of_V, qp=qp).value,
        lambda s, a, qp: mpc.solve(s, a, warm_start=of_Q, qp=qp).value,
    )


def peer(make: Callable[[], Values], mpc: QPMPC, batch: Transitions) -> Gradient:
    of = make()
    return Gradient(
        mpc, batch, lambda s, qp: of(qp, s), lambda s, a, qp: of(qp, torch.cat((s, a), -1))
    )


STARTS = {"": cold, ", warm": warm}
#: The solver of each row's QPMPC, and what makes a `Gradient` of it.
CONTENDERS: dict[str, tuple[str, Callable[[QPMPC, Transitions], Gradient]]] = {
    **{name: ("daqp", partial(peer, make)) for name, make in PEERS.items()},
    **{name + end: (name, STARTS[end]) for name in BACKENDS for end in STARTS},
}


@cache
def gradient(name: str, dense: bool, batch: int) -> Gradient:
    """Make a contender.

    Raises:
        ImportError: If its package is not installed.
    """
    solver, make = CONTENDERS[name]
    mpc = make_mpc(PAPER, dense=dense, solver=solver)
    return make(mpc, transitions(PAPER.n_x, PAPER.n_u, 1024).first(batch))


@cache
def truth(dense: bool, batch: int) -> tuple[Tensor, Tensor]:
    """Return the values of V and Q, and DAQP's gradient, which is exact but for rounding."""
    own = gradient("daqp", dense, batch)
    own.step()
    qp, pairs = own.mpc.quadratic_program(), torch.cat((own.batch.s, own.batch.a), -1)
    values = reference_values(qp, own.batch.following), reference_values(qp, pairs)
    return torch.cat(values), own.flat()


class Row(NamedTuple):
    """Medians of seconds, also of the reference between the rounds, and errors."""

    seconds: float
    reference: float
    value: float
    wrong: int
    count: int
    gradient: float


def timed(own: Gradient) -> tuple[float, tuple[Tensor, Tensor]]:
    torch.set_num_threads(1)
    began = time.perf_counter()
    values = own.step()
    return time.perf_counter() - began, values


def measured(name: str, dense: bool, batch: int) -> Row:
    own, others = gradient(name, dense, batch), []
    rounds, every = (PEERS_ROUNDS[batch], 1) if name in PEERS else ROUNDS[batch]
    values, direction = truth(dense, batch)
    if name not in PEERS or batch == 1:
        own.step()  # compiles
    times = []
    for k in range(rounds):
        if k % every == 0 and name != REFERENCE and batch <= 256:
            others.append(timed(gradient(REFERENCE, dense, batch))[0])
        nudge(own.mpc)
        seconds, found = timed(own)
        times.append(seconds)
    error = relative_error(torch.cat(found), values)
    off = float((own.flat() - direction).norm() / direction.norm())
    row = Row(
        float(np.median(times)),
        float(np.median(others)) if others else np.nan,
        float(error.max()),
        int((error > WRONG).sum()),
        len(error),
        off,
    )
    # The certificate bounds the KKT residual by 1e-6; the table counts larger errors of values.
    assert name in PEERS or (row.value < 1e-5 and off < 1e-4), f"{name}: {row}"
    return row


def gradients(rows: dict[str, dict[tuple[bool, int], Row]]) -> str:
    lines = []
    for name, mine in rows.items():
        cells = []
        for case in CASES:
            cells.append(significant(1e3 * mine[case].seconds) if case in mine else "")
            own = mine[case].reference if case in mine else np.nan
            if case in mine and REFERENCE in rows and np.isnan(own):  # not timed in turns
                own = rows[REFERENCE][case].seconds
            if name != REFERENCE and not np.isnan(own):
                cells[-1] += f" ({significant(own / mine[case].seconds)}x)"
        dense = [row for (is_dense, _), row in mine.items() if is_dense]
        worst = max(dense, key=lambda row: (row.wrong, row.value))
        wrong = f", {worst.wrong:,} of {worst.count:,} wrong" if worst.wrong else ""
        off = max(row.gradient for row in dense)
        lines.append([name, *cells, f"{worst.value:.0e}{wrong}", f"{off:.0e}"])
    head = [f"{batch:,}" + ("" if dense else ", banded") for dense, batch in CASES]
    return table(["batch of", *head, "value", "gradient"], lines)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.gradient")
    parser.add_argument("--only", nargs="+", choices=CONTENDERS, default=[*CONTENDERS])
    parser.add_argument("--write", action="store_true", help="write the table into the docs")
    options = parser.parse_args()
    rows: dict[str, dict[tuple[bool, int], Row]] = {}
    for name in options.only:
        cases = [case for case in CASES if case[1] <= PATIENCE.get(name, 1024)]
        try:
            rows[name] = {case: measured(name, *case) for case in cases}
        except ImportError as error:
            print(f"left out: {name} ({error})")
    versions = ", ".join(f"{name} {version(name)}" for name in PACKAGES if find_spec(name))
    text = (
        f"Measured in one run on {os.cpu_count()} cores with Python {platform.python_version()}, "
        f"{versions}. One thread; medians of wall-clock time after a warm-up.\n\nEach time, in ms, "
        "covers V on the next states, Q on the visited pairs, and the gradient in all of theta; "
        "brackets have the speed-up over ProxSuite's layer, timed in turns. On the right are the "
        "largest relative errors for a dense C: of values, with the number wrong by more than "
        f"1e-6, and of gradients.\n\n{gradients(rows)}"
    )
    publish(text, "benchmark", options.write)


if __name__ == "__main__":
    main()
