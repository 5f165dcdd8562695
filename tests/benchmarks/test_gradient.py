"""One Q-learning gradient (V, Q, and the gradient in all of theta), ours and others'.

Each contender's rounds have rounds of ProxSuite's layer between them, up to batch 256; theta moves
in its last digits before each, so that nothing computed from it can be used twice.
"""

from collections.abc import Callable
from functools import cache
from typing import Any

import pytest
import torch
from torch import Tensor

from tests.benchmarks.contenders import BATCHES, CONTENDERS, REFERENCE, Contender, Gradient
from tests.benchmarks.problems import PAPER, make_mpc, nudge, transitions
from tests.benchmarks.reference import WRONG, reference_values, relative_error
from tests.benchmarks.table import CASES as COLUMNS

pytest.importorskip("pytest_benchmark", reason="benchmarks need pip install '.[bench]'")

#: Rounds of a fast contender by batch, and the number of them between two of the reference.
ROUNDS = {1: (60, 15), 256: (60, 15), 1024: (9, 3)}
SLOW_ROUNDS = {1: 5, 256: 1, 1024: 1}
#: Batches with interleaved rounds of the reference.
INTERLEAVED = (1, 256)

CASES = [
    pytest.param(contender, dense, batch, id=f"{'dense' if dense else 'banded'}-{batch}-{label}")
    for dense, batch in COLUMNS
    for contender in CONTENDERS
    if batch <= contender.largest
    for label in [contender.label.replace(" ", "_")]
]


@pytest.mark.parametrize(("contender", "dense", "batch"), CASES)
def test_gradient(
    benchmark: Any, interleaved: Callable[..., Any], contender: Contender, dense: bool, batch: int
) -> None:
    gradient = contender.gradient(dense, batch)
    against = batch in INTERLEAVED and contender.label != REFERENCE
    rounds, every = ROUNDS[batch] if contender.fast else (SLOW_ROUNDS[batch], 1)
    values = interleaved(
        gradient.step,
        rounds=rounds,
        warmup=1 if contender.fast or batch <= 32 else 0,
        before=lambda: nudge(gradient.mpc),
        reference=_reference(dense, batch).step if against else None,
        every=every,
    )
    error = relative_error(torch.cat(values), torch.cat(_true_values(dense, batch)))
    direction = _true_gradient(dense, batch)
    benchmark.extra_info |= {
        "row": contender.label,
        "dense": dense,
        "batch": batch,
        "value_error": float(error.max()),
        "wrong": int((error > WRONG).sum()),
        "solved": len(error),
        "gradient_error": float((gradient.flat() - direction).norm() / direction.norm()),
    }
    if contender.ours:
        # The certificate bounds the KKT residual by 1e-6; the table counts larger errors of values.
        assert error.max() < 1e-5
        assert benchmark.extra_info["gradient_error"] < 1e-4


@cache
def _reference(dense: bool, batch: int) -> Gradient:
    contender = next(c for c in CONTENDERS if c.label == REFERENCE)
    return contender.gradient(dense, batch)


@cache
def _all_values(dense: bool) -> tuple[Tensor, Tensor]:
    qp = make_mpc(PAPER, dense=dense).quadratic_program()
    data = transitions(PAPER.n_x, PAPER.n_u, BATCHES[-1])
    pairs = torch.cat((data.s, data.a), dim=-1)
    return reference_values(qp, data.following), reference_values(qp, pairs)


def _true_values(dense: bool, batch: int) -> tuple[Tensor, Tensor]:
    V, Q = _all_values(dense)
    return V[:batch], Q[:batch]


@cache
def _true_gradient(dense: bool, batch: int) -> Tensor:
    """Compute the gradient by DAQP: an active-set solver's multipliers are exact up to rounding."""
    contender = next(c for c in CONTENDERS if c.label == "daqp")
    gradient = contender.gradient(dense, batch)
    gradient.step()
    return gradient.flat()
