"""Fill Numba's cache on disk with the kernels that the tests share: ``python -m tests.kernels``."""

from __future__ import annotations

import tempfile
from pathlib import Path

FOLDER = Path(__file__).parents[1] / "torch_qpmpc" / "qp" / "kernels"
#: Written when all kernels are compiled.
DONE = FOLDER / "__pycache__" / "compiled"


def up_to_date() -> bool:
    """Compare the time of the last compilation with those of the kernels' files."""
    changed = max(file.stat().st_mtime for file in FOLDER.glob("*.py"))
    return DONE.exists() and DONE.stat().st_mtime > changed


def compile_kernels() -> None:
    """Train briefly, solve a QP of large numbers, and call what remains, by itself."""
    import numpy as np

    import train
    from tests.campaign.families import FAMILIES, Draw
    from tests.runs import SMALL, make_config
    from torch_qpmpc import solve_qp
    from torch_qpmpc.mpc.subspace import recursion, spread
    from torch_qpmpc.qp.solvers.daqp import tour

    for override in ("optimizer=gauss_newton", "optimizer=adam", "step=projection"):
        with tempfile.TemporaryDirectory() as folder:
            train.train(make_config(*SMALL, override), folder, quiet=True)
    case = FAMILIES["scaled cost"](Draw(7), 3)
    solve_qp(case.known.qp, case.known.fixed, solver="daqp")
    one = np.zeros((1, 1, 1, 1))
    recursion(one, one[0], one[0, 0])
    spread(one, one, one[0])
    tour(one[0, 0], 1)
    DONE.parent.mkdir(exist_ok=True)
    DONE.touch()


if __name__ == "__main__":
    compile_kernels()
