"""The proof at a run's end (``prove=BOUND``): the first step from every start keeps the bounds."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np

from torch_qpmpc.envs.linear_system import LinearSystem
from torch_qpmpc.errors import QPError, SolverError
from torch_qpmpc.mpc.module import QPMPC
from torch_qpmpc.proofs import Plant, Polytope, largest_violation

#: Starts whose bounding box is the set.
STARTS = 1000


def prove_run(mpc: QPMPC, physics: Any, bound: float, quiet: bool) -> dict[str, Any]:
    """Return the entries of summary.json: ``proof``, a sentence, its ``value`` and its ``bound``.

    The states are the bounding box of a thousand starts, and each entry of the noise is within
    ``bound``. A question without an answer is a warning, and has no entries.
    """
    try:
        if not isinstance(physics, LinearSystem):
            got = type(physics).__name__
            raise QPError.expected("prove", got, "a linear plant of a bounded state")
        starts = physics.starts(np.random.default_rng(0), STARTS).numpy()
        n = starts.shape[1]
        noise = Polytope.box(-bound * np.ones(n), bound * np.ones(n))
        plant = Plant.of(physics.A.numpy(), physics.B.numpy(), disturbances=noise)
        box = Polytope.box(starts.min(0), starts.max(0))
        bounds = physics.lb_s.numpy(), physics.ub_s.numpy()
        answer = largest_violation(mpc, plant, box, *bounds)
    except (QPError, SolverError) as error:
        warnings.warn(f"Nothing is proved. {error}", stacklevel=2)
        return {}
    if not quiet:
        print(f"\nFrom every start, |nu| <= {bound:g}: {answer}")
    return {"proof": str(answer), "proof_value": answer.value, "proof_bound": answer.bound}
