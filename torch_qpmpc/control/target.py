"""The target of a controller: the steady state within bounds that is nearest to the set-point.

    min over v of (y_s - r)'Q(y_s - r) + price violation(y_s),   u_s within its bounds,

where (x_s, u_s, y_s) is the steady state for v, the disturbance w and known signals d (see
`torch_qpmpc.control.steady`). It is the policy of a `QPMPC` of one stage whose state, and p, is
[r; w; d] and whose action is v.
"""

from __future__ import annotations

import numpy as np

from torch_qpmpc.control.design import Design
from torch_qpmpc.control.lowering import SCALE
from torch_qpmpc.control.state_space import Array
from torch_qpmpc.mpc.bounds import Bounds
from torch_qpmpc.mpc.cost import Cost
from torch_qpmpc.mpc.layout import Layout
from torch_qpmpc.mpc.model import Model
from torch_qpmpc.mpc.module import QPMPC
from torch_qpmpc.mpc.scheme import Scheme

#: The weight of small inputs among those with the same outputs, relative to that of the outputs.
PREFERENCE = 1e-8
#: The price of a hard bound of an output, which a disturbance may make impossible to keep.
HARD = 1e6


def target_mpc(design: Design) -> QPMPC:
    """Return the QPMPC whose policy maps [r; w; d] to v."""
    steady, n_y = design.steady, len(design.Q)
    n_v = steady.Y.shape[1]
    n_x = n_y + steady.y.shape[1] - 1
    # y_s - r and u_s as maps of [r; w; d; v], and constants.
    error = np.hstack((-np.eye(n_y), steady.y[:, :-1], steady.Y))
    inputs = np.hstack((np.zeros((len(steady.U), n_y)), steady.u[:, :-1], steady.U))
    weight = 2 * error.T @ design.Q @ error
    linear = 2 * error.T @ design.Q @ steady.y[:, -1]
    if steady.is_free:
        small = _preference(design) * steady.R
        weight, linear = (
            weight + 2 * inputs.T @ small @ inputs,
            linear + 2 * inputs.T @ small @ steady.u[:, -1],
        )
        weight[n_x:, n_x:] += _preference(design) * 1e-3 * np.trace(steady.R) * np.eye(n_v)
    layout = Layout(n_x, n_v, horizon=1)
    cost = Cost(
        weight,
        np.zeros((n_x, n_x)),
        hessian="block",
        q=np.pad(linear, (0, n_x)),
        c=SCALE * design.typical,
    )
    model = Model(np.eye(n_x), np.zeros((n_x, n_v)))
    return QPMPC(
        Scheme(layout, model, cost, _bounds(design, error, inputs), gamma=1.0),
        learn=(),
        solver="daqp",
    )


def _preference(design: Design) -> float:
    """Return the weight of small inputs."""
    Y = design.steady.Y
    sizes = np.linalg.eigvalsh(Y.T @ design.Q @ Y)
    seen = sizes[sizes > 1e-9 * max(sizes[-1], 1e-300)]
    size = np.linalg.norm(design.steady.U.T @ design.steady.R @ design.steady.U, 2)
    return float(PREFERENCE * (seen[0] if len(seen) else 1.0) / (size or 1.0))


def _bounds(design: Design, error: Array, inputs: Array) -> Bounds:
    """Return rows of u_s, hard, and of y_s, at their prices.

    Rows that v does not change are left out: a disturbance alone determines them.
    """
    n_y, steady = len(design.Q), design.steady
    outputs = error.copy()
    outputs[:, :n_y] = 0.0
    constants = np.concatenate((steady.u[:, -1], steady.y[:, -1]))
    slack = np.concatenate((np.full(len(inputs), np.inf), np.minimum(design.y_slack, HARD)))
    lower, upper = (
        np.concatenate(pair) - constants
        for pair in zip(design.u_bounds, design.y_bounds, strict=True)
    )
    D = np.vstack((inputs, outputs))
    rows = (np.isfinite(lower) | np.isfinite(upper)) & D[:, -steady.Y.shape[1] :].any(-1)
    if not rows.any():
        return Bounds()
    D = D[rows]
    return Bounds(constraints=(D, lower[rows], upper[rows]), constraint_slack=slack[rows])
