"""How far a call travels through the package's files: ``python -m tests.benchmarks.stays``.

A *stay* is a run of calls in one file, and a *return* a stay in a file that was left before. Traced
is the second V of one state for each solver, and a step of a controller; a reader of the call
changes page as often.
"""

import itertools
import sys
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple

import torch

import torch_qpmpc as qm
from torch_qpmpc.qp.solvers import BACKENDS
from torch_qpmpc.study.markdown import table

ROOT = Path(qm.__file__).parent.as_posix()


class Journey(NamedTuple):
    """The numbers of stays, returns and files of a call."""

    stays: int
    returns: int
    files: int


def traced(call: Callable[[], Any]) -> Journey:
    """Trace a call that has been made before, so that nothing is compiled or prepared."""
    files: list[str] = []

    def note(frame: FrameType, event: str, _: Any) -> None:
        if event == "call" and frame.f_code.co_filename.startswith(ROOT):
            files.append(frame.f_code.co_filename)

    before = sys.getprofile()
    sys.setprofile(note)
    try:
        call()
    finally:
        sys.setprofile(before)
    stays = [file for file, _ in itertools.groupby(files)]
    return Journey(len(stays), len(stays) - len(set(stays)), len(set(stays)))


def of_value(solver: str) -> Journey:
    """Trace V of one state."""
    options: dict[str, Any] = {"stage_weight": [1.0, 0.1, 0.01], "solver": solver}
    options |= {"state_bounds": ([-1.0, -1.0], [1.0, 1.0]), "action_bounds": ([-1.0], [1.0])}
    mpc = qm.QPMPC.from_model([[1.0, 0.1], [0.0, 0.9]], [[0.0], [0.1]], 10, **options)
    s = torch.tensor([[0.3, -0.2]], dtype=torch.float64)
    mpc.value(s)
    return traced(lambda: mpc.value(s))


def of_step() -> Journey:
    """Trace a step of a controller."""
    model = [[1.0, 0.1], [0.0, 0.9]], [[0.0], [0.1]], [[1.0, 0.0]]
    controller = qm.Controller(qm.LinearMPC(model, 10, Q=[1.0], dR=[0.1], u_bounds=(-1.0, 1.0)))
    controller.step([0.1], [0.5])
    return traced(lambda: controller.step([0.1], [0.5]))


if __name__ == "__main__":
    journeys = {f"V, {name}": of_value(name) for name in BACKENDS} | {"step": of_step()}
    rows = [[name, *map(str, journey)] for name, journey in journeys.items()]
    print(table(["", "stays", "returns", "files"], rows))
