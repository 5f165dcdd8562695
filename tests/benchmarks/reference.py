"""Reference values for all contenders, computed outside the package."""

import torch
from torch import Tensor

from tests.benchmarks.full_space import FullSpace
from tests.benchmarks.peers import clarabel_step, values_of
from torch_qpmpc import QuadraticProgram

#: Relative value error above which an answer counts as wrong.
WRONG = 1e-6


@torch.no_grad()
def reference_values(qp: QuadraticProgram, fixed: Tensor) -> Tensor:
    """Compute optimal values ``(B,)`` by Clarabel in full space, at tight tolerances."""
    full = FullSpace.of(qp, fixed)
    return values_of(full, clarabel_step(full, 1e-11))()


def relative_error(values: Tensor, reference: Tensor) -> Tensor:
    """Compute errors relative to the reference, or to 1 where that is larger."""
    error = (values - reference).abs() / reference.abs().clamp(min=1)
    return error.nan_to_num(torch.inf)
