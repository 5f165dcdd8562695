"""Four tanks whose two lower levels are measured with noise, driven to a set point, from a log.

    x+ = A x + B u + v,    y = [x_1, x_2] + e,    cost = 35 |y - r|^2 + 1e-4 |u - u_r|^2

The cost counts outputs without their noise. A Kalman filter estimates the state. The model is the
linearised one of Berberich, Köhler, Müller and Allgöwer, "Data-driven model predictive control with
stability and robustness guarantees" (IEEE TAC 2021, arXiv 1906.04679).

    python train.py task.file=docs/examples/four_tanks.py
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import scipy
import torch
import torch.nn.functional as F
from torch import Tensor

from torch_qpmpc import QPMPC, Bounds, Cost, Model, Scheme
from torch_qpmpc.envs.linear_system import float64, normal
from torch_qpmpc.envs.plant import Plant
from torch_qpmpc.experiment.tasks import Task, plant_layout, priced, register

INPUT_WEIGHT = 0.3  # R of the learned scheme: it makes up for errors of the model
LONG = 60  # the rival's horizon


@dataclass(frozen=True, eq=False, kw_only=True)
class FourTanks(Plant):
    """w = [v, e], both hidden; every episode starts at x = 0."""

    n_y: int = 2
    horizon: int = 20
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


def set_point_scheme(plant, model, layout, Q, R, r, gamma=1.0):
    """Make the scheme of (y - r)'Q(y - r) + (u - u_r)'R(u - u_r); y are the first states."""
    (_, u_r), rest, horizon = plant.set_point(), (0, layout.n_x - len(r)), layout.horizon
    weight, target = torch.cat((F.pad(Q, rest), R)), torch.cat((F.pad(r, rest), u_r))
    stage, terminal = weight @ target.square(), Q @ r.square()
    cost = Cost(
        torch.diag(2 * weight),
        torch.diag(2 * weight[: -len(R)]),
        hessian="block",
        q=(-2 * weight * target).repeat(horizon + 1)[: -len(R)],
        c=sum(gamma**k for k in range(horizon)) * stage + gamma**horizon * terminal,
    )
    return Scheme(layout, model, cost, Bounds(action_bounds=(plant.lb_a, plant.ub_a)), gamma)


def make_plant(cfg):
    return FourTanks(horizon=cfg.task.horizon)


def scheme(cfg, plant):
    """Make the scheme without a model, which start=data identifies."""
    Q, R = plant.weights()
    R, layout = torch.full_like(R, INPUT_WEIGHT), plant_layout(plant, plant.horizon)
    found = set_point_scheme(plant, Model(), layout, Q, R, plant.r, cfg.task.gamma)
    return replace(found, bounds=priced(cfg, found.bounds))


class KalmanMPC:
    """MPC with the true model and cost of the state that a stationary Kalman filter estimates."""

    def __init__(self, plant):
        (Q, R), (x_r, _), (C, V, E) = plant.weights(), plant.set_point(), plant.measurement()
        model = Model(plant.A, plant.B)
        exact = set_point_scheme(plant, model, model.layout(LONG), Q, R, x_r[:2])
        self.mpc = QPMPC(exact, learn=(), solver="daqp")
        P = scipy.linalg.solve_discrete_are(*(m.numpy() for m in (plant.A.mT, C.mT, V, E)))
        P = torch.as_tensor(P)
        self.gain = torch.linalg.solve(C @ P @ C.mT + E, C @ P).mT
        self.plant = plant

    def begin(self, plant, x, w):
        self.x, self.w, self.k, self.predicted = x, w, 0, torch.zeros_like(x)

    def __call__(self, p):
        now, plant = self.w[:, self.k], self.plant  # p has another model's estimate
        y = plant.output(self.x, now)
        x = self.predicted + (y - self.predicted[:, :2]) @ self.gain.mT
        u = plant.applied(self.mpc.policy(x))
        self.predicted = x @ plant.A.mT + u @ plant.B.mT
        self.x, self.k = plant.step(self.x, u, now), self.k + 1
        return u


def episode(plant, d):
    more = plant.n_x - 2  # states of an observer
    outputs = ["level 1", "level 2", *(f"state {i + 3}" for i in range(more))]
    r = F.pad(plant.r, (0, more), value=torch.nan).expand(len(d), -1)
    return {"outputs": outputs, "actions": ["pump 1", "pump 2"], "references": r}


OPTIONS = {"solver": "daqp", "num_envs": 4, "exploration_std": 0.3, "warmup_steps": 50}
OPTIONS |= {"gate": "act", "gate_interval": None}
OPTIONS |= {"start": {"transitions": 1000, "hold": 1.0}}
OPTIONS |= {"defaults": [{"override /constraint": "free"}, {"override /start": "data"}]}
TASK = {"horizon": 20, "gamma": 0.95, "episode_steps": 250, "eval_steps": 100}
TASK |= {"hessian": "block", "terminal_weight": "identity", "learn_cost": ["c"]}
register(
    Task(
        "four_tanks",
        make_plant,
        scheme,
        rivals={f"Kalman filter, N = {LONG}": KalmanMPC},
        episode=episode,
        defaults={**OPTIONS, "task": TASK},
    )
)
