"""The outcome of each QP of a case, judged by its known solution instead of the package.

A solution is right if it satisfies C z = b, the fixed entries and the hard rows, if its value and
the cost of its z equal the known value, and if z is near the known z* in the norm of H:
1/2 (z - z*)'H(z - z*) is at most the excess cost of z. All errors are relative to the sum of the
absolute terms of the Lagrangian at the known solution.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from tests.campaign.draws import ACCURACY
from tests.campaign.families import Case
from tests.problems import times
from torch_qpmpc import Status
from torch_qpmpc.qp.kernels.sample import CANCELLED
from torch_qpmpc.qp.solution import QPSolution, slacks
from torch_qpmpc.qp.solve import EVENT_NDIMS

#: Tolerance of a value, relative to the largest of its own terms at the known or at its solution.
VALUE = 1e-6
#: Accuracy of the known value, relative to the terms of the Lagrangian.
KNOWN = 1e-9


@dataclass(frozen=True)
class Outcome:
    """Masks ``(B,)``, with each QP in one of them, and the error of certified solutions."""

    certified: Tensor
    named: Tensor
    missed: Tensor
    wrong: Tensor
    error: Tensor


def judge(case: Case, solution: QPSolution) -> Outcome:
    status, expected = solution.status, case.expected
    error = relative_errors(case, solution)
    hopeless = (expected == Status.INFEASIBLE) | (expected == Status.UNBOUNDED)
    certified = (status == Status.SOLVED) & ~hopeless & (error <= case.accuracy)
    named = (status == expected) & (status != Status.SOLVED)
    missed = status == Status.NOT_CONVERGED
    error = torch.where(status == Status.SOLVED, error, 0)
    return Outcome(certified, named, missed, ~(certified | named | missed), error)


def relative_errors(case: Case, solution: QPSolution) -> Tensor:
    """Compute the largest relative error of each solution, ``(B,)``; inf for non-finite ones."""
    known = case.known
    H, q, c, C, b, G, lb, ub, w = (x.double() for x in known.qp.tensors())
    star, z, fixed = known.z.double(), solution.z.detach().double(), known.fixed.double()
    n_f = fixed.shape[-1]

    def terms(*pairs: tuple[Tensor, Tensor]) -> Tensor:
        return torch.stack([(a * b).abs().sum(-1).expand(star.shape[:-1]) for a, b in pairs]).sum(0)

    weight = w.masked_fill(w.isinf(), 0)
    size = terms(
        (times(H.abs(), star.abs()), star),
        (q, star),
        (weight, known.sigma.double()),
        (times(C.abs(), star.abs()), known.chi.double()),
        (times(G.abs(), star.abs()), known.lam.double()),
        (fixed, known.xi.double()),
    )
    charge = (weight * slacks(z, G, lb, ub, w)).sum(-1)
    here = (z * times(H, z)).sum(-1) / 2, (q * z).sum(-1), charge
    cost = sum(here) + c
    value = solution.value.detach().double()
    # The value's own terms are smaller than the Lagrangian's where multipliers are large. Those at
    # z count as in the certificate: z may be far along a flat direction, where they cancel.
    own = torch.stack(
        [
            x.abs().expand_as(known.value)
            for x in (
                known.value - c,
                (star * times(H, star)).sum(-1) / 2,
                (q * star).sum(-1),
                (weight * known.sigma.double()).sum(-1),
                KNOWN * size,
            )
        ]
    ).amax(0)
    most = torch.stack([x.abs().expand_as(own) for x in here]).amax(0)
    own = own.maximum(most.minimum(CANCELLED * (known.value - c).abs()))
    errors_of_value = ACCURACY / VALUE * (value - known.value).abs() / own
    off = z - star
    errors = [
        (cost - known.value).abs() / size,
        errors_of_value,
        (off * times(H, off)).sum(-1) / 2 / size,
    ]
    length = times(C.abs(), star.abs()) + b.abs()
    errors.append(_largest((times(C, z) - b).abs() / length))
    length = times(G.abs(), star.abs())
    y = times(G, z)
    near = torch.where((y - lb).abs() < (y - ub).abs(), lb, ub).abs()
    beyond = torch.maximum(lb - y, y - ub).clamp(min=0) / (length + near)
    errors.append(_largest(torch.where(w.isinf(), beyond, 0)))
    errors.append(_largest((z[..., :n_f] - fixed).abs() / fixed.abs()))
    worst = torch.stack([e.expand(value.shape) for e in errors]).amax(0)
    return worst.nan_to_num(torch.inf, torch.inf)


def _largest(x: Tensor) -> Tensor:
    return x.amax(-1) if x.shape[-1] else x.new_zeros(x.shape[:-1])


def finite_gradients(solution: QPSolution, operands: tuple[Tensor, ...]) -> Tensor:
    """Find where all gradients of a masked batch's values and z are finite, ``(B,)``.

    The gradient of a shared tensor counts for all elements.
    """
    finite = torch.ones(solution.status.shape, dtype=torch.bool)
    for part in (solution.value, solution.z):
        ones = torch.ones_like(part)
        gradients = torch.autograd.grad(part, operands, ones, retain_graph=True, allow_unused=True)
        for gradient, ndim in zip(gradients, EVENT_NDIMS, strict=False):
            if gradient is not None:
                event = tuple(range(gradient.ndim - ndim, gradient.ndim))
                finite &= gradient.isfinite().all(dim=event) if event else gradient.isfinite()
    return finite
