"""Three integrators with a tight input, and MPC whose horizon is too short for them.

    x+ = A x + B u,    cost = 1/2 [x; u]' W [x; u],    |u| <= 1

x is the position, the velocity and the acceleration; the model is exact. From many starts the input
is at its bound for more steps than the horizon sees, and whoever brakes too late never settles. The
cost beyond the horizon is what is to be learned.

    python train.py task.file=docs/examples/short_horizon.py weighted=true
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from torch_qpmpc import QPMPC, Bounds, Cost, Layout, Model, Scheme
from torch_qpmpc.envs.linear_system import float64, uniform
from torch_qpmpc.envs.plant import Plant
from torch_qpmpc.experiment.tasks import Task, plant_layout, plant_scheme, register

STARTS = 256  # closed loops of an evaluation
REACH = (2.0, 1.0, 0.5)  # the largest absolute entries of a start
LONG = 30  # the true scheme's horizon, beyond which a longer one costs the same
HEAVIER = 100.0  # factor of the action's weight in the rival: the best of 10, 100 and 1000


@dataclass(frozen=True, eq=False, kw_only=True)
class TripleIntegrator(Plant):
    n_y: int = 3
    A: Tensor = field(default_factory=float64([1, 0.2, 0.02], [0, 1, 0.2], [0, 0, 1]))
    B: Tensor = field(default_factory=float64([0.2**3 / 6], [0.02], [0.2]))
    W: Tensor = field(
        default_factory=float64([1, 0, 0, 0], [0, 0.1, 0, 0], [0, 0, 0.01, 0], [0, 0, 0, 0.01])
    )
    lb_a: Tensor = field(default_factory=float64(-1))
    ub_a: Tensor = field(default_factory=float64(1))

    def signals(self, rng, count, length):
        return self.A.new_zeros(count, length, 0)

    def starts(self, rng, count):
        return (2 * uniform(rng, count, 3) - 1) * self.A.new_tensor(REACH)

    def cost(self, x, u, w):
        v = torch.cat((x, u), -1)
        return 0.5 * ((v @ self.W) * v).sum(-1)

    def step(self, x, u, w):
        return x @ self.A.mT + u @ self.B.mT


def wrong_scheme(cfg, plant):
    """Return MPC with the true model and cost, which is optimal while no bound is active."""
    return plant_scheme(cfg, plant, Model(plant.A, plant.B), plant.W)


def true_scheme(cfg, plant):
    """Return the same scheme without discount, with the horizon `LONG`."""
    return replace(wrong_scheme(cfg, plant), layout=plant_layout(plant, LONG), gamma=1.0)


def heavier(plant):
    """Make MPC of the same horizon without discount, with a heavier action."""
    W = plant.W.clone()
    W[-1, -1] *= HEAVIER
    scheme = Scheme(
        Layout(3, 1, plant.horizon),
        Model(plant.A, plant.B),
        Cost(W, hessian="block"),
        Bounds(action_bounds=(plant.lb_a, plant.ub_a)),
        gamma=1.0,
    )
    return QPMPC(scheme, learn=(), solver="daqp").policy


def episode(plant, d):
    return {"outputs": ["position", "velocity", "acceleration"], "actions": ["jerk"]}


OPTIONS = {"solver": "daqp", "steps_per_update": 10, "warmup_steps": 40, "updates": 20}
OPTIONS |= {"batch_size": 2000, "eval_interval": 5, "exploration_std": 0.3, "gate": False}
OPTIONS |= {"td_error_clip": None, "defaults": [{"override /constraint": "fixed"}]}
TASK = {"horizon": 3, "gamma": 0.98, "episode_steps": 50, "eval_steps": 150}
TASK |= {"hessian": "block", "terminal_weight": "riccati", "learn_cost": ["H", "H_f", "c"]}
register(
    Task(
        "short_horizon",
        lambda cfg: TripleIntegrator(horizon=cfg.task.horizon),
        wrong_scheme,
        true_scheme,
        starts=STARTS,
        rivals={f"{HEAVIER:g} times the action's weight": heavier},
        nominal_scheme=wrong_scheme,
        episode=episode,
        defaults={**OPTIONS, "task": TASK},
    )
)
