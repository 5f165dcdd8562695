"""How the cost of V grows with the horizon, by solver, with theta at rest; and that of condensing.

PIQP's sparse solver on the QP in its full space is the yardstick for a banded C: its cost grows in
proportion to N.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.benchmarks.full_space import FullSpace
from tests.benchmarks.peers import piqp_solver
from tests.benchmarks.problems import Size, make_mpc, nudge, transitions
from tests.benchmarks.reference import WRONG, reference_values, relative_error
from torch_qpmpc.qp.pipeline.batch import Programs
from torch_qpmpc.qp.solvers import BACKENDS

pytest.importorskip("pytest_benchmark", reason="benchmarks need pip install '.[bench]'")

YARDSTICK = "PIQP, sparse"
BATCH, ROUNDS = 64, 5
#: Smaller batch for problems that would take seconds; the table has the time per QP.
SMALL_BATCH = {"proxqp": 8, YARDSTICK: 8}
#: Number of QPs compared with the reference, which takes seconds for each large one.
CHECKED = 2
DIMENSIONS = ((4, 2), (12, 4))
HORIZONS = (10, 20, 40)
#: Horizons at which a solver linear in N should be faster than condensing, if at any.
FURTHER = [Size(80, 4, 2), Size(160, 4, 2)]
SIZES = [Size(horizon, *dimension) for dimension in DIMENSIONS for horizon in HORIZONS]


def _cases() -> list[Any]:
    cases = [(size, dense, name) for size in SIZES for dense in (True, False) for name in BACKENDS]
    cases += [(size, False, YARDSTICK) for size in SIZES]
    cases += [(size, False, name) for size in FURTHER for name in ("daqp", YARDSTICK)]
    return [
        pytest.param(*case, id=f"{case[2].replace(' ', '_')}-{_kind(case[1])}-{case[0]}")
        for case in cases
    ]


def _kind(dense: bool) -> str:
    return "dense" if dense else "banded"


@pytest.mark.parametrize(("size", "dense", "name"), _cases())
def test_value(
    benchmark: Any, interleaved: Callable[..., Any], size: Size, dense: bool, name: str
) -> None:
    mpc = make_mpc(size, dense=dense, solver=name if name in BACKENDS else "daqp")
    batch = SMALL_BATCH.get(name, BATCH)
    states = transitions(size.n_x, size.n_u, BATCH).s[:batch]
    if name in BACKENDS:
        solve = torch.no_grad()(lambda: mpc.value(states))
    else:
        solve = piqp_solver(FullSpace.of(mpc.quadratic_program(), states))
    values = interleaved(solve, rounds=ROUNDS)
    error = relative_error(values[:CHECKED], _true_values(size, dense))
    benchmark.extra_info |= {
        "row": name,
        "dense": dense,
        "horizon": size.horizon,
        "dimensions": [size.n_x, size.n_u],
        "batch": batch,
        "value_error": float(error.max()),
        "wrong": int((error > WRONG).sum()),
        "solved": CHECKED,
    }
    assert name not in BACKENDS or error.max() < 1e-5


@pytest.mark.parametrize("size", SIZES, ids=str)
def test_condensing(benchmark: Any, interleaved: Callable[..., Any], size: Size) -> None:
    """Time condensing alone, of a theta that has changed since the last round."""
    mpc = make_mpc(size, dense=True)
    n, s = size.n_x + size.n_u, torch.zeros(1, size.n_x).double()

    def once() -> np.ndarray:
        programs, _ = Programs.of(*mpc.quadratic_program().tensors(), s, n_kept=n)
        return programs.prepared.condensed(n).arrays.T

    T = interleaved(once, rounds=4 * ROUNDS, before=lambda: nudge(mpc))
    benchmark.extra_info |= {
        "row": "condensing",
        "dense": True,
        "horizon": size.horizon,
        "dimensions": [size.n_x, size.n_u],
        "batch": 1,
    }
    # T spans the null space of C.
    assert np.abs(mpc.C.numpy(force=True) @ T[0]).max() < 1e-9


@cache
def _true_values(size: Size, dense: bool) -> Tensor:
    mpc = make_mpc(size, dense=dense)
    states = transitions(size.n_x, size.n_u, BATCH).s[:CHECKED]
    return reference_values(mpc.quadratic_program(), states)
