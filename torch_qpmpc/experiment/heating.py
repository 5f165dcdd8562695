"""The MPC scheme of the heated houses, for their tasks and for the rivals."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torch_qpmpc.envs.heated_house import DT, LOWER, PRICE, UPPER, HeatedHouse

#: A, B and E of x+ = A x + B u + E d, of which y, the air temperature, is the first output.
Model = tuple[Tensor, Tensor, Tensor]
#: The weight of u^2 in EUR/kW^2; it makes a plan unique.
REGULARISATION = 1e-5


def known_model(plant: HeatedHouse) -> Model:
    """Return A, B, and E of the known signals: the true model, without the gain."""
    A, B, E = plant.model()
    return A, B, E[:, : plant.n_d]


def heating_options(
    plant: HeatedHouse,
    model: Model,
    *,
    price_weight: float = 1.0,
    margin: float = 0.0,
    regularisation: float = REGULARISATION,
) -> dict[str, Any]:
    """Return the options of `QPMPC.from_model` for the plant's own cost and a model of it.

    The stage cost is DT (price_weight price u + violation) + regularisation u^2. The prices are
    cross terms of H between d_k and u_k; the comfort band is two rows of D on [d_k; x_k; u_k], soft
    at DT per K.

    Args:
        plant: bounds of the action.
        model: E has as many columns as signals are known in advance, the first being `PRICE`,
            `LOWER` and `UPPER`. With a window A is [A_1, .., A_L] and B is [B_1, .., B_L].
        price_weight, regularisation: weights in the stage cost.
        margin: distance to the lower bound in K at which the violation begins.
    """
    E = model[-1]
    n_x, n_d = E.shape
    H = torch.zeros(n_d + n_x + 1, n_d + n_x + 1, dtype=torch.float64)
    H[PRICE, -1] = H[-1, PRICE] = DT * price_weight
    H[-1, -1] = 2 * regularisation
    D = torch.zeros(2, n_d + n_x + 1, dtype=torch.float64)
    D[:, n_d] = 1.0
    D[0, LOWER] = D[1, UPPER] = -1.0
    lower, upper = H.new_tensor([margin, -torch.inf]), H.new_tensor([torch.inf, 0.0])
    return {
        "n_d": n_d,
        "E": E,
        "hessian": "block",
        "stage_weight": H,
        "terminal_weight": torch.zeros(n_x, n_x, dtype=torch.float64),
        "action_bounds": (plant.lb_a, plant.ub_a),
        "constraints": (D, lower, upper),
        "terminal_constraints": (D[:, :-1], lower, upper),
        "constraint_slack": DT,
    }
