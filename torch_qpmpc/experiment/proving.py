"""The proof at a run's end (``prove=BOUND``): the first step from every start keeps the bounds."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np

from torch_qpmpc.envs.linear_system import LinearSystem
from torch_qpmpc.errors import QPError, SolverError
from torch_qpmpc.mpc.module import QPMPC
from torch_qpmpc.proofs import Plant, Polytope, largest_violation


def check_provable(physics: Any) -> None:
    """Raise `QPError` unless the plant is a `LinearSystem` that knows its starts."""
    if not isinstance(physics, LinearSystem) or physics.start_box() is None:
        got, want = f"a {type(physics).__name__}", "a LinearSystem with a start_box"
        remedy = "Use task=point_mass or task=gros_zanon."
        raise QPError.expected("prove", got, want, remedy)


def prove_run(mpc: QPMPC, physics: Any, bound: float, quiet: bool) -> dict[str, Any]:
    """Return the entries of summary.json: ``proof``, a sentence, its ``value`` and its ``bound``.

    The states are the box of all starts, and each entry of the noise is within ``bound``. A
    question without an answer is a warning, and has no entries.

    Raises:
        QPError: the plant is not a linear one with a box of starts.
    """
    check_provable(physics)
    lower, upper = (x.numpy() for x in physics.start_box() or ())
    noise = Polytope.box(*(sign * bound * np.ones(len(lower)) for sign in (-1, 1)))
    plant = Plant.of(physics.A.numpy(), physics.B.numpy(), disturbances=noise)
    bounds = physics.lb_s.numpy(), physics.ub_s.numpy()
    try:
        answer = largest_violation(mpc, plant, Polytope.box(lower, upper), *bounds)
    except (QPError, SolverError) as error:
        warnings.warn(f"Nothing is proved. {error}", stacklevel=2)
        return {}
    if not quiet:
        print(f"\nFrom every start, |nu| <= {bound:g}: {answer}")
    return {"proof": str(answer), "proof_value": answer.value, "proof_bound": answer.bound}
