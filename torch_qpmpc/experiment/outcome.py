"""What a run does with its learned policy at its end: ``export=c`` and ``prove=BOUND``."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np

from torch_qpmpc.envs.linear_system import LinearSystem
from torch_qpmpc.errors import QPError, SolverError
from torch_qpmpc.export.export import export_c
from torch_qpmpc.mpc.module import QPMPC
from torch_qpmpc.proofs import Plant, Polytope, largest_violation

#: The folder of the C files in that of the run.
FOLDER = "c"


def export_run(mpc: QPMPC, path: Path, quiet: bool) -> None:
    """Write the policy as C into the run's folder; warn if that is not possible."""
    try:
        export = export_c(mpc, path / FOLDER)
    except QPError as error:
        # The run's results are worth more than its export, which can be repeated.
        warnings.warn(f"The policy is not exported. {error}", stacklevel=2)
        return
    if not quiet:
        print(f"\n{export}")


def check_provable(physics: Any) -> None:
    """Raise `QPError` unless the plant is a `LinearSystem` that knows its starts."""
    if not isinstance(physics, LinearSystem) or physics.start_box() is None:
        got, want = f"a {type(physics).__name__}", "a LinearSystem with a start_box"
        remedy = "Use task=point_mass or task=gros_zanon."
        raise QPError.expected("prove", got, want, remedy)


def prove_run(mpc: QPMPC, physics: Any, bound: float, quiet: bool) -> dict[str, Any]:
    """Bound the states after the first step from every start, with noise within ``bound``.

    Returns:
        The entries of summary.json: ``proof``, a sentence, its ``value`` and its ``bound``; none,
        but a warning, if the question has no answer.

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
