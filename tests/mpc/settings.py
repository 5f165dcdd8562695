"""One table of QPMPCs: the paper's QP, linear MPC schemes, previews, and masks."""

from typing import Any

import torch
from torch import Tensor

from tests.problems import MIXED, normal, random_mpc, random_states
from torch_qpmpc import QPMPC
from torch_qpmpc.mpc.validation import CONSTRAINTS, COST

EVERYTHING = (*COST, *CONSTRAINTS)
A = torch.tensor([[1.0, 0.2], [0.0, 0.9]]).double()
B = torch.tensor([[0.0], [0.3]]).double()
W = torch.tensor([[2.0, 0.3, 0.1], [0.3, 1.0, 0.2], [0.1, 0.2, 0.5]]).double()

# A preview of a price and a reference
N, N_X, N_U, N_D, GAMMA = 3, 2, 1, 2, 0.8
n = N_X + N_U
N_P = (N + 1) * N_D + N_X
PRICE, REFERENCE, U = 0, 1, N_D + N_X  # entries of (d_k, x_k, u_k)
A_D = 0.2 * normal(N_X, N_X, seed=1) + 0.5 * torch.eye(N_X)
B_D, E = 0.5 * normal(N_X, N_U, seed=2), 0.3 * normal(N_X, N_D, seed=3)
W_D, W_F = torch.zeros(N_D + n, N_D + n).double(), torch.zeros(N_D + N_X, N_D + N_X).double()
W_D[N_D:, N_D:] = torch.tensor([[1.0, 0.1, 0.0], [0.1, 2.0, 0.1], [0.0, 0.1, 0.5]])
W_F[N_D:, N_D:] = torch.eye(N_X)
W_D[PRICE, U] = W_D[U, PRICE] = 0.7
for weight in (W_D, W_F):  # of a reference of x's first entry, less the square of the reference
    weight[REFERENCE, N_D] = weight[N_D, REFERENCE] = -1.0
W_D[PRICE, PRICE] = -3.0
#: A bound of x's second entry that is an entry of d_k, with some u_k.
ROWS = ([[0.0, 1.0, 0.0, 1.0, 0.5]], [-0.6], [0.5])
LAST_ROWS = ([[0.0, 0.5, 1.0, 0.0]], [-0.4], [0.4])


def shifted(mpc: QPMPC, free: float, seed: int) -> QPMPC:
    with torch.no_grad():
        for i, parameter in enumerate(mpc.parameters()):
            parameter += free * normal(*parameter.shape, seed=100 * seed + i).tanh()
    mpc.project_()
    return mpc


def linear(seed: int = 0, *, free: float = 0.05, horizon: int = 4, **options: Any) -> QPMPC:
    box = {"state_bounds": ([-1.0, -1.0], [1.0, 1.0]), "action_bounds": ([-0.5], [0.5])}
    parts = [part for part in EVERYTHING if part != "G" or "constraints" in options]
    settings = {**box, "stage_weight": W, "solver": "daqp", "hessian": "block", "learn": parts}
    settings |= {"structure": "tied", "discount_slack": True} | options
    return shifted(QPMPC.from_model(A, B, horizon, **settings), free, seed)


def previewed(seed: int = 0, *, free: float = 0.05, **options: Any) -> QPMPC:
    settings: dict[str, Any] = {
        "E": E,
        "gamma": GAMMA,
        "hessian": "block",
        "stage_weight": W_D,
        "terminal_weight": W_F,
        "constraints": ROWS,
        "terminal_constraints": LAST_ROWS,
        "state_bounds": ([-1.0] * N_X, [1.0] * N_X),
        "action_bounds": ([-0.6], [0.6]),
        "constraint_slack": 2.0,
        "state_slack": 3.0,
        "solver": "daqp",
        "learn": EVERYTHING,
    }
    settings |= options
    if settings["hessian"] == "diagonal":
        settings |= {"stage_weight": [1.0, 2.0, 0.5], "terminal_weight": [1.0, 1.0]}
    return shifted(QPMPC.from_model(A_D, B_D, N, **settings), free, seed)


def rows() -> Tensor:
    """Make the mask of all rows of C except the second state's, such as a constant reference."""
    return (torch.arange(2 * N) % 2 == 0).unsqueeze(-1).expand(-1, N * n + N_X).clone()


PAPER: dict[str, dict[str, Any]] = {
    "diagonal": {"hessian": "diagonal"},
    "weak slack": {"state_slack": 0.5, "action_slack": 0.1},
    "discounted slack": {"discount_slack": True, "action_slack": 50.0},
    "hard states": {"state_slack": torch.inf, "state_bounds": ([-9.0, -9.0], [9.0, 9.0])},
    "no bounds": {"state_bounds": None, "action_bounds": None},
    "everything learned": {"learn": EVERYTHING, "hessian": "block", "action_slack": 50.0},
    "of one stage": {"horizon": 1},
    "tied, mixed": {"structure": "tied", "learn": ("C", "G", "w"), **MIXED},
    "free, mixed": {"learn": ("C", "G", "w"), "action_slack": 50.0, **MIXED},
    "projected block": {"step": "projection", "hessian": "block", "learn": ("H", "H_f", "C", "w")},
    "by proxqp": {"solver": "proxqp"},
    "masked": {"learn": {"H": True, "c": True, "C": rows()}},
}
LINEAR: dict[str, dict[str, Any]] = {
    "tied": {},
    "tied, mixed rows": MIXED,
    "blocks": {"blocks": [1, 3], **MIXED},
    "tied, diagonal": {"hessian": "diagonal", "stage_weight": [1.0, 0.5, 0.1]},
    "hard rows": {"constraint_slack": torch.inf, "constraints": ([[0.0, 0, 1]], [-0.4], [0.4])},
}
PREVIEWED: dict[str, dict[str, Any]] = {
    "preview": {},
    "preview, tied": {"structure": "tied"},
    "preview, projected": {"structure": "tied", "hessian": "diagonal", "step": "projection"},
    "preview, torch": {"solver": "torch"},
}
SETTINGS = {
    **{name: (random_mpc, options) for name, options in PAPER.items()},
    **{name: (linear, options) for name, options in LINEAR.items()},
    **{name: (previewed, options) for name, options in PREVIEWED.items()},
}


def made(name: str, seed: int = 0, **changes: Any) -> QPMPC:
    make, options = SETTINGS[name]
    return make(seed, **options, **changes)


def inputs(mpc: QPMPC, count: int = 6) -> tuple[Tensor, Tensor]:
    if mpc.n_p == mpc.n_x:
        return random_states(count), random_states(count, 1, size=0.3)
    return normal(count, N_P, seed=5), 0.45 * normal(count, 1, seed=6).tanh()


def stepped(mpc: QPMPC, rate: float = 1e-3) -> QPMPC:
    optimizer = torch.optim.Adam(mpc.parameters(), lr=rate)
    mpc(inputs(mpc, 4)[0]).sum().backward()
    optimizer.step()
    mpc.project_()
    optimizer.zero_grad()
    return mpc
