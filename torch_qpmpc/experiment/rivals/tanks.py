"""The rivals of the tasks ``four_tanks`` and ``tank_references``.

Settings were chosen on logs and evaluations of other seeds than those that are reported.
"""

from __future__ import annotations

from functools import partial

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torch_qpmpc.envs.four_tanks import FourTanks
from torch_qpmpc.envs.tank_references import TankReferences
from torch_qpmpc.experiment.rivals import tightened
from torch_qpmpc.experiment.rivals.deepc import DeePC, uniform_log
from torch_qpmpc.experiment.rivals.linear_mpc import KalmanMPC, OmniscientMPC, Tracking
from torch_qpmpc.experiment.rivals.rival import Policy, Rival
from torch_qpmpc.experiment.tracking import TERMINAL_FACTOR, offset_free, reference_scheme
from torch_qpmpc.mpc.model import Model
from torch_qpmpc.mpc.module import QPMPC
from torch_qpmpc.qp.solve import solve_qp

#: The horizons of the Kalman filter's MPC.
HORIZONS = (20, 40, 60)
#: Steps and seed of the log that DeePC's data are.
LOG_STEPS, LOG_SEED = 1000, 0


def kalman_mpc(plant: FourTanks, horizon: int) -> KalmanMPC:
    """Make the Kalman filter of the true model and noise, with MPC of the true model."""
    (x_r, _), (n_x, n_u) = plant.set_point(), plant.B.shape
    references, offsets = x_r.expand(horizon + 1, n_x), x_r.new_zeros(horizon, n_x)
    qp = Tracking.of(plant).program(plant.A, plant.B, horizon, references, offsets)

    def mpc(x: Tensor) -> Tensor:
        return solve_qp(qp, x, solver="daqp").z[:, n_x : n_x + n_u]

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
    return QPMPC(reference_scheme(plant, Model(A, B), gamma=1.0), solver="daqp").policy


#: Rivals for the set point; DeePC has a log of its own.
FOUR_TANKS_RIVALS = {
    **{f"Kalman filter, N = {N}": Rival(partial(kalman_mpc, horizon=N)) for N in HORIZONS},
    "DeePC": Rival(lambda plant: deepc(plant, uniform_log(plant, LOG_STEPS, LOG_SEED))),
    "omniscient": Rival(lambda plant: OmniscientMPC(plant, max(HORIZONS))),
}

#: Rivals for the references, all with the plant's N.
TANK_REFERENCES_RIVALS = {
    "exact MPC": Rival(lambda plant: reference_mpc(plant, plant.A, plant.B), sees={"past": 1}),
    "offset-free": Rival(
        lambda plant: reference_mpc(plant, *offset_free(plant.A, plant.B, plant.past - 1)),
        sees={"past": 5},
    ),
    "tightened": Rival(tightened.tank_references, sees={"past": 1}),
    "omniscient": Rival(
        lambda plant: OmniscientMPC(plant, plant.horizon, TERMINAL_FACTOR), slow=True
    ),
}
