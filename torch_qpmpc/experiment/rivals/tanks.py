"""The rivals of the tasks ``four_tanks`` and ``tank_references``.

Settings were chosen on logs and evaluations of other seeds than those that are reported.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torch_qpmpc.envs.four_tanks import FourTanks
from torch_qpmpc.envs.tank_references import TankReferences
from torch_qpmpc.experiment.rivals.deepc import DeePC
from torch_qpmpc.experiment.rivals.kalman_mpc import KalmanMPC
from torch_qpmpc.experiment.rivals.linear_mpc import LinearMPC, OmniscientMPC, Tracking
from torch_qpmpc.experiment.tracking import TERMINAL_FACTOR, offset_free, reference_options
from torch_qpmpc.mpc.module import QPMPC

Policy = Callable[[Tensor], Tensor]
#: Rivals by name, each with the plant that it sees.
Rivals = dict[str, tuple[FourTanks | TankReferences, Policy]]
#: The horizons of the Kalman filter's MPC.
HORIZONS = (20, 40, 60)


def four_tanks_rivals(plant: FourTanks, log: TensorDictBase | None = None) -> Rivals:
    """Return the rivals for the set point; DeePC needs a ``log`` of actions and outputs."""
    policies: dict[str, Policy] = {
        f"Kalman filter, N = {N}": kalman_mpc(plant, N) for N in HORIZONS
    }
    if log is not None:
        policies["DeePC"] = deepc(plant, log)
    policies["omniscient"] = OmniscientMPC(plant, max(HORIZONS))
    return {name: (plant, policy) for name, policy in policies.items()}


def tank_references_rivals(plant: TankReferences) -> Rivals:
    """Return the rivals for the references, all with the plant's N but for their window."""
    short, long = replace(plant, past=1), replace(plant, past=5)
    return {
        "exact MPC": (short, reference_mpc(short, plant.A, plant.B)),
        "offset-free": (long, reference_mpc(long, *offset_free(plant.A, plant.B, memory=4))),
        "omniscient": (plant, OmniscientMPC(plant, plant.horizon, TERMINAL_FACTOR)),
    }


def kalman_mpc(plant: FourTanks, horizon: int) -> KalmanMPC:
    """Make the Kalman filter of the true model and noise, with MPC of the true model."""
    x_r, _ = plant.set_point()
    mpc = LinearMPC(Tracking.of(plant), plant.A, plant.B, horizon, x_r)
    return KalmanMPC(mpc, plant.A, plant.B, *plant.measurement(), torch.zeros_like(x_r))


def deepc(plant: FourTanks, log: TensorDictBase, horizon: int = 20) -> DeePC:
    """Make DeePC with the plant's window and the settings tuned for 1,000 steps."""
    Q, R = plant.weights()
    _, u_r = plant.set_point()
    return DeePC(
        log,
        plant.past,
        horizon,
        Q=Q,
        R=R,
        y_r=plant.r,
        u_r=u_r,
        lb_u=plant.lb_a,
        ub_u=plant.ub_a,
        lambda_g=0.1,
        lambda_y=100.0,
    )


def reference_mpc(plant: TankReferences, A: Tensor, B: Tensor) -> Policy:
    """Make MPC of a model and the plant's own cost, without discount."""
    options = reference_options(plant, gamma=1.0)
    return QPMPC.from_model(A, B, plant.horizon, solver="daqp", **options).policy
