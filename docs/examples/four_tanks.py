"""Four tanks whose two lower levels are measured with noise, driven to a set point, from a log.

    x+ = A x + B u + v,    y = [x_1, x_2] + e,    cost = 35 |y - r|^2 + 1e-4 |u - u_r|^2

The cost counts outputs without their noise. p is a window of the last 10 outputs and actions. The
model is the linearised one of Berberich, Köhler, Müller and Allgöwer, "Data-driven model predictive
control with stability and robustness guarantees" (IEEE TAC 2021, arXiv 1906.04679).

    python train.py task.file=docs/examples/four_tanks.py
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import scipy
import torch
import torch.nn.functional as F
from torch import Tensor

from torch_qpmpc import QPMPC, Bounds, Cost, Model, Scheme
from torch_qpmpc.envs.closed_loop import plant_loop
from torch_qpmpc.envs.linear_system import float64, normal
from torch_qpmpc.envs.plant import Plant
from torch_qpmpc.experiment.fields import Count
from torch_qpmpc.experiment.tasks import Task, TaskSettings, priced, register

WRONG_LEAK, WRONG_GAIN = 0.04, 0.3  # largest errors of the wrong model
INPUT_WEIGHT = 0.3  # R of the learned scheme: it makes up for errors of the model
LONG = 60  # the rival's horizon


@dataclass(frozen=True, eq=False, kw_only=True)
class FourTanks(Plant):
    """w = [v, e], both hidden; every episode starts at x = 0."""

    n_y: int = 2
    horizon: int = 20
    past: int = 10
    A: Tensor = field(
        default_factory=float64(
            [0.921, 0, 0.041, 0], [0, 0.918, 0, 0.033], [0, 0, 0.924, 0], [0, 0, 0, 0.937]
        )
    )
    B: Tensor = field(
        default_factory=float64([0.017, 0.001], [0.001, 0.023], [0, 0.061], [0.072, 0])
    )
    r: Tensor = field(default_factory=float64(0.65, 0.77))
    lb_a: Tensor = field(default_factory=float64(-2, -2))
    ub_a: Tensor = field(default_factory=float64(2, 2))
    state_std: float = 0.01
    output_std: float = 0.1

    def weights(self):
        """Return Q and R, the diagonals of the cost's weights."""
        return self.r.new_full((2,), 35.0), self.r.new_full((2,), 1e-4)

    def set_point(self):
        """Return x_r and u_r, the steady state at which y = r."""
        gain = torch.linalg.solve(torch.eye(4).to(self.A) - self.A, self.B)
        u = torch.linalg.solve(gain[:2], self.r)
        return gain @ u, u

    def measurement(self):
        """Return C of y = C x + e, and the covariances of v and e."""
        unit = torch.eye(4).to(self.A)
        return unit[:2], self.state_std**2 * unit, self.output_std**2 * unit[:2, :2]

    def signals(self, rng, count, length):
        std = self.A.new_tensor([self.state_std] * 4 + [self.output_std] * 2)
        return normal(rng, length, count, 6).movedim(0, 1) * std

    def starts(self, rng, count):
        return self.A.new_zeros(count, 4)

    def output(self, x, w):
        return x[..., :2] + w[..., 4:]

    def cost(self, x, u, w):
        (Q, R), (_, u_r) = self.weights(), self.set_point()
        return (x[..., :2] - self.r).square() @ Q + (u - u_r).square() @ R

    def step(self, x, u, w):
        return x @ self.A.mT + u @ self.B.mT + w[..., :4]


def set_point_scheme(plant, model, horizon, Q, R, r, gamma=1.0):
    """Make the scheme of (y - r)'Q(y - r) + (u - u_r)'R(u - u_r), with r and u_r in q and c."""
    layout, (_, u_r) = model.layout(horizon), plant.set_point()
    weight, target = torch.cat((Q, R)), torch.cat((r, u_r))
    stage, terminal = weight @ target.square(), Q @ r.square()
    cost = Cost(
        torch.diag(2 * weight),
        torch.diag(2 * Q),
        hessian="block",
        q=F.pad((-2 * weight * target).repeat(horizon + 1)[: -len(R)], (layout.n_before, 0)),
        c=sum(gamma**k for k in range(horizon)) * stage + gamma**horizon * terminal,
    )
    return Scheme(layout, model, cost, Bounds(action_bounds=(plant.lb_a, plant.ub_a)), gamma)


def window_model(plant, A, B):
    """Return the best prediction of y_{k+1} from the window and u_k, with A = [A_1, .., A_L].

    A Kalman filter that begins with an unknown state, as a matrix that multiplies the window.
    """
    (C, V, E), past = plant.measurement(), plant.past
    n_x, n_u, n_y = *B.shape, len(C)
    n_p = past * (n_y + n_u) - n_u
    unit, P, estimate = torch.eye(n_p).to(A), 1e6 * torch.eye(n_x).to(A), A.new_zeros(n_x, n_p)
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
    return Model(A_lags.flatten(-2), B_lags.flatten(-2))


def make_plant(cfg):
    return FourTanks(horizon=cfg.task.horizon, past=cfg.task.past)


def wrong_scheme(cfg, plant):
    """Draw the wrong model by ``cfg.seed``; by default start=data replaces it by the log's."""
    rng = np.random.default_rng(cfg.seed)
    leaks = torch.as_tensor(rng.uniform(-WRONG_LEAK, WRONG_LEAK, 4))
    gains = torch.as_tensor(rng.uniform(1 - WRONG_GAIN, 1 + WRONG_GAIN, 2))
    return scheme(cfg, plant, plant.A + torch.diag(leaks), plant.B * gains, cfg.task.gamma)


def true_scheme(cfg, plant):
    return scheme(cfg, plant, plant.A, plant.B, 1.0)


def scheme(cfg, plant, A, B, gamma):
    Q, R = plant.weights()
    R = torch.full_like(R, INPUT_WEIGHT)
    model = window_model(plant, A, B)
    found = set_point_scheme(plant, model, plant.horizon, Q, R, plant.r, gamma)
    return replace(found, bounds=priced(cfg, found.bounds))


class KalmanMPC:
    """MPC with the true model and cost of the state that a stationary Kalman filter estimates."""

    def __init__(self, plant):
        (Q, R), (x_r, _), (C, V, E) = plant.weights(), plant.set_point(), plant.measurement()
        model, Q = Model(plant.A, plant.B), F.pad(Q, (0, 2))
        exact = set_point_scheme(plant, model, LONG, Q, R, x_r)
        self.mpc = QPMPC(exact, learn=(), solver="daqp")
        P = scipy.linalg.solve_discrete_are(*(m.numpy() for m in (plant.A.mT, C.mT, V, E)))
        P = torch.as_tensor(P)
        self.gain = torch.linalg.solve(C @ P @ C.mT + E, C @ P).mT
        self.plant = plant

    def begin(self, plant, x, w):
        self.predicted = torch.zeros_like(x)

    def __call__(self, p):
        x = self.predicted + (p[:, -2:] - self.predicted[:, :2]) @ self.gain.mT
        u = self.mpc.policy(x)
        self.predicted = x @ self.plant.A.mT + u @ self.plant.B.mT
        return u


def episode(plant, d):
    names = {"outputs": ["level 1", "level 2"], "actions": ["pump 1", "pump 2"]}
    return {**names, "references": plant.r.expand(len(d), -1)}


class Settings(TaskSettings):
    past: Count  # outputs in the window


OPTIONS = {"solver": "daqp", "num_envs": 4, "exploration_std": 0.3, "warmup_steps": 50}
OPTIONS |= {"gate": "act", "gate_interval": None}
OPTIONS |= {"start": {"transitions": 1000, "hold": 1.0, "ridge": 0.0}}
OPTIONS |= {"defaults": [{"override /constraint": "free"}, {"override /start": "data"}]}
TASK = {"horizon": 20, "past": 10, "gamma": 0.95, "episode_steps": 250, "eval_steps": 100}
TASK |= {"hessian": "block", "terminal_weight": "identity", "learn_cost": ["c"]}
register(
    Task(
        "four_tanks",
        make_plant,
        wrong_scheme,
        true_scheme,
        closed_loop=plant_loop,
        rivals={f"Kalman filter, N = {LONG}": KalmanMPC},
        episode=episode,
        settings=Settings,
        defaults={**OPTIONS, "task": TASK},
    )
)
