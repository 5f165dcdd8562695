"""Families of QPs with many known entries: a preview and a state, then the plan.

The entries d_k of the preview are a price of the actions, a disturbance, and bounds of the outputs.
"""

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from tests.campaign.draws import Case, Draw, changed, solvable
from tests.problems import KnownQP, times
from torch_qpmpc import QPMPC, QuadraticProgram, Status

#: The lower and upper bound of a row of D [d_k; y_k; u_k] with a bound on one side.
ENDS = {"lower": (0.0, torch.inf), "upper": (-torch.inf, 0.0)}
ONE_SIDED = (("lower",), ("upper",), ("lower", "upper"))


def scheme(
    draw: Draw,
    curvature: float = 1.0,
    sides: tuple[str, ...] = (),
    rate_slack: float | None = None,
    **options: Any,
) -> QPMPC:
    """Draw a scheme of any size with a price and hard bounds of the actions.

    With bounds of the actions' changes, the last action is the last part of the state.

    Args:
        draw: the random numbers.
        curvature: the size of H's block on outputs and actions.
        sides: the sides of the soft bounds of the outputs by entries of d_k, of `ENDS`.
        rate_slack: the weight of the bounds of the actions' changes; None without these.
        options: other arguments of `QPMPC`.
    """
    n_y, n_u, horizon = draw.randint(1, 4), draw.randint(1, 2), draw.choice([2, 4, 8, 16])
    last = torch.eye(n_u).double()[:, : 0 if rate_slack is None else n_u]
    n_x = n_y + last.shape[1]
    one, factor = torch.eye(n_x).double(), draw.normal(n_x + n_u, n_x + n_u)
    on_d = torch.zeros(2 + n_y, 2 + n_y).double()
    weight = torch.block_diag(on_d, curvature * factor @ factor.mT)
    weight[0, -n_u:] = weight[-n_u:, 0] = 1.0
    D = torch.cat((torch.zeros(n_y, 2), -one[:n_y, :n_y], one[:n_y]), -1).repeat(len(sides), 1)
    lower, upper = ([ENDS[side][i] for side in sides for _ in range(n_y)] for i in range(2))
    if sides:
        options["terminal_constraints"] = (D, lower, upper)
    changes = torch.cat((torch.zeros(n_u, 2 + 2 * n_y), -last, torch.eye(n_u)), -1)
    changes, limits = changes[: last.shape[1]], [1.0] * last.shape[1]
    rows = torch.cat((torch.cat((D, torch.zeros(len(D), n_u)), -1), changes))
    options["constraints"] = (rows, [*lower, *(-x for x in limits)], [*upper, *limits])
    price = options.get("constraint_slack", 100.0)
    on_changes = [rate_slack for _ in limits]
    options["constraint_slack"] = [price] * len(D) + on_changes + [price] * len(D)
    A = torch.block_diag(0.8 * torch.eye(n_y).double(), 0 * last.mT @ last)
    A[:n_y] += 0.1 * draw.normal(n_y, n_x)
    return QPMPC.from_model(
        A,
        torch.cat((draw.normal(n_y, n_u), last.mT)),
        horizon,
        E=torch.cat((draw.normal(n_y, 2 + n_y), torch.zeros(n_x - n_y, 2 + n_y).double())),
        hessian="block",
        stage_weight=weight,
        terminal_weight=curvature * one,
        action_bounds=([-1.0] * n_u, [1.0] * n_u),
        **options,
    )


def optimal(draw: Draw, mpc: QPMPC, count: int, H: Tensor | None = None) -> KnownQP:
    """Draw z, and the q, b and finite bounds that make it the optimum of V or of Q.

    C is that of the model, or dense. H is that of the scheme by default.
    """

    def uniform(low: float, high: float) -> Tensor:
        shares = torch.rand(count, len(mpc.G), generator=draw.generator, dtype=torch.float64)
        return low + (high - low) * shares

    of_scheme, _, c, C, _, G, lb, ub, w = (x.detach() for x in mpc.quadratic_program().tensors())
    H = of_scheme if H is None else H
    C = C + draw.choice([0.0, 0.3]) * draw.normal(*C.shape) / len(C) ** 0.5
    n_f = mpc.n_p + draw.choice([0, mpc.n_u])
    z, chi, xi = (draw.normal(count, n) for n in (mpc.n_z, len(C), n_f))
    y, soft, kind = times(G, z), w.isfinite(), uniform(0, 1)
    side = uniform(-1.5, 1.5).round()
    side = torch.where((side > 0) & ub.isinf() | (side < 0) & lb.isinf(), 0, side)
    # A row at a bound may have no multiplier or, if soft, the multiplier w; it may also be beyond.
    share = torch.where(kind < 0.2, 0, uniform(0.2, 0.8)).masked_fill(soft & (kind > 0.6), 1)
    sigma = uniform(0.1, 1) * (soft & (kind > 0.75) & (side != 0))
    lam = side * share * torch.where(soft, w, draw.powers(-1, 1))
    gap = uniform(0.5, 2)
    middle = y - side * (gap + sigma)
    lower = (middle - gap).masked_fill(lb.isinf(), -torch.inf)
    upper = (middle + gap).masked_fill(ub.isinf(), torch.inf)
    gradient = times(H, z) + times(G.mT, lam) + times(C.mT, chi)
    gradient[:, :n_f] += xi
    value = (z * (times(H, z) / 2 - gradient)).sum(-1) + c
    value = value + (w.masked_fill(~soft, 0) * sigma).sum(-1)
    qp = QuadraticProgram(
        H, -gradient, c, C, times(C, z), G, lower, upper, w, n_known=mpc.n_p
    )  # fmt: skip
    return KnownQP(qp, z[:, :n_f], value, z, sigma, chi, lam, xi)


def previews(draw: Draw, count: int) -> Case:
    """A preview, with one-sided rows and limits of rates or without."""
    sides, rate_slack = draw.choice(((), *ONE_SIDED)), draw.choice((None, torch.inf))
    return solvable(optimal(draw, scheme(draw, 1.0, sides, rate_slack), count))


def one_sided_rows(draw: Draw, count: int) -> Case:
    """Soft rows with a bound on one side, which is an entry of the preview."""
    w = 10 ** draw.uniform(-2, 4)
    mpc = scheme(draw, sides=draw.choice(ONE_SIDED), constraint_slack=w)
    return solvable(optimal(draw, mpc, count))


def prices(draw: Draw, count: int) -> Case:
    """Costs that are linear in the actions, but for little or no curvature."""
    curvature = draw.choice([0.0, 10 ** draw.uniform(-8, -2)])
    w = 10 ** draw.uniform(-2, 2)
    mpc = scheme(draw, curvature, draw.choice(ONE_SIDED), constraint_slack=w)
    return solvable(optimal(draw, mpc, count))


def rate_limits(draw: Draw, count: int) -> Case:
    """Hard or soft bounds of the actions' changes, the first from a known action."""
    w = draw.choice([torch.inf, 10 ** draw.uniform(-1, 2)])
    return solvable(optimal(draw, scheme(draw, rate_slack=w), count))


def rates_out_of_reach(draw: Draw, count: int) -> Case:
    """A known action from which no change within the hard limits leads to the bounds."""
    mpc = scheme(draw, rate_slack=torch.inf)
    known, bounds = optimal(draw, mpc, count), mpc.quadratic_program()
    away = draw.choice([-1.0, 1.0]) * (2 + draw.powers(-3, 2, count, 1))
    fixed = known.fixed.clone()
    fixed[:, mpc.n_p - mpc.n_u : mpc.n_p] = away  # the last action is the last of the state
    known = replace(changed(known, lb=bounds.lb, ub=bounds.ub), fixed=fixed)
    return Case(known, torch.full((count,), int(Status.INFEASIBLE)))


def indefinite_in_what_is_known(draw: Draw, count: int) -> Case:
    """An H of any sign on the known entries, with large cross blocks to the plan."""
    mpc = scheme(draw, sides=draw.choice(((), *ONE_SIDED)))
    H = mpc.quadratic_program().H.detach().clone()
    rows = draw.powers(-1, 2) * draw.normal(mpc.n_p, mpc.n_z)
    H[: mpc.n_p] += rows
    H[:, : mpc.n_p] += rows.mT
    return solvable(optimal(draw, mpc, count, H))


def indefinite_in_the_plan(draw: Draw, count: int) -> Case:
    """A direction of the plan that satisfies C z = b and has negative curvature."""
    known = optimal(draw, scheme(draw, sides=draw.choice(ONE_SIDED)), count)
    n_f, H = known.fixed.shape[-1], known.qp.H.clone()
    basis = torch.linalg.svd(known.qp.C[:, n_f:])[2][len(known.qp.C) :]
    along = torch.nn.functional.normalize(draw.normal(len(basis)) @ basis, dim=0)
    down = along @ H[n_f:, n_f:] @ along + draw.powers(-2, 1)
    H[n_f:, n_f:] -= down * torch.outer(along, along)
    return Case(changed(known, H=H), torch.full((count,), int(Status.INVALID_DATA)))


FAMILIES = (
    previews,
    one_sided_rows,
    prices,
    rate_limits,
    rates_out_of_reach,
    indefinite_in_what_is_known,
    indefinite_in_the_plan,
)
