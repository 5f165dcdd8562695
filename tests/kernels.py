"""Fill Numba's cache on disk with the kernels that the tests share: ``python -m tests.kernels``."""

from __future__ import annotations

import tempfile

import train
from tests.runs import SMALL, make_config


def compile_kernels() -> None:
    """Train briefly with either order of optimiser, which calls nearly every kernel."""
    for optimizer in ("gauss_newton", "adam"):
        with tempfile.TemporaryDirectory() as folder:
            train.train(make_config(*SMALL, f"optimizer={optimizer}"), folder, quiet=True)


if __name__ == "__main__":
    compile_kernels()
