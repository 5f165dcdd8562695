"""Fill Numba's cache on disk with the kernels that the tests share: ``python -m tests.kernels``."""

from __future__ import annotations

import tempfile

import train
from tests.campaign.families import FAMILIES, Draw
from tests.runs import SMALL, make_config
from torch_qpmpc import solve_qp


def compile_kernels() -> None:
    """Train briefly and solve a QP of large numbers, which calls nearly every kernel."""
    for override in ("optimizer=gauss_newton", "optimizer=adam", "step=projection"):
        with tempfile.TemporaryDirectory() as folder:
            train.train(make_config(*SMALL, override), folder, quiet=True)
    case = FAMILIES["scaled cost"](Draw(7), 3)
    solve_qp(case.known.qp, case.known.fixed, solver="daqp")


if __name__ == "__main__":
    compile_kernels()
