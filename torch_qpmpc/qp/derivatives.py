"""The derivatives of the value and of the solution in closed form.

The optimal value's gradient is the Lagrangian's at the solution (eq:gradq): no linear system is
solved for it. With z, sigma, chi, upsilon, eta, xi as in `torch_qpmpc.qp.program`,

    dV/dH = 1/2 z z'   dV/dq = z    dV/dc = 1         dV/dC = chi z'   dV/db = -chi
    dV/dG = (eta - upsilon) z'      dV/dlb = upsilon  dV/dub = -eta    dV/dw = sigma
    dV/d(fixed) = -xi

Within one active set the solution is affine in the data. With A the rows held at a bound, S those
saturated at lam = plus or minus w, and E z = (x_0, u_0), the KKT system, which is symmetric, gives
the gradients in the data from those in the solution,

    [H   C'  G_A' E'] [p]   [dl/dz    ]
    [C   0   0    0 ] [r] = [dl/dchi  ]
    [G_A 0   0    0 ] [t]   [dl/dlam_A]
    [E   0   0    0 ] [u]   [dl/dxi   ]

    dl/dH = -p z'               dl/dq = -p                dl/dC = -(chi p' + r z')    dl/db = r
    dl/dG = -(lam p' + t z')    dl/d(lb, ub)_A = t        dl/d(fixed) = u
    dl/dw_i = sign(lam_i) (dl/dlam_i - G_i p) where saturated

and the tangents of the solution from those of the data, with dlam_S = sign(lam) dw_S and

    -(dH z + dq + dC'chi + dG'lam + G_S'dlam_S),  db - dC z,  d(lb, ub)_A - dG_A z,  d(fixed)

on the right-hand side.

A row with lb = ub belongs to A whatever its multiplier. Its lb and ub share t by the sign of lam,
evenly if lam = 0: only the sum of the two is defined. A also has the rows that opposite ones turn
into equalities, see `torch_qpmpc.qp.kkt`. Where any other row is weakly active (at its bound with a
zero multiplier), the solution has a kink, and this is the derivative without that row: the
one-sided one for changes that move z off its bound. A row at the kink |lam| = w counts as
saturated.
"""

from collections.abc import Callable, Iterator, Sequence

import torch
from torch import Tensor

from torch_qpmpc.qp.batching import outer, times, weighted_sum
from torch_qpmpc.qp.kkt import kkt
from torch_qpmpc.qp.program import Status
from torch_qpmpc.qp.solution import saturated_rows, slacks, upper_share
from torch_qpmpc.qp.tracing import is_differentiating

#: Tangents of H, q, c, C, b, G, lb, ub, w, fixed; None for zero.
Tangents = Sequence[Tensor | None]
#: The number of differentiable tensors, H to fixed.
N_THETA = 10


def envelope_gradients(
    weight: Tensor, z: Tensor, sigma: Tensor, chi: Tensor, lam: Tensor, eta: Tensor, xi: Tensor
) -> dict[str, Callable[[Tensor], Tensor]]:
    """Return the gradients of sum_i weight_i value_i in the QP's tensors and the fixed entries.

    Each is a function of its tensor, and sums over the batch dimensions that the tensor lacks.
    """
    weighted_z, negative = weight.unsqueeze(-1) * z, -weight
    return {
        "H": lambda like: 0.5 * outer(weighted_z, z, like),
        "q": lambda like: weighted_sum(weight, z, like),
        "c": lambda like: weight.sum_to_size(like.shape),
        "C": lambda like: outer(chi, weighted_z, like),
        "b": lambda like: weighted_sum(negative, chi, like),
        "G": lambda like: outer(lam, weighted_z, like),
        "lb": lambda like: weighted_sum(weight, eta - lam, like),
        "ub": lambda like: weighted_sum(negative, eta, like),
        "w": lambda like: weighted_sum(weight, sigma, like),
        "fixed": lambda like: weighted_sum(negative, xi, like),
    }


def gradients(
    incoming: Sequence[Tensor | None],
    theta: Sequence[Tensor],
    solution: Sequence[Tensor],
    needed: Sequence[bool],
    n_kept: int,
) -> list[Tensor | None]:
    """Return the gradients in theta: H, q, c, C, b, G, lb, ub, w, fixed; None if not ``needed``.

    ``incoming`` are those in value, z, chi, lam and xi, None for zero, ``solution`` z, chi, lam, xi
    and status; ``n_kept`` is that of `Programs.of`.
    """
    grad_value, *grad_solution = incoming
    grads: list[Tensor | None] = [None] * len(theta)
    if grad_value is not None:
        grads = list(_value_gradients(grad_value, theta, solution, needed))
    if any(x is not None for x in grad_solution):
        rest = _solution_gradients(grad_solution, theta, solution, needed, n_kept)
        pairs = zip(grads, rest, strict=True)
        grads = [x if y is None else y if x is None else x + y for x, y in pairs]
    return grads


def _value_gradients(
    incoming: Tensor, theta: Sequence[Tensor], solution: Sequence[Tensor], needed: Sequence[bool]
) -> Iterator[Tensor | None]:
    z, chi, lam, xi, status = solution
    solved = status == int(Status.SOLVED)
    # An unsolved element has zeros here, but zero times what is infinite or NaN is NaN.
    weight = torch.where(solved, incoming, 0)
    sigma = torch.where(solved.unsqueeze(-1), slacks(z, *theta[5:9]), 0) if needed[8] else z
    eta = lam.clamp(min=0)
    if (needed[6] or needed[7]) and is_differentiating():
        # A clamp's derivative at zero is 1 on either side, which counts lb = ub twice.
        eta = lam * upper_share(z, lam, *theta[5:8])
    formulas = envelope_gradients(weight, z, sigma, chi, lam, eta, xi).values()
    return (f(x) if need else None for f, x, need in zip(formulas, theta, needed, strict=True))


def _solution_gradients(
    incoming: Sequence[Tensor | None],
    theta: Sequence[Tensor],
    solution: Sequence[Tensor],
    needed: Sequence[bool],
    n_kept: int,
) -> Iterator[Tensor | None]:
    z, chi, lam, xi, status = solution
    H, q, c, C, b, G, lb, ub, w, fixed = theta
    pairs = zip((z, chi, lam, xi), incoming, strict=True)
    grads = [torch.zeros_like(x) if grad is None else grad for x, grad in pairs]
    grad_z, grad_chi, grad_lam, grad_xi = grads
    p, r, t, u = kkt(grad_z, grad_lam, grad_chi, grad_xi, z, lam, status, *theta, n_kept)
    upper = upper_share(z, lam, G, lb, ub) if needed[6] or needed[7] else lam

    def of_H() -> Tensor:
        half = -0.5 * outer(p, z, H)
        return half + half.mT

    def of_w() -> Tensor:
        slope = lam.sign() * (grad_lam - times(G, p))
        return torch.where(saturated_rows(lam, w), slope, 0).sum_to_size(w.shape)

    formulas = (
        of_H,
        lambda: (-p).sum_to_size(q.shape),
        lambda: torch.zeros_like(c),
        lambda: -(outer(chi, p, C) + outer(r, z, C)),
        lambda: r.sum_to_size(b.shape),
        lambda: -(outer(lam, p, G) + outer(t, z, G)),
        lambda: ((1 - upper) * t).sum_to_size(lb.shape),
        lambda: (upper * t).sum_to_size(ub.shape),
        of_w,
        lambda: u.sum_to_size(fixed.shape),
    )
    return (f() if need else None for f, need in zip(formulas, needed, strict=True))


def tangents(
    d_theta: Tangents, theta: Sequence[Tensor], solution: Sequence[Tensor], n_kept: int
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Return the tangents of value, z, chi, lam and xi from ``d_theta``, those of theta."""
    pairs = zip(theta, d_theta, strict=True)
    d_theta = [torch.zeros_like(x) if d is None else d for x, d in pairs]
    dH, dq, dc, dC, db, dG, dlb, dub, dw, dfixed = d_theta
    z, chi, lam, xi, status = solution
    upper, sigma = upper_share(z, lam, *theta[5:8]), slacks(z, *theta[5:9])
    saturated = torch.where(saturated_rows(lam, theta[8]), lam.sign() * dw, 0)
    Hz, Cz, Gz = times(dH + dH.mT, z) / 2, times(dC, z), times(dG, z)
    bounds = torch.where(upper < 1, (1 - upper) * dlb, 0) + torch.where(upper > 0, upper * dub, 0)
    of_z = z * (Hz / 2 + dq)
    value = dc + of_z.sum(-1) + (chi * (Cz - db)).sum(-1) + (lam * (Gz - bounds)).sum(-1)
    value = value + (sigma * dw).sum(-1) - (xi * dfixed).sum(-1)
    right_z = -(Hz + dq + times(dC.mT, chi) + times(dG.mT, lam) + times(theta[5].mT, saturated))
    right = right_z, bounds - Gz, db - Cz, dfixed.expand_as(xi)
    dz, dchi, dlam, dxi = kkt(*right, z, lam, status, *theta, n_kept)
    return torch.where(status == 0, value, 0), dz, dchi, dlam + saturated, dxi
