"""The MPC scheme of the heated houses, for their tasks and for the rivals."""

from __future__ import annotations

import torch

from torch_qpmpc.envs.heated_house import DT, LOWER, PRICE, UPPER, HeatedHouse
from torch_qpmpc.mpc.bounds import Bounds
from torch_qpmpc.mpc.cost import Cost
from torch_qpmpc.mpc.model import Model
from torch_qpmpc.mpc.scheme import Scheme

#: The weight of u^2 in EUR/kW^2; it makes a plan unique.
REGULARISATION = 1e-5


def known_model(plant: HeatedHouse) -> Model:
    """Return the model with the known signals d: the true one, without the gain."""
    A, B, E = plant.model()
    return Model(A, B, E[:, : plant.n_d])


def heating_scheme(
    plant: HeatedHouse,
    model: Model,
    *,
    gamma: float = 1.0,
    price_weight: float = 1.0,
    margin: float = 0.0,
    regularisation: float = REGULARISATION,
    c: float = 0.0,
) -> Scheme:
    """Make the scheme of the plant's own cost and a model of it.

    The stage cost is DT (price_weight price u + violation) + regularisation u^2. The prices are
    cross terms of H between d_k and u_k; the comfort band is two rows of D on [d_k; x_k; u_k], soft
    at DT per K.

    Args:
        plant: bounds of the action, and the horizon.
        model: E has as many columns as signals are known in advance, the first being `PRICE`,
            `LOWER` and `UPPER`. With a window A is [A_1, .., A_L] and B is [B_1, .., B_L].
        gamma: the discount.
        price_weight, regularisation: weights in the stage cost.
        margin: distance to the lower bound in K at which the violation begins.
        c: the constant of the cost.
    """
    n_x, n_d = model.E.shape
    H = torch.zeros(n_d + n_x + 1, n_d + n_x + 1, dtype=torch.float64)
    H[PRICE, -1] = H[-1, PRICE] = DT * price_weight
    H[-1, -1] = 2 * regularisation
    D = torch.zeros(2, n_d + n_x + 1, dtype=torch.float64)
    D[:, n_d] = 1.0
    D[0, LOWER] = D[1, UPPER] = -1.0
    lower, upper = H.new_tensor([margin, -torch.inf]), H.new_tensor([torch.inf, 0.0])
    bounds = Bounds(
        action_bounds=(plant.lb_a, plant.ub_a),
        constraints=(D, lower, upper),
        terminal_constraints=(D[:, :-1], lower, upper),
        constraint_slack=DT,
        discount_slack=True,
    )
    cost = Cost(H, H.new_zeros(n_x, n_x), hessian="block", c=c)
    return Scheme(model.layout(plant.horizon), model, cost, bounds, gamma)
