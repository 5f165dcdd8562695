"""Fill Numba's cache on disk with the kernels that the tests share: ``python -m tests.kernels``."""

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
    import numpy as np

    import train
    from tests.campaign.families import FAMILIES, Draw
    from tests.runs import SMALL, make_config
    from torch_qpmpc import QPMPC, identify, solve_qp

    with tempfile.TemporaryDirectory() as folder:
        train.train(make_config(*SMALL, "optimizer=gauss_newton"), folder, quiet=True)
    case = FAMILIES["scaled cost"](Draw(7), 3)
    solve_qp(case.known.qp, case.known.fixed, solver="daqp")
    weights = {"stage_weight": [1.0, 1.0], "action_levels": [(0.0, 1.0)]}
    QPMPC.from_model([[0.9]], [[0.5]], 3, **weights).predict([1.0])
    y, u = np.random.default_rng(0).normal(size=(2, 40))
    identify({"y": y, "u": u}, 1, order=1)
    DONE.parent.mkdir(exist_ok=True)
    DONE.touch()


if __name__ == "__main__":
    compile_kernels()
