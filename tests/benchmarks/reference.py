"""The values that every contender's are compared with, from outside the package."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
import torch
from torch import Tensor

from tests.benchmarks.full_space import INFINITE, FullSpace
from tests.benchmarks.peers import needs
from torch_qpmpc import QuadraticProgram

#: Relative value error above which an answer counts as wrong.
WRONG = 1e-6


@torch.no_grad()
def reference_values(qp: QuadraticProgram, fixed: Tensor) -> Tensor:
    """Optimal values ``(B,)`` by Clarabel in the full space, at tight tolerances."""
    clarabel = needs("clarabel")
    full = FullSpace.of(qp, fixed)
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-11
    has_upper, has_lower = (full.u[0] < INFINITE).numpy(), (full.l[0] > -INFINITE).numpy()
    G = full.G.numpy()
    rows = sp.csc_matrix(np.vstack([full.A.numpy(), G[has_upper], -G[has_lower]]))
    Q = sp.csc_matrix(np.triu(full.Q.numpy()))
    n_eq, n_in = len(full.A), int(has_upper.sum() + has_lower.sum())
    cones = [clarabel.ZeroConeT(n_eq), clarabel.NonnegativeConeT(n_in)]
    x = []
    for p, b, lower, upper in zip(full.p, full.b, full.l, full.u, strict=True):
        right = np.concatenate([b, upper[has_upper], -lower[has_lower]])
        solution = clarabel.DefaultSolver(Q, p.numpy(), rows, right, cones, settings).solve()
        if "Solved" not in str(solution.status):
            raise RuntimeError(f"no reference value: {solution.status}")
        x.append(solution.x)
    return full.value(torch.tensor(x, dtype=torch.float64))


def relative_error(values: Tensor, reference: Tensor) -> Tensor:
    """Elementwise, relative to the reference or to 1 where that is larger."""
    error = (values - reference).abs() / reference.abs().clamp(min=1)
    return error.nan_to_num(torch.inf)
