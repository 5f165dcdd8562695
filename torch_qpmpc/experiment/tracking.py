"""MPC schemes of the tanks, and models for windows of outputs.

A model is A = [A_1, .., A_L] and B = [B_1, .., B_L], the newest first, as in `Model`.
"""

from __future__ import annotations

from dataclasses import replace

import torch
import torch.nn.functional as F
from torch import Tensor

from torch_qpmpc.envs.four_tanks import FourTanks
from torch_qpmpc.envs.tank_references import TankReferences
from torch_qpmpc.mpc.bounds import Bounds
from torch_qpmpc.mpc.cost import Cost
from torch_qpmpc.mpc.model import Model
from torch_qpmpc.mpc.scheme import Scheme

#: R of schemes for the set point: it makes up for errors of the model and for a short horizon, to
#: which plans with the plant's own R of 1e-4 are sensitive.
INPUT_WEIGHT = 0.3
#: Factor of Q in the terminal cost of references: learning-qp's best, 1 + 10.
TERMINAL_FACTOR = 11.0


def set_point_scheme(plant: FourTanks, model: Model, gamma: float) -> Scheme:
    """Make the scheme of a model, for the plant's window, and the plant's own cost and bounds.

    The set point is in q and c, which complete the squares of (y_k - r)'Q(y_k - r) and
    (u_k - u_r)'R(u_k - u_r), with `INPUT_WEIGHT` as R; the terminal cost is (y_N - r)'Q(y_N - r).
    """
    Q, R = plant.weights()
    R = torch.full_like(R, INPUT_WEIGHT)
    _, u_r = plant.set_point()
    N, weight, target = plant.horizon, torch.cat((Q, R)), torch.cat((plant.r, u_r))
    stage, terminal = weight @ target.square(), Q @ plant.r.square()
    linear = (-2 * weight * target).repeat(N + 1)[: -len(R)]
    cost = Cost(
        torch.diag(2 * weight),
        torch.diag(2 * Q),
        hessian="block",
        q=F.pad(linear, ((plant.past - 1) * len(weight), 0)),
        c=sum(gamma**k for k in range(N)) * stage + gamma**N * terminal,
    )
    bounds = Bounds(action_bounds=(plant.lb_a, plant.ub_a))
    return Scheme(model.layout(N), model, cost, bounds, gamma)


def reference_scheme(plant: TankReferences, model: Model, gamma: float) -> Scheme:
    """Make the scheme of a model and the plant's own cost and bounds.

    The references d_k = r_k are cross terms of H, which make (x_k - r_k)'Q(x_k - r_k) with the
    terms r_k'Q r_k. The terminal cost is `TERMINAL_FACTOR` times that.
    """
    Q, R = (torch.diag(2 * weight) for weight in plant.weights())
    tracking = torch.cat((torch.cat((Q, -Q), -1), torch.cat((-Q, Q), -1)))
    cost = Cost(torch.block_diag(tracking, R), TERMINAL_FACTOR * tracking, hessian="block")
    bounds = Bounds(
        state_bounds=(plant.lb_x, plant.ub_x),
        state_slack=plant.price,
        discount_slack=True,
        action_bounds=(plant.lb_a, plant.ub_a),
    )
    layout = replace(model.layout(plant.horizon), n_d=plant.n_d)
    return Scheme(layout, model, cost, bounds, gamma)


def offset_free(A: Tensor, B: Tensor, memory: int = 1) -> tuple[Tensor, Tensor]:
    """Return the model with the mean of its last ``memory`` errors added to each prediction.

    It has ``memory`` lags more. Constant values are predicted to stay, so that a wrong model or
    a constant disturbance causes no error in a steady state that can be reached. With one error it
    is the velocity form, y_{k+1} = y_k + A_1 (y_k - y_{k-1}) + B_1 (u_k - u_{k-1}) + ..; with more
    it passes on less noise.
    """
    n_x, n_u = len(A), B.shape[-1] * len(A) // A.shape[-1]
    A_free, B_free = F.pad(A, (0, memory * n_x)), F.pad(B, (0, memory * n_u))
    for lag in range(memory):
        error = F.pad(torch.eye(n_x).to(A), (0, A.shape[-1])) - F.pad(A, (n_x, 0))
        A_free += F.pad(error, (lag * n_x, (memory - 1 - lag) * n_x)) / memory
        B_free -= F.pad(B, ((lag + 1) * n_u, (memory - 1 - lag) * n_u)) / memory
    return A_free, B_free


def window_model(
    A: Tensor, B: Tensor, C: Tensor, V: Tensor, E: Tensor, past: int
) -> tuple[Tensor, Tensor]:
    """Return the best prediction of y_{k+1} from the window and u_k, as a model with L lags.

    It is C (A x + B u_k), where x is the state's mean given the window, whose first state is
    unknown: y = C x + e and x+ = A x + B u + v have white noise of covariances E and V.

    Args:
        A, B, C, V, E: the model, and the noise.
        past: L.
    """
    n_x, n_u, n_y = *B.shape, len(C)
    n_p = past * (n_y + n_u) - n_u
    unit = torch.eye(n_p).to(A)
    P = 1e6 * torch.eye(n_x).to(A)
    estimate = A.new_zeros(n_x, n_p)  # of the state, as a matrix that multiplies the window
    for k in range(past):
        first = k * (n_y + n_u)
        gain = torch.linalg.solve(C @ P @ C.mT + E, C @ P).mT
        estimate = estimate + gain @ (unit[first : first + n_y] - C @ estimate)
        P = P - gain @ C @ P
        if k < past - 1:
            estimate = A @ estimate + B @ unit[first + n_y : first + n_y + n_u]
            P = A @ P @ A.mT + V
    window = torch.cat((C @ A @ estimate, C @ B), -1).unflatten(-1, (past, n_y + n_u)).flip(-2)
    A_lags, B_lags = window.split((n_y, n_u), -1)
    return A_lags.flatten(-2), B_lags.flatten(-2)
