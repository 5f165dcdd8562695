"""Lower a design onto a scheme: the QP of a linear MPC, in deviations from the target."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.linalg import block_diag
from torch import Tensor

from torch_qpmpc.control.design import Design
from torch_qpmpc.control.disturbance import null_direction, unseen_modes
from torch_qpmpc.control.state_space import Array
from torch_qpmpc.errors import QPError
from torch_qpmpc.mpc.bounds import Bounds
from torch_qpmpc.mpc.cost import Cost
from torch_qpmpc.mpc.layout import Layout
from torch_qpmpc.mpc.model import Model
from torch_qpmpc.mpc.riccati import lqr_gain, riccati_weight
from torch_qpmpc.mpc.scheme import Scheme

#: The value at the target, relative to a typical deviation's in each stage: errors are certified
#: relative to the value, which must not be zero.
SCALE = 1e-2
#: An eigenvalue this near to the unit circle is on it.
ON_CIRCLE = 1e-6


@dataclass(frozen=True, eq=False, repr=False)
class LinearScheme(Scheme):
    """The scheme of a linear MPC, with the design that it is made from."""

    design: Design | None = None

    @property
    def of_actions(self) -> Tensor:
        """True for the rows of inputs and moves, whose other entries are constant in a block."""
        if self.bounds.constraints is None:
            return super().of_actions
        return self.bounds.constraints[0][:, -self.layout.n_u :].any(-1)


def lowered(design: Design) -> LinearScheme:
    """Return the scheme of a design, in deviations from the target."""
    places = design.places
    n_d = places["known"].stop
    n_x, n_u = places["u"].start - n_d, design.plant.sizes[1]
    layout = Layout(n_x, n_u, design.horizon, 1, n_d, blocks=design.blocks)
    parts = _model(design), _cost(design, layout), _bounds(design)
    return LinearScheme(layout, *parts, design.gamma, design=design)


def _model(design: Design) -> Model:
    """Return the model of [x; u_last; y_s; u_s; 1], where y_s and u_s stay."""
    s, plant = design.selectors(), design.plant
    n_d = design.places["known"].stop
    x = plant.A @ s["x"] + plant.B @ s["u"] + plant.E @ s["known"]
    rows = np.vstack((x, s["u"][: len(s["u_last"])], s["y_s"], s["u_s"], s["one"]))
    n_x = n_d + len(rows)
    return Model(rows[:, n_d:n_x], rows[:, n_x:], rows[:, :n_d])


def _cost(design: Design, layout: Layout) -> Cost:
    """Return the squares of deviations from the target, and the prices."""
    s, places, plant = design.selectors(), design.places, design.plant
    y, u = plant.C @ s["x"], s["u"].copy()
    y[: len(s["r"])] -= s["r"]
    u[: len(s["u_r"])] -= s["u_r"]
    du = [s["u"] - s["u_last"]] if design.moves else []
    T = np.vstack((y, u, *du))
    stage = 2 * T.T @ block_diag(design.Q, design.R, *[design.dR] * len(du)) @ T
    linear = np.zeros(len(stage))
    for name, price in design.linear.items():
        i = places["u"].start + plant.inputs.index(name)
        if isinstance(price, str):
            j = places["known"].start + plant.known.index(price)
            stage[i, j] += 1
            stage[j, i] += 1
        else:
            linear[i] += price
    one = places["one"].start
    stage[one, one] = 2 * SCALE * design.typical
    size = places["u"].start
    P = riccati(design)
    x = np.vstack((s["x"], s["u_last"]))[:, :size]
    terminal = 2 * y[:, :size].T @ design.Q @ y[:, :size] if P is None else x.T @ P @ x
    q = layout.from_stage(torch.as_tensor(linear).expand(layout.horizon, 1, -1)).sum(0)
    return Cost(stage, terminal, hessian="block", q=q)


def riccati(design: Design) -> Array | None:
    """Return the cost to go of [x; u_last] about a steady state, None if it does not exist."""
    if _costless(design):
        return None
    plant, m = design.plant, design.plant.sizes[1]
    A, B = plant.A, plant.B
    Q, R = 2 * plant.C.T @ design.Q @ plant.C, 2 * (design.R + design.dR)
    S = np.zeros_like(B)
    if design.moves:
        A, B = block_diag(A, np.zeros((m, m))), np.vstack((B, np.eye(m)))
        Q, S = block_diag(Q, 2 * design.dR), np.vstack((S, -2 * design.dR))
    A, B, W = (torch.as_tensor(x) for x in (A, B, np.block([[Q, S], [S.T, R]])))
    try:
        P = riccati_weight(A, B, W, design.gamma)
        K = lqr_gain(A, B, W, design.gamma)
    except (QPError, RuntimeError):  # the latter of a singular matrix
        return None
    radius = torch.linalg.eigvals(A - B @ K).abs().max() * design.gamma**0.5
    eigenvalues = torch.linalg.eigvalsh(P)
    exists = radius < 1 - 1e-9 and eigenvalues[0] >= -1e-9 * eigenvalues[-1].abs()
    return P.numpy() if exists else None


def _costless(design: Design) -> bool:
    """Return True if a signal that neither grows nor decays has no cost.

    Then rounding alone decides what a solver of the Riccati equation returns.
    """
    plant, root = design.plant, design.gamma**0.5
    n, m = plant.B.shape
    weighted = design.Q @ plant.C
    modes = unseen_modes(root * plant.A, weighted)
    if any(abs(eigenvalue) < 1 + ON_CIRCLE for eigenvalue, _ in modes):
        return True
    balance = np.hstack((plant.A - np.eye(n), plant.B))
    shown = np.pad(weighted, ((0, 0), (0, m))), np.pad(design.R, ((0, 0), (n, 0)))
    return design.gamma == 1 and null_direction(balance, *shown) is not None


def _bounds(design: Design) -> Bounds:
    """Return rows of the outputs at their prices, and hard ones of inputs and moves."""
    s, size = design.selectors(), design.places["u"].start
    moving = np.isfinite(design.du_bounds).any(0)
    of_y, of_u = design.bounded
    y = (design.plant.C @ s["x"])[of_y] + s["y_s"]
    du = s["u"][moving] - s["u_last"][moving] if moving.any() else y[:0]
    D = np.vstack((y, s["u"][of_u] + s["u_s"], du))
    sides = ((design.y_bounds, of_y), (design.u_bounds, of_u), (design.du_bounds, moving))
    lower, upper = (
        np.concatenate([bounds[side][rows] for bounds, rows in sides]) for side in (0, 1)
    )
    n_y = len(y)
    price = design.y_slack[of_y]
    return Bounds(
        constraints=(D, lower, upper) if len(D) else None,
        terminal_constraints=(y[:, :size], lower[:n_y], upper[:n_y]) if n_y else None,
        constraint_slack=np.concatenate((price, np.full(len(D) - n_y, np.inf), price)),
        discount_slack=True,
    )
