"""Controllers that learned ones are compared with: functions that make a policy for a plant.

The rival `IDENTIFICATION` of each task is made at the end of a run; see
`torch_qpmpc.experiment.tasks.identified.nominal_mpcs`.
"""

import re
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from torch_qpmpc.envs.linear_system import LinearSystem
from torch_qpmpc.mpc.module import QPMPC
from torch_qpmpc.mpc.riccati import lqr_gain
from torch_qpmpc.mpc.tightening import prediction_covariance, tighten

#: The name of `zero_action` among a task's rivals.
ZERO_ACTION = "zero action"
#: The name of MPC with the model of all of a run's transitions, a rival of each task.
IDENTIFICATION = "identification"
#: Maps p ``(starts, n_p)`` to actions ``(starts, n_u)``; see `closed_loop`.
Policy = Callable[[Tensor], Tensor]
#: The horizon and the price of a violation of `tightened`.
HORIZON, SLACK = 10, 100.0
#: Steps after which the variance of a random walk is its mean over an episode of 50.
HALF_EPISODE = 25


def scalar_name(name: str) -> str:
    """Return a rival's name as that of a scalar."""
    return re.sub(r"\W+", "_", name).strip("_")


def zero_action(plant: Any) -> Policy:
    """Make the policy that applies zero or, if the bounds exclude it, the nearest action."""
    action = torch.zeros_like(plant.lb_a).clamp(plant.lb_a, plant.ub_a)
    return lambda s: action.expand(len(s), -1)


def tightened(plant: LinearSystem, weight: Tensor, W: Tensor, walk: bool = False) -> Policy:
    """Make chance-constrained MPC: the true model, and bounds tightened by its noise.

    A planned bound then holds with a probability of 95 %, as in `torch_qpmpc.mpc.tightening`, with
    the regulator of the stage ``weight`` as feedback. There is no discount. ``W`` ``(n_x, n_x)`` is
    the covariance of the noise or, if that is a random ``walk``, of its steps; the walk's first
    variance is then the mean over an episode.
    """
    A, B, offset = plant.true_model()
    K = -lqr_gain(A, B, weight)
    closed, n_x, initial = A + B @ K, len(A), None
    if walk:
        unit, zero = torch.eye(n_x).to(A), torch.zeros_like(A)
        closed = torch.cat((torch.cat((closed, unit), -1), torch.cat((zero, unit), -1)))
        initial = torch.block_diag(zero, HALF_EPISODE * W)
        W = W.repeat(2, 2)
    covariances = prediction_covariance(closed, W, HORIZON, initial)
    mpc = QPMPC.from_model(
        A,
        B,
        HORIZON,
        gamma=1.0,
        offset=offset,
        hessian="block",
        stage_weight=weight,
        terminal_weight="riccati",
        state_bounds=(plant.lb_s, plant.ub_s),
        state_slack=SLACK,
        action_bounds=(plant.lb_a, plant.ub_a),
        learn=(),
        solver="daqp",
    )
    tighten(mpc, covariances[:, :n_x, :n_x], K=K)
    return mpc.policy
