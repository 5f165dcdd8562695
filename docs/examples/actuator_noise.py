"""A double integrator whose actuator multiplies its action by noise, from the model of the mean.

    x+ = A x + B u (1 + xi) + e,    cost = 1/2 [x; u]' W [x; u],    x = [position, velocity]

A known linear model predicts the mean of x+, but a large action makes the next state uncertain.
Without active bounds the optimal policy is linear (Wonham, SIAM J. Control 1967; de Koning,
Automatica 1982).

    python train.py task.file=docs/examples/actuator_noise.py weighted=true
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial

import torch
from torch import Tensor

from torch_qpmpc import QPMPC, Bounds, Cost, Model, Scheme
from torch_qpmpc.envs.linear_system import float64, normal, uniform
from torch_qpmpc.envs.plant import Plant
from torch_qpmpc.experiment.config import NonNegative, Positive
from torch_qpmpc.experiment.tasks import Task, TaskSettings, plant_layout, plant_scheme, register
from torch_qpmpc.mpc.riccati import riccati_weight

STARTS = 256  # closed loops of an evaluation: costs under this noise have heavy tails


@dataclass(frozen=True, eq=False, kw_only=True)
class ActuatorNoise(Plant):
    """w = [xi, e], normal and independent in time."""

    n_y: int = 2
    A: Tensor = field(default_factory=float64([1, 0.2], [0, 1]))
    B: Tensor = field(default_factory=float64([0.02], [0.2]))
    W: Tensor = field(default_factory=float64([1, 0, 0], [0, 0.1, 0], [0, 0, 0.01]))
    lb_a: Tensor = field(default_factory=float64(-10))
    ub_a: Tensor = field(default_factory=float64(10))
    actuator_std: float = 1.2
    noise_std: float = 0.02

    def signals(self, rng, count, length):
        std = self.A.new_tensor([self.actuator_std, self.noise_std, self.noise_std])
        return std * normal(rng, count, length, 3)

    def starts(self, rng, count):
        return 2 * uniform(rng, count, 2) - 1

    def cost(self, x, u, w):
        v = torch.cat((x, u), -1)
        return 0.5 * ((v @ self.W) * v).sum(-1)

    def step(self, x, u, w):
        return x @ self.A.mT + (1 + w[..., :1]) * u @ self.B.mT + w[..., 1:]


def noisy_stage_weight(A, B, W, gamma, std):
    """Return W with gamma std^2 B'PB added to the weight of u: the regulator is then optimal.

    P solves the generalised Riccati equation.
    """
    P, weight = riccati_weight(A, B, W, gamma), W
    for _ in range(10_000):
        last, weight = weight, W.clone()
        weight[-1, -1] += gamma * std**2 * (B.mT @ P @ B).item()
        if torch.allclose(weight, last, rtol=1e-12, atol=0):
            return weight
        P = riccati_weight(A, B, weight, gamma)
    raise ValueError("under this noise no policy has a finite cost")


def make_plant(cfg):
    task = cfg.task
    bounds = {"lb_a": float64(-task.a_max)(), "ub_a": float64(task.a_max)()}
    return ActuatorNoise(horizon=task.horizon, actuator_std=task.actuator_std, **bounds)


def wrong_scheme(cfg, plant):
    """Return MPC with the true mean and the plant's cost: certainty equivalence."""
    return plant_scheme(cfg, plant, Model(plant.A, plant.B), plant.W)


def true_scheme(cfg, plant):
    """Return the same scheme with the noise's weight, which is optimal while no bound is active."""
    weight = noisy_stage_weight(plant.A, plant.B, plant.W, cfg.task.gamma, plant.actuator_std)
    return plant_scheme(cfg, plant, Model(plant.A, plant.B), weight)


def heavier(plant, factor):
    """Make MPC of the mean without discount, with a heavier action: its weight, tuned by hand."""
    W = plant.W.clone()
    W[-1, -1] *= factor
    bounds = Bounds(action_bounds=(plant.lb_a, plant.ub_a))
    layout, model = plant_layout(plant, plant.horizon), Model(plant.A, plant.B)
    tuned = Scheme(layout, model, Cost(W, hessian="block"), bounds, gamma=1.0)
    return QPMPC(tuned, learn=(), solver="daqp").policy


def episode(plant, d):
    return {"outputs": ["position", "velocity"], "actions": ["acceleration"]}


class Settings(TaskSettings):
    actuator_std: NonNegative  # of the factor of the action
    a_max: Positive  # bound of the absolute action


OPTIONS = {"solver": "daqp", "steps_per_update": 10, "warmup_steps": 40, "updates": 60}
OPTIONS |= {"batch_size": 2000, "eval_interval": 10, "exploration_std": 0.5, "gate": False}
OPTIONS |= {"defaults": [{"override /constraint": "free"}]}
TASK = {"horizon": 5, "gamma": 0.95, "actuator_std": 1.2, "a_max": 10.0}
TASK |= {"episode_steps": 10, "eval_steps": 100, "hessian": "block", "terminal_weight": "riccati"}
TASK |= {"learn_cost": ["H", "H_f", "c"]}
register(
    Task(
        "actuator_noise",
        make_plant,
        wrong_scheme,
        true_scheme,
        starts=STARTS,
        rivals={f"{x} times the action's weight": partial(heavier, factor=x) for x in (10, 30)},
        nominal_scheme=wrong_scheme,
        episode=episode,
        settings=Settings,
        defaults={**OPTIONS, "task": TASK},
    )
)
