"""The derivatives of the value and of the solution in closed form.

The optimal value's gradient is the Lagrangian's at the solution (eq:gradq): no linear system is
solved for it. With z, sigma, chi, upsilon, eta, xi as in `torch_qpmpc.qp.program`,

    dV/dH = 1/2 z z'   dV/dq = z    dV/dc = 1         dV/dC = chi z'   dV/db = -chi
    dV/dG = (eta - upsilon) z'      dV/dlb = upsilon  dV/dub = -eta    dV/dw = sigma
    dV/d(fixed) = -xi

Within one active set the solution is affine in the data. With A the rows held at a bound, S those
saturated at lam = plus or minus w, and E z = (x_0, u_0), an incoming gradient is carried back by
the KKT system, which is symmetric,

    [H   C'  G_A' E'] [p]   [dl/dz    ]
    [C   0   0    0 ] [r] = [dl/dchi  ]
    [G_A 0   0    0 ] [t]   [dl/dlam_A]
    [E   0   0    0 ] [u]   [dl/dxi   ]

    dl/dH = -p z'               dl/dq = -p                dl/dC = -(chi p' + r z')    dl/db = r
    dl/dG = -(lam p' + t z')    dl/d(lb, ub)_A = t        dl/d(fixed) = u
    dl/dw_i = sign(lam_i) (dl/dlam_i - G_i p) where saturated

and tangents of the data are carried forward by the same one, with dlam_S = sign(lam) dw_S and

    -(dH z + dq + dC'chi + dG'lam + G_S'dlam_S),  db - dC z,  d(lb, ub)_A - dG_A z,  d(fixed)

on the right. Where a row is weakly active (at its bound with a zero multiplier) the solution has a
kink, and this is one of its one-sided derivatives.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import torch
from torch import Tensor

from torch_qpmpc.qp.batching import broadcast, listed, multiply, outer, sum_to, times, weighted_sum
from torch_qpmpc.qp.pipeline.batch import Programs
from torch_qpmpc.qp.program import Status
from torch_qpmpc.qp.solution import active_rows, slacks

#: Residual of the KKT system from which on it counts as singular.
SINGULAR = 1e-8
#: Tangents of H, q, c, C, b, G, lb, ub, w, fixed; None for zero.
Tangents = Sequence[Tensor | None]
#: Solves the KKT system for right-hand sides in the order of z, lam, chi, xi: `solve_kkt`, or the
#: operator that hides it from traces.
SolveKKT = Callable[..., tuple[Tensor, Tensor, Tensor, Tensor]]


def envelope_gradients(
    weight: Tensor, z: Tensor, sigma: Tensor, chi: Tensor, lam: Tensor, xi: Tensor
) -> dict[str, Callable[[Tensor], Tensor]]:
    """The gradient of sum_i weight_i value_i in each tensor of the QP, and in the fixed entries.

    Each is a function of the tensor: the gradient is summed over the batch dimensions that the
    tensor lacks.
    """
    weighted_z, negative = weight.unsqueeze(-1) * z, -weight
    return {
        "H": lambda like: 0.5 * outer(weighted_z, z, like),
        "q": lambda like: weighted_sum(weight, z, like),
        "c": lambda like: sum_to(weight, like),
        "C": lambda like: outer(chi, weighted_z, like),
        "b": lambda like: weighted_sum(negative, chi, like),
        "G": lambda like: outer(lam, weighted_z, like),
        "lb": lambda like: weighted_sum(negative, lam.clamp(max=0), like),
        "ub": lambda like: weighted_sum(negative, lam.clamp(min=0), like),
        "w": lambda like: weighted_sum(weight, sigma, like),
        "fixed": lambda like: weighted_sum(negative, xi, like),
    }


def gradients(
    incoming: Sequence[Tensor | None],
    theta: Sequence[Tensor],
    solution: Sequence[Tensor],
    needed: Sequence[bool],
    n_kept: int,
    solve: SolveKKT,
) -> list[Tensor | None]:
    """The gradient in H, q, c, C, b, G, lb, ub, w, fixed where it is ``needed``.

    Args:
        incoming: gradients in value, z, chi, lam and xi; None for zero.
        theta: H, .., w, fixed.
        solution: z, chi, lam, xi and status.
        needed: True for each of theta whose gradient is returned.
        n_kept: as in `Programs.of`.
        solve: see `SolveKKT`.
    """
    of_value, *of_solution = incoming
    found: list[Tensor | None] = [None] * len(theta)
    if of_value is not None:
        found = list(_of_value(of_value, theta, solution, needed))
    if any(x is not None for x in of_solution):
        rest = _of_solution(of_solution, theta, solution, needed, n_kept, solve)
        pairs = zip(found, rest, strict=True)
        found = [x if y is None else y if x is None else x + y for x, y in pairs]
    return found


def _of_value(
    incoming: Tensor, theta: Sequence[Tensor], solution: Sequence[Tensor], needed: Sequence[bool]
) -> Iterator[Tensor | None]:
    z, chi, lam, xi, status = solution
    solved = status == int(Status.SOLVED)
    # An unsolved element has zeros here, but zero times what is infinite or NaN is NaN.
    weight = torch.where(solved, incoming, 0)
    sigma = torch.where(solved.unsqueeze(-1), slacks(z, *theta[5:9]), 0) if needed[8] else z
    of_theta = envelope_gradients(weight, z, sigma, chi, lam, xi).values()
    return (f(x) if need else None for f, x, need in zip(of_theta, theta, needed, strict=True))


def _of_solution(
    incoming: Sequence[Tensor | None],
    theta: Sequence[Tensor],
    solution: Sequence[Tensor],
    needed: Sequence[bool],
    n_kept: int,
    solve: SolveKKT,
) -> Iterator[Tensor | None]:
    z, chi, lam, xi, status = solution
    H, q, c, C, b, G, lb, ub, w, fixed = theta
    parts = zip((z, chi, lam, xi), incoming, strict=True)
    pulls = [torch.zeros_like(x) if pull is None else pull for x, pull in parts]
    grad_z, grad_chi, grad_lam, grad_xi = pulls
    p, r, t, u = solve(grad_z, grad_lam, grad_chi, grad_xi, z, lam, status, *theta, n_kept)
    _, saturated = active_rows(lam, w)
    slope = torch.where(saturated, lam.sign() * (grad_lam - times(G, p)), 0)
    of_theta = (
        lambda: -0.5 * (outer(p, z, H) + outer(z, p, H)),
        lambda: sum_to(-p, q),
        lambda: torch.zeros_like(c),
        lambda: -(outer(chi, p, C) + outer(r, z, C)),
        lambda: sum_to(r, b),
        lambda: -(outer(lam, p, G) + outer(t, z, G)),
        lambda: sum_to(torch.where(lam < 0, t, 0), lb),
        lambda: sum_to(torch.where(lam > 0, t, 0), ub),
        lambda: sum_to(slope, w),
        lambda: sum_to(u, fixed),
    )
    return (f() if need else None for f, need in zip(of_theta, needed, strict=True))


def tangents(
    of_theta: Tangents,
    theta: Sequence[Tensor],
    solution: Sequence[Tensor],
    n_kept: int,
    solve: SolveKKT,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """The tangents of value, z, chi, lam and xi from those of theta."""
    z, chi, lam, xi, status = solution
    sigma = slacks(z, *theta[5:9])
    value = torch.where(status == 0, _value_tangent(of_theta, z, sigma, chi, lam, xi), 0)
    *right, saturated = _right_side(of_theta, z, lam, chi, xi, theta[5], theta[8])
    dz, dchi, dlam, dxi = solve(*right, z, lam, status, *theta, n_kept)
    return value, dz, dchi, dlam + saturated, dxi


def _value_tangent(
    of_theta: Tangents, z: Tensor, sigma: Tensor, chi: Tensor, lam: Tensor, xi: Tensor
) -> Tensor:
    dH, dq, dc, dC, db, dG, dlb, dub, dw, dfixed = of_theta
    total = z.new_zeros(z.shape[:-1])
    if dc is not None:
        total = total + dc
    for matrix, left in ((dH, 0.5 * z), (dC, chi), (dG, lam)):
        if matrix is not None:
            total = total + (left * times(matrix, z)).sum(-1)
    weights = (z, -chi, (-lam).clamp(min=0), -lam.clamp(min=0), sigma, -xi)
    for vector, weight in zip((dq, db, dlb, dub, dw, dfixed), weights, strict=True):
        if vector is not None:
            total = total + (weight * vector).sum(-1)
    return total


def _right_side(
    of_theta: Tangents, z: Tensor, lam: Tensor, chi: Tensor, xi: Tensor, G: Tensor, w: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """The right-hand side, in the order of z, lam, chi, xi, and dlam of saturated rows."""
    dH, dq, _, dC, db, dG, dlb, dub, dw, dfixed = of_theta
    of_z, of_lam, of_chi = (torch.zeros_like(part) for part in (z, lam, chi))
    of_xi = torch.zeros_like(xi) if dfixed is None else dfixed.expand_as(xi)
    saturated = torch.zeros_like(lam)
    if dw is not None:
        saturated = torch.where(active_rows(lam, w)[1], lam.sign() * dw, 0)
        of_z = of_z - times(G.mT, saturated)
    if dH is not None:
        of_z = of_z - times(dH + dH.mT, z) / 2
    if dq is not None:
        of_z = of_z - dq
    for bound, side in ((dlb, lam < 0), (dub, lam > 0)):
        if bound is not None:
            of_lam = torch.where(side, bound, of_lam)
    if db is not None:
        of_chi = of_chi + db
    if dC is not None:
        of_z, of_chi = of_z - times(dC.mT, chi), of_chi - times(dC, z)
    if dG is not None:
        of_z, of_lam = of_z - times(dG.mT, lam), of_lam - times(dG, z)
    return of_z, of_lam, of_chi, of_xi, saturated


def solve_kkt(
    grad_z: Tensor,
    grad_lam: Tensor,
    grad_chi: Tensor,
    grad_xi: Tensor,
    z: Tensor,
    lam: Tensor,
    status: Tensor,
    H: Tensor,
    q: Tensor,
    c: Tensor,
    C: Tensor,
    b: Tensor,
    G: Tensor,
    lb: Tensor,
    ub: Tensor,
    w: Tensor,
    fixed: Tensor,
    n_kept: int,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """p ``(*batch, n_z)``, r ``(*batch, n_c)``, t ``(*batch, n_g)``, u ``(*batch, n_f)``.

    Solved in condensed form for the whole batch at once; zero for unsolved elements.
    """
    # Under vmap the gradients may have batch dimensions that the QP does not.
    vectors = (grad_z, grad_lam, grad_chi, grad_xi, z, lam, fixed)
    batch = broadcast(*(x.shape[:-1] for x in vectors), status.shape)
    fixed = fixed.expand(*batch, fixed.shape[-1])
    theta = (H, q, c, C, b, G, lb, ub, w, fixed)
    device = z.device if z.is_cuda else None
    programs, batch = Programs.of(*theta, n_kept=n_kept, device=device)
    solved = (status == Status.SOLVED).expand(batch).reshape(-1)
    part = programs
    if not solved.all():
        part = programs.take(solved.nonzero().squeeze(-1).numpy(force=True))

    def flat(x: Tensor) -> Tensor:
        return listed(x.expand(*batch, x.shape[-1]))[solved].double()

    right = flat(grad_z), flat(grad_lam), flat(grad_chi), flat(grad_xi)
    parts = _solve_kkt(part, *right, flat(lam), z.device) if len(part) else ()
    found = tuple(z.new_zeros(len(solved), x.shape[-1]) for x in (z, b, lb, fixed))
    for x, solution in zip(found, parts, strict=False):
        x[solved] = solution.to(x)
    return tuple(x.reshape(*batch, x.shape[-1]) for x in found)  # pyright: ignore[reportReturnType] - four of them


def _solve_kkt(
    p: Programs,
    grad_z: Tensor,
    grad_lam: Tensor,
    grad_chi: Tensor,
    grad_xi: Tensor,
    lam: Tensor,
    device: torch.device,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    n_f = p.n_f

    def tensor(x: Any) -> Tensor:
        return torch.as_tensor(x, device=device)

    theta, group, w = p.prepared.theta, tensor(p.group), tensor(p.theta.w)
    H, C, G = tensor(theta.H), tensor(theta.C), tensor(theta.G)
    T, Y_neg, H_y, G_y, _, _ = map(tensor, p.prepared.condensed(n_f).arrays)
    multipliers, weight = lam, w
    if (units := p.prepared.units) is not None:  # which say what a zero multiplier is
        of_rows = tensor(units.rows / units.cost)[group]
        multipliers, weight = lam * of_rows, w * of_rows
    active, _ = active_rows(multipliers, weight)
    T_f, T = T[:, :, :n_f], T[:, :, n_f:]
    # What C p = dl/dchi and E p = dl/dxi fix; then the condensed system for the rest.
    particular = multiply(T_f, group, grad_xi) - multiply(Y_neg, group, grad_chi)
    right_v = multiply(T.mT, group, grad_z - multiply(H, group, particular))
    right_t = (grad_lam - multiply(G, group, particular)) * active
    v, t = _solve_active(
        H_y[group, n_f:, n_f:],
        G_y[group, :, n_f:] * active.unsqueeze(-1),
        active,
        right_v,
        right_t,
    )
    p_z = particular + multiply(T, group, v)
    left = grad_z - multiply(H, group, p_z) - multiply(G.mT, group, t)
    r = -multiply(Y_neg.mT, group, left)
    u = (left - multiply(C.mT, group, r))[:, :n_f]
    return p_z, r, t, u


def _solve_active(
    H: Tensor, G: Tensor, active: Tensor, right_v: Tensor, right_t: Tensor
) -> tuple[Tensor, Tensor]:
    """Solve ``H v + G't = right_v, G v = right_t``; G and right_t are zero in rows not active."""
    d = H.shape[-1]
    rows = active.any(dim=0).nonzero().squeeze(-1)
    G, idle = G[:, rows], (~active[:, rows]).to(H.dtype)
    top = torch.cat((H, G.mT), dim=-1)
    kkt = torch.cat((top, torch.cat((G, torch.diag_embed(idle)), dim=-1)), dim=-2)
    right = torch.cat((right_v, right_t[:, rows]), dim=-1).unsqueeze(-1)
    solution = torch.linalg.solve_ex(kkt, right)[0]
    error = (kkt @ solution - right).abs().amax(dim=(-2, -1)) if kkt.numel() else right.new_zeros(0)
    bound = SINGULAR * (1 + right.abs().amax(dim=(-2, -1))) if kkt.numel() else error
    singular = ~(error <= bound)
    if singular.any():
        # Dependent active rows, or directions without curvature: the solution of least norm.
        inverse = torch.linalg.pinv(kkt[singular], hermitian=True)
        solution[singular] = inverse @ right[singular]
    t = torch.zeros_like(right_t)
    t[:, rows] = solution[:, d:, 0]
    return solution[:, :d, 0], t
