"""Chance-constrained MPC: the true model, and bounds tightened by the covariance of its noise.

A planned bound then holds with a probability of 95 %, as in `torch_qpmpc.mpc.tightening`, in
place of a margin that is learned. The spread of the predictions is that of the linear quadratic
regulator or, for a house, of the open loop. All schemes are without discount.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torch_qpmpc.envs.gros_zanon import GrosZanonLTI
from torch_qpmpc.envs.heated_house import CORRELATION, GAIN
from torch_qpmpc.envs.house import House
from torch_qpmpc.envs.linear_system import LinearSystem
from torch_qpmpc.envs.point_mass import PointMass
from torch_qpmpc.envs.tank_references import TankReferences
from torch_qpmpc.experiment.heating import known_model
from torch_qpmpc.experiment.rivals.heating import house_mpc
from torch_qpmpc.experiment.rivals.rival import Policy
from torch_qpmpc.experiment.tracking import reference_scheme
from torch_qpmpc.mpc.model import Model
from torch_qpmpc.mpc.module import QPMPC
from torch_qpmpc.mpc.regulator import lqr_gain
from torch_qpmpc.mpc.tightening import prediction_covariance, tighten

#: The horizon and the price of a violation for linear systems.
HORIZON, SLACK = 10, 100.0
#: Steps after which the variance of a random walk is its mean over an episode of 50.
HALF_EPISODE = 25


def point_mass(plant: PointMass) -> Policy:
    """Make the policy; Brownian noise is a state whose first variance is its episode's mean."""
    W = torch.diag(torch.cat((2 * plant.W.diagonal(), 0 * plant.lb_a)))
    unit = plant.std**2 * torch.eye(4).to(plant.A)
    return _linear(plant, W, unit, walk=plant.noise_kind == "brownian")


def gros_zanon(plant: GrosZanonLTI) -> Policy:
    """Make the policy; the uniform noise counts with its mean and variance."""
    W = torch.diag(plant.A.new_tensor([1.0, 1.0, 0.5]))
    return _linear(plant, W, torch.diag(plant.A.new_tensor([0.1**2 / 12, 0.0])))


def house(plant: House) -> Policy:
    """Make the policy; the random gain, an AR(1) process, is a state that is not measured."""
    A, _, E = plant.model()
    variance = plant.gain_std**2
    A = torch.block_diag(A, A.new_tensor([[CORRELATION]]))
    A[0, 1] = E[0, GAIN]
    W = torch.diag(A.new_tensor([0.0, (1 - CORRELATION**2) * variance]))
    initial = torch.diag(A.new_tensor([0.0, variance]))
    mpc = house_mpc(plant, known_model(plant))
    tighten(mpc, prediction_covariance(A, W, plant.horizon, initial)[:, :1, :1])
    return mpc.policy


def tank_references(plant: TankReferences) -> Policy:
    """Make the policy, for the noise of the levels without the mismatch of the model."""
    K = -lqr_gain(plant.A, plant.B, torch.diag(torch.cat(plant.weights())))
    W = plant.noise_std**2 * torch.eye(4).to(plant.A)
    scheme = reference_scheme(plant, Model(plant.A, plant.B), gamma=1.0)
    mpc = QPMPC(scheme, learn=(), solver="daqp")
    tighten(mpc, prediction_covariance(plant.A + plant.B @ K, W, plant.horizon), K=K)
    return mpc.policy


def _linear(plant: LinearSystem, weight: Tensor, W: Tensor, walk: bool = False) -> Policy:
    """Make the policy of a stage weight and a noise of covariance W, or a walk of such steps."""
    A, B, offset = plant.true_model()
    K = -lqr_gain(A, B, weight)
    closed, n_x = A + B @ K, len(A)
    initial = None
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
        action_bounds=(plant.lb_a, plant.ub_a),
        state_slack=SLACK,
        learn=(),
        solver="daqp",
    )
    tighten(mpc, covariances[:, :n_x, :n_x], K=K)
    return mpc.policy
