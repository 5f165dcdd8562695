"""Lower a design onto schemes: the QP of the plan, in deviations from the target, and the target's.

The plan's stages weigh y_k - r_k. Where bounds of inputs keep the target's outputs y_s off r, the
cost of an endless loop about the target has a slope lam'(x - x_s), and so has the terminal cost,
with lam = gamma A'lam + 2 C'Q (y_s - r): the plan rests at the target whatever its horizon (Zanon
and Faulwasser, "Economic MPC without terminal constraints", J. Process Control 63, 2018). Of bounds
of outputs see `Design.end_set_points`.

The target is the steady state within bounds that is nearest to the set-point:

    min over v of (y_s - r)'Q(y_s - r) + price violation(y_s),   u_s within its bounds,

where (x_s, u_s, y_s) is the steady state for v, the disturbance w and known signals d (see
`torch_qpmpc.control.disturbance`): the policy of a one-stage `QPMPC` of [r; w; d; 1], whose action
is v = [a; f], where f leaves the outputs with a weight as they are. The state then begins with f_0,
and f - f_0 has a weight: from f_0 = 0 the QP is solved again about its own f until that stays (the
proximal point method, Rockafellar, SIAM J. Control Optim. 14, 1976). A weight so small that it
moves no output off r would cost numbers in C their digits.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import scipy.linalg
import torch
from scipy.linalg import block_diag

from torch_qpmpc.control.design import Design, Target
from torch_qpmpc.control.disturbance import RANK, null_direction, unseen_modes
from torch_qpmpc.control.scaling import Scaling
from torch_qpmpc.control.state_space import Array, StateSpace
from torch_qpmpc.errors import QPError
from torch_qpmpc.mpc.bounds import Bounds
from torch_qpmpc.mpc.cost import Cost
from torch_qpmpc.mpc.layout import Layout
from torch_qpmpc.mpc.model import Model
from torch_qpmpc.mpc.module import QPMPC
from torch_qpmpc.mpc.riccati import lqr_gain, riccati_weight
from torch_qpmpc.mpc.scheme import Scheme

#: The value at the target, relative to a typical deviation's in each stage, which p's last entry,
#: one, adds: errors are certified relative to the cost, which must not be zero.
SCALE = 1e-2
#: An eigenvalue this near to the unit circle is on it.
ON_CIRCLE = 1e-6
#: The weight of f - f_0 relative to the outputs', the most rounds, f that stay, and moves alike.
PREFERENCE, ROUNDS, STAYS, SHRINKS = 0.3, 50, 1e-10, 0.999
#: The price of a hard bound of an output, which a disturbance may make impossible to keep, relative
#: to the default one.
HARD = 1e3
#: The least eigenvalue of a Riccati weight, relative to the largest, that is not rounding.
TINY = 1e-12
#: The price of a bound of u_s that a load or rounding may make impossible to keep, in units of the
#: cost's slope.
NEARLY_HARD = 1e3


def lowered(design: Design) -> Scheme:
    """Return the scheme of a design's plan, in deviations from the target."""
    places = design.places
    n_d = places["known"].stop
    n_x, n_u = places["u"].start - n_d, design.plant.sizes[1]
    layout = Layout(n_x, n_u, design.horizon, n_d, blocks=design.blocks)
    parts = _model(design), _cost(design, layout), _bounds(design)
    return Scheme(layout, *parts, design.gamma, constants={layout.n_p - 1: 1.0})


def _model(design: Design) -> Model:
    """Return the model of the plan's state, where all but x and u_last stay."""
    s, plant = design.selectors(), design.plant
    n_d = design.places["known"].stop
    x = plant.A @ s["x"] + plant.B @ s["u"] + plant.E @ s["known"]
    stay = (s[name] for name in ("off", "end", "y_s", "u_s", "one"))
    rows = np.vstack((x, s["u"][: len(s["u_last"])], *stay))
    n_x = n_d + len(rows)
    return Model(rows[:, n_d:n_x], rows[:, n_x:], rows[:, :n_d])


def _cost(design: Design, layout: Layout) -> Cost:
    """Return the squares of y - r and of deviations from the target, and the prices."""
    s, places, plant = design.selectors(), design.places, design.plant
    y, u = plant.C @ s["x"], s["u"].copy()
    off = s["off"] if design.references == "held" else -s["r"]
    y[design.weighted] += off
    u[: len(s["u_r"])] -= s["u_r"]
    du = [s["u"] - s["u_last"]] if design.moves else []
    T = np.vstack((y, u, *du))
    stage = _squares(T, block_diag(design.Q, design.R, *[design.dR] * len(du)))
    linear = np.zeros(len(stage))
    for name, price in design.linear.items():
        i = places["u"].start + plant.inputs.index(name)
        if isinstance(price, str):
            j = places["known"].start + plant.known.index(price)
            stage[i, j] += 1
            stage[j, i] += 1
        else:
            linear[i] += price
    one, size = places["one"].start, places["u"].start
    stage[one, one] = 2 * SCALE * design.typical
    P, end = riccati(design), s["end"]
    end = (np.vstack((end, off - end)) if len(end) else off)[:, :size]
    x = np.vstack((s["x"], s["u_last"]))[:, :size]
    if P is None:
        terminal = _squares(y[:, :size], design.Q)
    else:
        L, W = _slope(design, P)
        terminal = _squares(x, P / 2) + _squares(end, W / 2) + x.T @ L @ end + end.T @ L.T @ x
    q = layout.from_stage(torch.as_tensor(linear).expand(layout.horizon, 1, -1)).sum(0)
    return Cost(stage, terminal, hessian="block", q=q)


def _squares(T: Array, weight: Any) -> Array:
    """Return ``2 T' weight T``, whose rounding is asymmetric, made symmetric."""
    half = T.T @ weight @ T
    return half + half.T


def _slope(design: Design, P: Array) -> tuple[Array, Array]:
    """Return L and W with x'P x + 2 x'L off + off'W off >= 0, where L off is the target's slope.

    ``off`` is y_s - r of the outputs with a weight, or with `Design.pulls` y_s - end, and end - r,
    whose slope is the last stage's alone. Modes at one, whose state inputs choose, take the part of
    the slope that moves no input. The slope is that of held inputs; with one input, which any slope
    of this sign keeps at its bound, that of the loop to r without bounds: far from the target,
    where the input is free, the other would lead plans away from r.
    """
    normal, (of_y, of_u, of_x, _), of_r = design.normal, design.scaling, design.weighted
    A, B, C = normal.plant.A, normal.plant.B, normal.plant.C
    still, right = np.eye(len(A)) - design.gamma * A.T, 2 * C.T @ normal.Q[:, of_r]
    still[np.abs(still) < RANK] = 0.0  # of modes at one
    response = np.linalg.pinv(still, rcond=RANK)
    size, slope = np.linalg.norm(response) * np.linalg.norm(right), response @ right
    free = scipy.linalg.null_space(still, rcond=RANK)
    slope = slope - free @ np.linalg.pinv(B.T @ free, rcond=RANK) @ (B.T @ slope)
    slope[np.abs(slope) < RANK * size] = 0.0  # rounding would set the lengths of the QP
    L = np.pad(slope, ((0, len(P) - len(A)), (0, 0)))
    sizes = np.concatenate((of_x, of_u))[: len(P)]
    P = P * np.outer(sizes, sizes)
    if len(of_u) == 1:
        steady, Q = design.steady, design.Q[np.ix_(of_r, of_r)]
        Y, *maps = (part[:, : steady.n_a] for part in (steady.Y[of_r], steady.X, steady.U))
        to_r = np.linalg.pinv(Y.T @ Q @ Y) @ Y.T @ Q * of_y[of_r]
        L = L - L @ (Y @ to_r / of_y[of_r, None])
        L = L + P @ (np.vstack(maps)[: len(P)] @ to_r / sizes[:, None])
    size_r = of_y[of_r]
    if design.pulls[1].size:
        at_end = np.pad(right, ((0, len(L) - len(A)), (0, 0)))
        L, size_r = np.hstack((L, at_end)), np.tile(size_r, 2)
    values, V = np.linalg.eigh(P)
    values, V = values[costly := values > TINY * values[-1]], V[:, costly]
    own = V.T @ L / np.sqrt(values)[:, None]  # a slope without a cost would have no least value
    return V @ V.T @ L / np.outer(sizes, size_r), own.T @ own / np.outer(size_r, size_r)


def riccati(design: Design) -> Array | None:
    """Return the cost to go of [x; u_last] about a steady state, None if it does not exist.

    It has no bounds, so they set no unit in which it is computed.
    """
    scaling = Scaling.of(design.plant, Q=design.Q, steps=design.horizon)
    of_y, of_u, of_x, _ = scaling
    plant, m, gamma = scaling.plant(design.plant), len(of_u), design.gamma
    Q, R, dR = (
        2 * weight * np.outer(of, of)
        for weight, of in ((design.Q, of_y), (design.R, of_u), (design.dR, of_u))
    )
    if _costless(plant, Q, R, gamma):
        return None
    A, B, S = plant.A, plant.B, np.zeros_like(plant.B)
    Q, R = plant.C.T @ Q @ plant.C, R + dR
    if design.moves:
        A, B = block_diag(A, np.zeros((m, m))), np.vstack((B, np.eye(m)))
        Q, S = block_diag(Q, dR), np.vstack((S, -dR))
    A, B, W = (torch.as_tensor(x) for x in (A, B, np.block([[Q, S], [S.T, R]])))
    try:
        P, K = riccati_weight(A, B, W, gamma), lqr_gain(A, B, W, gamma)
    except (QPError, RuntimeError):  # the latter of a singular matrix
        return None
    radius = torch.linalg.eigvals(A - B @ K).abs().max() * gamma**0.5
    eigenvalues, rounding = torch.linalg.eigvalsh(P), TINY * W.diagonal().max()
    exists = radius < 1 - 1e-9 and eigenvalues[0] >= -max(1e-9 * eigenvalues[-1].abs(), rounding)
    P, sizes = P.numpy(), np.concatenate((of_x, of_u))[: len(P)]
    costless = np.diag(P) <= rounding.item()
    P[costless] = P[:, costless] = 0.0  # rounding would set the lengths of the QP
    return P / np.outer(sizes, sizes) if exists else None


def _costless(plant: StateSpace, Q: Array, R: Array, gamma: float) -> bool:
    """Return True if a mode on the unit circle is not observable in the cost.

    Then rounding alone decides what a solver of the Riccati equation returns.
    """
    n, m = plant.B.shape
    weighted = Q @ plant.C
    modes = unseen_modes(gamma**0.5 * plant.A, weighted)
    if any(abs(eigenvalue) < 1 + ON_CIRCLE for eigenvalue, _ in modes):
        return True
    balance = np.hstack((plant.A - np.eye(n), plant.B))
    shown = np.pad(weighted, ((0, 0), (0, m))), np.pad(R, ((0, 0), (n, 0)))
    return gamma == 1 and null_direction(balance, *shown) is not None


def _bounds(design: Design) -> Bounds:
    """Return rows of the outputs at their prices, and hard ones of inputs and moves.

    The latter hold in all stages of a block but for those with known signals.
    """
    s, n_y, size = design.selectors(), len(design.Q), design.places["u"].start
    bands, ends, (of_y, of_u) = design.bands, design.ends, design.bounded
    signals = np.vstack((design.plant.C @ s["x"], s["u"]))
    signals[of_y] += s["y_s"]
    signals[n_y + of_u] += s["u_s"]
    D = bands.W @ signals - bands.K @ s["known"]
    if design.moves:
        D += bands.D @ (s["u"] - s["u_last"])
    last = (ends.W @ signals - ends.K @ s["known"])[:, :size]
    first = (bands.arguments == "y_bounds").sum()
    of_u = np.isfinite(design.u_bounds).any(0)
    levels = [*map(design.levels.get, design.plant.inputs)] if design.levels else None
    held = D[:, size:].any(-1) & ~D[:, : design.places["known"].stop].any(-1)
    return Bounds(
        constraints=(D, bands.lower, bands.upper) if len(D) else None,
        terminal_constraints=(last, ends.lower, ends.upper) if len(last) else None,
        constraint_slack=np.append(bands.price, ends.price),
        discount_slack=True,
        held=held if len(D) else None,
        action_levels=levels,
        level_rows=(first - 1 + np.cumsum(of_u)).tolist() if levels else None,
        **design.switching,
    )


def aimed(design: Design, arrays: Any, solve: Callable[[Any], tuple[Any, Any]], s: Any) -> Target:
    """Return the target for ``s = [r; w; d; 1]``, ``(*batch, n_s)``, in ``torch`` or ``np`` arrays.

    ``solve`` maps [f_0; s] to z and the multipliers of the target's QP.
    """
    n_f = design.steady.anchors
    now, state = (s[..., -1:] * arrays.zeros(n_f), None), s
    for _ in range(ROUNDS):
        if n_f:
            state = arrays.concatenate((now[0], s), -1)
        z, lam = solve(state)
        v = z[..., state.shape[-1] : -state.shape[-1]]
        if not n_f or (now := followed(v[..., -n_f:], *now)) is None:
            break
    return design.steady_state(arrays, v, s, lam)


def followed(f: Any, f_0: Any, before: Any = None) -> tuple[Any, Any] | None:
    """Return the next f_0 and the move to f, None if f stays; in arrays or tensors.

    After two moves in a row it is where moves end that go on to shrink alike (Aitken's method).
    """
    move = f - f_0
    if (abs(move) <= STAYS * (1 + abs(f))).all():
        return None
    if before is None:
        return f, move
    share = (move * before).sum(-1) / ((before * before).sum(-1) + TINY**20)
    share = share.clip(0, SHRINKS)[..., None]
    return f + move * share / (1 - share), None


def target_mpc(design: Design) -> QPMPC:
    """Return the QPMPC whose policy maps [f_0; r; w; d; 1] to v."""
    steady, n_y, n_f = design.steady, len(design.Q), design.steady.anchors
    n_r, n_x = n_f + n_y, n_f + n_y + steady.y.shape[1]
    # y_s - r and u_s as maps of [f_0; r; w; d; 1; v].
    error = np.hstack((-np.eye(n_y, n_r, n_f), steady.y, steady.Y))
    inputs = np.hstack((np.zeros((len(steady.U), n_r)), steady.u, steady.U))
    weight = _squares(error, design.Q)
    if len(steady.W):
        f = np.eye(len(steady.W), len(weight), n_x + steady.n_a)
        f[:, :n_f] -= np.eye(len(f), n_f)
        W, Y = steady.W, steady.Y[:, : steady.n_a]
        if Y.size:  # else no output has a weight
            seen = np.linalg.eigvalsh(Y.T @ design.Q @ Y)[0]
            W = W * float(PREFERENCE * seen / np.linalg.norm(W, 2))
        weight += _squares(f, W)
    sizes, n_d = design.scaling, design.plant.sizes[3]
    error[:, :n_r] = 0.0
    K, bands = np.eye(n_d, error.shape[1], n_x - 1 - n_d), design.bands
    D = bands.W @ np.vstack((error, inputs)) - bands.K @ K
    of_y = bands.W[:, :n_y].any(1)
    moved = np.asarray(D[:, n_x:].any(-1))
    order = np.argsort(design.inner, kind="stable")
    order = order[moved[order]]
    units = np.where(of_y, 1.0, bands.sizes(sizes.y, sizes.u))
    price = bands.price * units
    price[of_y] = np.minimum(price[of_y], HARD * design.prices(bands.W[of_y]))
    if np.linalg.matrix_rank(steady.U / sizes.u[:, None], RANK) < len(sizes.u):
        # The plant integrates, and a load may have no steady inputs within bounds.
        price[np.isinf(price)] = NEARLY_HARD * np.linalg.norm(weight[n_x:, n_x:], 2)
    rows = ((part.T / units).T[order] for part in (D, bands.lower, bands.upper))
    weight[n_x - 1, n_x - 1] += 2 * SCALE * design.typical
    cost = Cost(weight, np.zeros((n_x, n_x)), hessian="block")
    model = Model(np.eye(n_x), np.zeros((n_x, len(weight) - n_x)))
    constraints = {"constraints": (*rows,), "constraint_slack": price[order]}
    bounds = Bounds(**constraints) if len(order) else Bounds()
    layout, one = Layout(n_x, len(weight) - n_x, horizon=1), {n_x - 1: 1.0}
    scheme = Scheme(layout, model, cost, bounds, gamma=1.0, constants=one)
    return QPMPC(scheme, learn=(), solver="daqp")
