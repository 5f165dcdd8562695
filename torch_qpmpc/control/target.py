"""The target of a controller: the steady state within bounds that is nearest to the set-point.

    min over v of (y_s - r)'Q(y_s - r) + price violation(y_s),   u_s within its bounds,

where (x_s, u_s, y_s) is the steady state for v, the disturbance w and known signals d (see
`torch_qpmpc.control.disturbance`). It is the policy of a one-stage `QPMPC` whose state, and p, is
[r; w; d] and whose action is v.

Where several steady states have the same outputs with a weight, v = [a; f], the action is a,
bounded so that an f exists. The policy of a second QPMPC with the state [a; w; d] is f: least
inputs within their bounds. One QP for both would need a weight of f so small that numbers in C lose
their digits; it remains where f moves an output with soft bounds.
"""

from __future__ import annotations

from itertools import combinations
from typing import Any

import numpy as np
import scipy.linalg

from torch_qpmpc.control.design import Design, half_range
from torch_qpmpc.control.disturbance import RANK
from torch_qpmpc.control.lowering import SCALE
from torch_qpmpc.control.state_space import Array
from torch_qpmpc.mpc.bounds import Bounds
from torch_qpmpc.mpc.cost import Cost
from torch_qpmpc.mpc.layout import Layout
from torch_qpmpc.mpc.model import Model
from torch_qpmpc.mpc.module import QPMPC
from torch_qpmpc.mpc.scheme import Scheme

#: The weight of small inputs among those with the same outputs, relative to the outputs'.
PREFERENCE = 1e-8
#: The price of a hard bound of an output, which a disturbance may make impossible to keep.
HARD = 1e6
#: The price of a bound of u_s that a load or rounding may make impossible to keep, in units of the
#: cost's slope.
NEARLY_HARD = 1e3


def is_split(design: Design) -> bool:
    """Return True if f has a QP of its own."""
    steady = design.steady
    moved = np.abs(steady.Y[:, steady.n_a :]).max(-1, initial=0.0) > RANK
    return 0 < steady.n_a < steady.Y.shape[1] and not (moved & design.bounded[0]).any()


def target_mpc(design: Design) -> QPMPC:
    """Return the QPMPC whose policy maps [r; w; d] to v, or to a if f has a QP of its own."""
    steady, n_y, split = design.steady, len(design.Q), is_split(design)
    n_v = steady.n_a if split else steady.Y.shape[1]
    n_x = n_y + steady.y.shape[1] - 1
    # y_s - r and u_s as maps of [r; w; d; v], and constants.
    error = np.hstack((-np.eye(n_y), steady.y[:, :-1], steady.Y))
    inputs = np.hstack((np.zeros((len(steady.U), n_y)), steady.u[:, :-1], steady.U))
    weight = 2 * error.T @ design.Q @ error
    linear = 2 * error.T @ design.Q @ steady.y[:, -1]
    if len(steady.W) and not split:
        weight[n_x + steady.n_a :, n_x + steady.n_a :] += 2 * _preference(design) * steady.W
    lower, upper = (side - steady.u[:, -1] for side in design.u_bounds)
    rows = (np.isfinite(lower) | np.isfinite(upper)) & inputs[:, n_x:].any(-1)
    rows = inputs[rows], lower[rows], upper[rows]
    if split:
        rows = _without_last(*rows, len(steady.W))
    D, lower, upper = rows
    lower_y, upper_y = (side - steady.y[:, -1] for side in design.y_bounds)
    error[:, :n_y] = 0.0
    soft = (np.isfinite(lower_y) | np.isfinite(upper_y)) & error[:, n_x : n_x + n_v].any(-1)
    D = np.vstack((D[:, : n_x + n_v], error[soft, : n_x + n_v]))
    lower, upper = np.append(lower, lower_y[soft]), np.append(upper, upper_y[soft])
    price = np.inf
    if np.linalg.matrix_rank(steady.U, RANK) < len(steady.U):
        # The plant integrates, and a load may have no steady inputs within bounds.
        slope = np.linalg.norm(weight[n_x:, n_x:], 2) * half_range(design.u_bounds).max()
        price = NEARLY_HARD * slope
    slack = np.append(np.full(len(rows[0]), price), np.minimum(design.y_slack, HARD)[soft])
    weight, linear = weight[: n_x + n_v, : n_x + n_v], linear[: n_x + n_v]
    return _of_one_stage(n_x, weight, linear, SCALE * design.typical, (D, lower, upper), slack)


def free_mpc(design: Design) -> QPMPC | None:
    """Return the QPMPC whose policy maps [a; w; d] to f, None if f has no QP of its own."""
    if not is_split(design):
        return None
    steady, n_a, n_f = design.steady, design.steady.n_a, len(design.steady.W)
    n_x = n_a + steady.u.shape[1] - 1
    bounded = design.bounded[1]
    D = np.hstack((steady.U[:, :n_a], steady.u[:, :-1], steady.U[:, n_a:]))[bounded]
    rows = (D, *((side - steady.u[:, -1])[bounded] for side in design.u_bounds))
    size = np.linalg.norm(steady.R, 2) * half_range(design.u_bounds).max()
    slack = np.full(len(D), NEARLY_HARD * size)
    weight = scipy.linalg.block_diag(np.zeros((n_x, n_x)), 2 * steady.W)
    constant = SCALE * size * half_range(design.u_bounds).max()
    return _of_one_stage(n_x, weight, np.zeros(n_x + n_f), constant, rows, slack)


def _of_one_stage(
    n_x: int, weight: Any, linear: Array, constant: float, rows: tuple[Array, ...], slack: Array
) -> QPMPC:
    """Return the QPMPC with the rows (D, lower, upper), whose state has no cost at its end."""
    n_v = len(weight) - n_x
    terminal = np.zeros((n_x, n_x))
    cost = Cost(weight, terminal, hessian="block", q=np.pad(linear, (0, n_x)), c=constant)
    model = Model(np.eye(n_x), np.zeros((n_x, n_v)))
    bounds = Bounds(constraints=rows, constraint_slack=slack) if len(rows[0]) else Bounds()
    scheme = Scheme(Layout(n_x, n_v, horizon=1), model, cost, bounds, gamma=1.0)
    return QPMPC(scheme, learn=(), solver="daqp")


def _without_last(D: Array, lower: Array, upper: Array, count: int) -> tuple[Array, Array, Array]:
    """Return the rows that are left of lower <= D [x; f] <= upper if some f may be chosen.

    They are the sums of rows without f that no other sums imply: those in which as many rows as
    possible have no part (the result of Fourier-Motzkin elimination without redundant rows).
    ``count`` is the number of entries of f.
    """
    left, supports = [], set()
    sums = scipy.linalg.null_space(D[:, -count:].T, rcond=RANK)
    n = sums.shape[1]
    for apart in map(list, combinations(range(len(D)), n - 1) if n else ()):
        mix = scipy.linalg.null_space(sums[apart], rcond=RANK) if apart else np.eye(n)
        if mix.shape[1] > 1:
            continue
        factor = sums @ mix[:, 0]
        chosen = np.flatnonzero(np.abs(factor) > RANK * np.abs(factor).max())
        if chosen.tobytes() in supports:
            continue
        supports.add(chosen.tobytes())
        factor = factor[chosen]
        ends = np.sort(factor * np.stack((lower[chosen], upper[chosen])), axis=0).sum(-1)
        if np.isfinite(ends).any():
            left.append((factor @ D[chosen], *ends))
    rows, lower, upper = (
        (np.array(part) for part in zip(*left, strict=True))
        if left
        else (D[:0], lower[:0], upper[:0])
    )
    rows[np.abs(rows) < RANK] = 0.0
    return rows, lower, upper


def _preference(design: Design) -> float:
    """Return the factor of f's weight, one if no output has a weight."""
    Y = design.steady.Y[:, : design.steady.n_a]
    if not Y.size:
        return 1.0
    seen = np.linalg.eigvalsh(Y.T @ design.Q @ Y)
    return float(PREFERENCE * seen[0] / np.linalg.norm(design.steady.W, 2))
