"""Reference values for all contenders, computed outside the package."""

from __future__ import annotations

import scipy.sparse as sp
import torch
from torch import Tensor

from tests.benchmarks.full_space import FullSpace
from tests.benchmarks.peers import needs
from torch_qpmpc import QuadraticProgram

#: Relative value error above which an answer counts as wrong.
WRONG = 1e-6


@torch.no_grad()
def reference_values(qp: QuadraticProgram, fixed: Tensor) -> Tensor:
    """Compute optimal values ``(B,)`` by Clarabel in full space, at tight tolerances."""
    clarabel = needs("clarabel")
    full = FullSpace.of(qp, fixed)
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-11
    G, h = full.one_sided()
    rows, right = sp.csc_matrix(torch.cat((full.A, G))), torch.cat((full.b, h), dim=1).numpy()
    Q = sp.csc_matrix(full.Q.triu())
    cones = [clarabel.ZeroConeT(len(full.A)), clarabel.NonnegativeConeT(len(G))]
    x = []
    for p, r in zip(full.p.numpy(), right, strict=True):
        solution = clarabel.DefaultSolver(Q, p, rows, r, cones, settings).solve()
        if "Solved" not in str(solution.status):
            raise RuntimeError(f"no reference value: {solution.status}")
        x.append(solution.x)
    return full.value(torch.tensor(x, dtype=torch.float64))


def relative_error(values: Tensor, reference: Tensor) -> Tensor:
    """Compute errors relative to the reference, or to 1 where that is larger."""
    error = (values - reference).abs() / reference.abs().clamp(min=1)
    return error.nan_to_num(torch.inf)
