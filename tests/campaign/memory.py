"""Memory over many QPs: ``python -m tests.campaign.memory --count 1000000 --solver daqp``.

As in training, theta changes, and V and its gradient are computed. After a tenth of the QPs the
process may grow by no more than `GROWTH`.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import torch
from tqdm import tqdm

from tests.problems import random_mpc, random_states
from torch_qpmpc.qp.solvers import BACKENDS

BATCH, GROWTH = 256, 0.05


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.campaign.memory", description=__doc__)
    parser.add_argument("--count", type=int, default=1_000_000, help="QPs")
    parser.add_argument("--solver", default="daqp", help=f"{', '.join(BACKENDS)}, or another")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    sizes = resident(options.solver, -(-options.count // BATCH))
    warm = sizes[len(sizes) // 10 :]
    growth = max(warm) / warm[0] - 1
    print(f"{options.solver}: {warm[0]:.0f} MiB after a tenth, then up to {growth:+.1%}")
    return int(growth > GROWTH)


def resident(solver: str, batches: int) -> list[float]:
    """Measure the memory in MiB after each batch."""
    mpc = random_mpc(0, horizon=10, solver=solver, on_failure="mask")
    optimizer = torch.optim.SGD(mpc.parameters(), lr=1e-9)
    sizes = []
    for seed in tqdm(range(batches), desc=solver, mininterval=5):
        optimizer.zero_grad()
        values = mpc.value(random_states(BATCH, seed=seed))
        torch.where(values.isfinite(), values, 0).sum().backward()
        optimizer.step()
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
        sizes.append(pages * 4096 / 2**20)
    return sizes


if __name__ == "__main__":
    sys.exit(main())
