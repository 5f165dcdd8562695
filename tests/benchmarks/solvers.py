"""Solvers side by side as the horizon grows.

    pip install clarabel piqp osqp qpax cvxpylayers
    python -m tests.benchmarks.solvers --write

V of the benchmarks' QP with theta at rest: our solvers in a batch, with the certificate, and
others on the QP in full space, whose matrices each sets up once if it can. CPU time a QP on one
thread, the median of rounds in which the solvers take turns. A solver whose QP takes longer than
`PATIENCE` gets one round, and no larger size. A package that is not installed is left out.
"""

import argparse
import os
import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from importlib import import_module
from importlib.metadata import version
from importlib.util import find_spec

import numpy as np
import torch
from torch import Tensor

from tests.benchmarks.full_space import FullSpace
from tests.benchmarks.peers import clarabel_step, cvxpylayers, osqp_step, piqp_step, values_of
from tests.benchmarks.problems import Size, make_mpc, nudge, transitions
from tests.benchmarks.reference import reference_values, relative_error
from tests.benchmarks.table import publish, significant, table
from torch_qpmpc import QPMPC, solve_qp
from torch_qpmpc.mpc.layout import banded_matrix
from torch_qpmpc.qp.pipeline.batch import Programs
from torch_qpmpc.qp.solvers import BACKENDS

#: QPs in our batches, in the others' loops, and compared with the reference.
BATCH, LOOP, CHECKED = 32, 4, 2
ROUNDS, PATIENCE = 5, 1.0
#: The columns: whether C is dense, and N, which grows.
CASES = ((False, 20), (False, 200), (True, 5), (True, 20), (True, 100))
#: The batch of QPs with models of their own, whose entries differ by this.
MODELS, APART = 256, 0.02

Solve = Callable[[], Tensor]


def qpax_solver(full: FullSpace) -> Solve:
    """Make qpax, dense, compiled for the batch, in float64."""
    jax, qpax = import_module("jax"), import_module("qpax")
    jax.config.update("jax_enable_x64", True)
    G, h = full.one_sided()
    Q, A, G = (matrix.numpy() for matrix in (full.Q, full.A, G))
    vectors = full.p.numpy(), full.b.numpy(), h.numpy()
    batched = jax.jit(jax.vmap(lambda p, b, h: qpax.solve_qp(Q, p, A, b, G, h)[0]))
    return lambda: full.value(torch.from_numpy(np.array(batched(*vectors))))


#: Other packages' solvers in full space, by the package that they need.
PEERS: dict[str, tuple[str, Callable[[FullSpace], Solve]]] = {
    "PIQP, sparse": ("piqp", lambda full: values_of(full, piqp_step(full))),
    "Clarabel": ("clarabel", lambda full: values_of(full, clarabel_step(full))),
    "OSQP": ("osqp", lambda full: values_of(full, osqp_step(full, **COLD))),
    "qpax": ("qpax", qpax_solver),
}
#: OSQP's options.
COLD = {"max_iter": 100_000, "warm_starting": False}
#: Its compilation for parametric matrices takes tens of GiB for z with more entries than this.
LAYERS, LARGEST = "cvxpylayers", 500
CONDENSING = "condensing, a new theta"


def contenders(size: Size, dense: bool) -> Iterable[tuple[str, int, Callable[[], Solve]]]:
    """Yield each solver's name, the number of its QPs, and a function that sets it up."""
    states = transitions(size.n_x, size.n_u, BATCH).s
    for name in BACKENDS:
        mpc = make_mpc(size, dense=dense, solver=name)
        count = LOOP if name == "proxqp" else BATCH
        yield name, count, partial(partial, mpc.value, states[:count])
    qp = make_mpc(size, dense=dense).quadratic_program()
    for name, (package, make) in PEERS.items():
        if find_spec(package):
            yield name, LOOP, lambda make=make: make(FullSpace.of(qp, states[:LOOP]))
    if find_spec(LAYERS) and qp.n_z <= LARGEST:
        yield LAYERS, LOOP, lambda: partial(cvxpylayers(), qp, states[:LOOP])
    yield CONDENSING, 1, lambda: condensing(make_mpc(size, dense=dense), size)


def condensing(mpc: QPMPC, size: Size) -> Solve:
    """Make the elimination of C z = b, of a theta that has changed since the last round."""
    s = torch.zeros(1, size.n_x).double()

    def once() -> Tensor:
        nudge(mpc)
        n = size.n_x + size.n_u
        programs, _ = Programs.of(*mpc.quadratic_program().tensors(), s, n_kept=n)
        return torch.from_numpy(programs.prepared.condensed(n).T[0])

    return once


@torch.no_grad()
def measured(size: Size, dense: bool, left_out: set[str]) -> dict[str, tuple[float, float | None]]:
    """Return the CPU seconds a QP of each solver, and its largest relative error of a value.

    Adds to ``left_out`` whatever is too slow for a larger size.
    """
    mpc = make_mpc(size, dense=dense)
    states = transitions(size.n_x, size.n_u, BATCH).s[:CHECKED]
    truth = reference_values(mpc.quadratic_program(), states)
    solves: dict[str, tuple[int, Solve]] = {}
    seconds: dict[str, list[float]] = {}
    errors: dict[str, float | None] = {}
    for name, count, make in contenders(size, dense):
        if name in left_out:
            continue
        solve = make()
        taken, result = timed(solve)  # compiles what is compiled at first use
        error = None if name == CONDENSING else relative_error(result[:CHECKED], truth)
        errors[name] = None if error is None else float(error.max())
        if taken > PATIENCE * count:
            taken, _ = timed(solve)
        seconds[name] = [taken / count]
        if taken > PATIENCE * count:
            left_out.add(name)
        else:
            solves[name] = count, solve
            seconds[name] = []
    for _ in range(ROUNDS):
        for name, (count, solve) in solves.items():
            seconds[name].append(timed(solve)[0] / count)
    return {name: (float(np.median(times)), errors[name]) for name, times in seconds.items()}


def timed(solve: Solve) -> tuple[float, Tensor]:
    began = time.process_time()
    result = solve()
    return time.process_time() - began, result


def series() -> str:
    left_out: dict[bool, set[str]] = {False: set(), True: set()}
    columns = []
    for dense, horizon in CASES:
        size = Size(horizon, 4, 2)
        columns.append(measured(size, dense, left_out[dense]))
        for name, (taken, error) in columns[-1].items():
            said = "" if error is None else f", error {error:.0e}"
            print(f"{size}, {name}: {1e3 * taken:.3g} ms{said}", flush=True)
    lines = []
    for name in dict.fromkeys(name for column in columns for name in column):
        cells = [significant(1e3 * column[name][0]) if name in column else "" for column in columns]
        largest = [e for c in columns if name in c and (e := c[name][1]) is not None]
        lines.append([name + (f" ({max(largest):.0e})" if largest else ""), *cells])
    head = [f"{'dense' if dense else 'banded'}, N = {horizon}" for dense, horizon in CASES]
    return table(["", *head], lines)


@torch.no_grad()
def own_models() -> str:
    """Compare QPs of own A_k and B_k with those of one model, whose theta has changed, too."""
    size, parts = Size(20, 8, 4), []
    mpc, s = make_mpc(size, dense=False), transitions(8, 4, MODELS).s
    A, B, horizon = mpc.scheme.model.A, mpc.scheme.model.B, size.horizon
    noise = torch.Generator().manual_seed(3)
    models = (
        [x + APART * torch.randn(horizon, *x.shape, generator=noise).double() for x in (A, B)]
        for _ in range(MODELS)
    )
    C = torch.stack([banded_matrix(x, u, horizon) for x, u in models])
    for own in (False, True):
        seconds = []
        for _ in range(ROUNDS + 1):
            nudge(mpc)
            qp = mpc.quadratic_program()
            qp = replace(qp, C=C) if own else qp
            seconds.append(timed(lambda qp=qp: solve_qp(qp, s, solver="daqp").value)[0])
        parts.append(float(np.median(seconds[1:])))
    return (
        f"{MODELS} QPs with own A_k, B_k, n_x = 8, n_u = 4, N = 20: "
        f"{significant(1e3 * parts[1] / MODELS)} ms each, "
        f"{significant(parts[1] / parts[0])} times one model's."
    )


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.solvers", description=__doc__)
    parser.add_argument("--write", action="store_true", help="write the tables into the docs")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false")
    times = series()
    packages = ["daqp", "proxsuite", "torch", *(p for p, _ in PEERS.values()), LAYERS]
    versions = ", ".join(f"{name} {version(name)}" for name in packages if find_spec(name))
    text = "\n\n".join(
        [
            f"Milliseconds a QP, with {versions}. In brackets the largest error of a value.",
            times,
            own_models(),
        ]
    )
    publish(text, "solvers", options.write)
    return 0


if __name__ == "__main__":
    sys.exit(main())
