"""The torch backend on a GPU beside DAQP on the CPU, and qpax and Moreau on the same GPU.

    python -m tests.benchmarks.gpu --write

Medians of wall-clock time, with the device synchronised. The QPs are the point mass's with a dense
C and N = 10; all of theta is learned. qpax (with JAX for the GPU) and Moreau are skipped if not
installed.
"""

import argparse
import multiprocessing
import os
import sys
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import torch
from torch import Tensor

import torch_qpmpc as qm
from tests.benchmarks.full_space import FullSpace
from tests.benchmarks.peers import moreau
from tests.benchmarks.problems import PAPER, make_mpc, transitions
from tests.benchmarks.reference import relative_error
from tests.benchmarks.table import publish, significant, table

GPU = torch.device("cuda")
BATCHES = (4_096, 65_536, 262_144)
#: The batch of the comparison, and of the peers' rows: qpax needs more memory.
LARGE, OF_PEERS = 65_536, 16_384
ROUNDS = 7


def seconds(run: Callable[[], object]) -> float:
    """Return the median wall-clock time of ``run``, after two rounds to warm up."""
    times = []
    for _ in range(ROUNDS + 2):
        torch.cuda.synchronize()
        began = time.perf_counter()
        run()
        torch.cuda.synchronize()
        times.append(time.perf_counter() - began)
    return sorted(times[2:])[ROUNDS // 2]


# The curve over batches


def curve() -> str:
    """Return the table of times a QP and of memory, by batch."""
    mpc = make_mpc(PAPER, dense=True, solver="torch").to(GPU)
    exact = make_mpc(PAPER, dense=True, solver="daqp")
    lines = []
    for batch in BATCHES:
        data = transitions(PAPER.n_x, PAPER.n_u, batch)
        s, a = data.s.to(GPU), data.a.to(GPU)
        with torch.no_grad():
            error = relative_error(mpc.value(s).cpu(), exact.value(data.s)).max()
            torch.cuda.reset_peak_memory_stats()
            cold = seconds(lambda s=s: mpc.value(s))
            memory = torch.cuda.max_memory_allocated() / 2**20

        def gradient(value: Callable[[], Tensor]) -> float:
            def run() -> None:
                mpc.zero_grad()
                value().sum().backward()

            return seconds(run)

        of_Q = gradient(lambda s=s, a=a: mpc.action_value(s, a))
        of_pi = gradient(lambda s=s: mpc.policy(s))
        times = (significant(1e6 * x / batch) for x in (cold, of_Q, of_pi))
        lines.append([f"{batch:,}", *times, f"{memory:,.0f}; {error:.0e}"])
    head = ["batch", "V", "Q and gradient", "policy and gradient"]
    return table([*head, "MiB; error"], lines)


# Beside DAQP, qpax and Moreau


def solved_by_daqp(count: int, first: int, warm: bool) -> float:
    """Solve ``count`` states after ``first`` with DAQP on one thread; return the seconds."""
    torch.set_num_threads(1)
    mpc, s = _by_daqp(first, count)
    with torch.no_grad():
        active = _active(first, count) if warm else None
        began = time.perf_counter()
        mpc.solve(s, warm_start=active)
    return time.perf_counter() - began


@cache
def _by_daqp(first: int, count: int) -> tuple[qm.QPMPC, Tensor]:
    mpc, states = make_mpc(PAPER, dense=True), transitions(PAPER.n_x, PAPER.n_u, LARGE).s
    mpc.value(states[:64])  # compiles
    return mpc, states[first : first + count]


@cache
def _active(first: int, count: int) -> Tensor:
    mpc, s = _by_daqp(first, count)
    return mpc.solve(s).active


def on_cores(cores: int) -> list[float]:
    """Return the seconds of `LARGE` QPs by DAQP, cold and warm, in one process a core."""
    context = multiprocessing.get_context("spawn")
    share = LARGE // cores
    parts = [(share, i * share) for i in range(cores)]
    with ProcessPoolExecutor(cores, mp_context=context) as pool:
        results = []
        for warm in (False, True):
            rounds = []
            for _ in range(4):  # the first warms up
                done = [pool.submit(solved_by_daqp, *part, warm) for part in parts]
                rounds.append(max(x.result() for x in done))
            results.append(sorted(rounds[1:])[1])
    return results


def by_qpax() -> tuple[float, float] | None:
    """Return qpax's seconds, and its largest relative error of a value; None without it."""
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    if find_spec("jax") is None or find_spec("qpax") is None:
        return None
    jax, jnp, qpax = map(import_module, ("jax", "jax.numpy", "qpax"))
    jax.config.update("jax_enable_x64", True)
    mpc, s = make_mpc(PAPER, dense=True), transitions(PAPER.n_x, PAPER.n_u, OF_PEERS).s
    with torch.no_grad():
        full = FullSpace.of(mpc.quadratic_program(), s)
        G, h = full.one_sided()
        expected = mpc.value(s)
    Q, A, G = (jnp.asarray(x.numpy()) for x in (full.Q, full.A, G))

    def one(p: Any, b: Any, h: Any) -> Any:
        return qpax.solve_qp(Q, p, A, b, G, h)[0]

    solve, data = jax.jit(jax.vmap(one)), [jnp.asarray(x.numpy()) for x in (full.p, full.b, h)]
    x = torch.from_numpy(jax.device_get(solve(*data)).copy())
    with torch.no_grad():
        error = relative_error(full.value(x), expected).max()
    return seconds(lambda: solve(*data).block_until_ready()), float(error)


def by_moreau() -> tuple[float, float] | None:
    """Return the seconds of Moreau's interior point, and its largest relative error of a value."""
    if find_spec("moreau") is None:
        return None
    mpc, s = make_mpc(PAPER, dense=True), transitions(PAPER.n_x, PAPER.n_u, OF_PEERS).s
    values = moreau(GPU.type, "ipm")
    with torch.no_grad():
        expected = mpc.value(s)
        qp, on_gpu = mpc.to(GPU).quadratic_program(), s.to(GPU)
        error = relative_error(values(qp, on_gpu).cpu(), expected).max()
        return seconds(lambda: values(qp, on_gpu)), float(error)


def comparison() -> str:
    """Return the table of all solvers at one batch, in microseconds a QP."""
    mpc = make_mpc(PAPER, dense=True, solver="torch").to(GPU)
    s = transitions(PAPER.n_x, PAPER.n_u, LARGE).s.to(GPU)
    with torch.no_grad():
        times = [seconds(lambda: mpc.solve(s))]
    cores = os.cpu_count() or 1
    rows = [("torch, GPU", LARGE, times), ("daqp, one core", LARGE, on_cores(1))]
    rows.append((f"daqp, {cores} cores", LARGE, on_cores(cores)))
    for name, of in {"qpax": by_qpax, "Moreau": by_moreau}.items():
        if (peer := of()) is not None:
            rows.append((f"{name}, GPU (error {peer[1]:.0e})", OF_PEERS, [peer[0]]))
    lines = [
        [name, f"{batch:,}", *(significant(1e6 * x / batch) for x in each), *[""] * (2 - len(each))]
        for name, batch, each in rows
    ]
    return table(["", "batch", "cold", "warm"], lines)


def report() -> str:
    return "\n\n".join(
        (
            f"On one {torch.cuda.get_device_name()}, with torch {torch.__version__} and "
            f"{os.cpu_count()} CPU cores.",
            "**By batch**, in microseconds per QP. Memory is the peak while V is computed; the "
            "error is the largest of a value, against DAQP:",
            curve(),
            "**Beside other solvers**, in microseconds per QP:",
            comparison(),
        )
    )


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.gpu", description=__doc__)
    parser.add_argument("--write", action="store_true", help="write the tables to the page")
    options = parser.parse_args(arguments)
    if not torch.cuda.is_available():
        raise SystemExit("python -m tests.benchmarks.gpu: torch sees no CUDA device")
    publish(report(), "gpu", options.write)


if __name__ == "__main__":
    main(sys.argv[1:])
