"""Mistakes with plants, their evaluation, statistics, and resuming."""

# The wrong types are the mistakes under test.
# pyright: reportArgumentType=false, reportCallIssue=false, reportAttributeAccessIssue=false
# pyright: reportIndexIssue=false, reportOperatorIssue=false, reportUnhashable=false

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from tests.mistakes.objects import mpc, op, pm
from torch_qpmpc.envs import (
    GrosZanonLTI,
    GymnasiumPlant,
    LinearSystemEnv,
    PointMass,
    PointMassEnv,
    PointMassGymEnv,
)
from torch_qpmpc.envs.closed_loop import closed_gap, closed_loop, gymnasium_loop
from torch_qpmpc.experiment.run_state import resumed

MISTAKES: dict[str, list[Callable[[], Any]]] = {
    "s: got shape (32, 4), expected shape (*batch, 2).": [
        lambda: closed_loop(mpc, pm),
        lambda: closed_loop(op.get_policy_operator(), pm),
    ],
    "steps: got 0, expected a whole number >= 1.": [
        lambda: closed_loop(lambda s: s[:, :2], pm, steps=0),
        lambda: gymnasium_loop(lambda s: s[:, :1], GymnasiumPlant("Pendulum-v1"), steps=0),
    ],
    "starts: got 0, expected a whole number >= 1.": [
        lambda: closed_loop(lambda s: s[:, :2], pm, starts=0).J,
        lambda: gymnasium_loop(
            lambda s: s[:, :1], GymnasiumPlant("Pendulum-v1"), starts=0, steps=1
        ),
    ],
    "seed: got -1, expected a whole number >= 0 and < 2^63.": [
        lambda: closed_loop(lambda s: s[:, :2], pm, seed=-1),
        lambda: PointMassEnv(2, seed=-1),
        lambda: pm.corrupted(-1),
    ],
    "gamma: got 2.0, expected a discount factor in [0, 1].": [
        lambda: closed_loop(lambda s: s[:, :2], pm, gamma=2.0).J_discounted
    ],
    "policy: got PointMass, expected a function. Pass a function of states, such": [
        lambda: closed_loop(pm, mpc.policy)
    ],
    "physics: got GymnasiumPlant, expected a LinearSystem. Use gymnasium_loop": [
        lambda: closed_loop(lambda s: s, GymnasiumPlant("Pendulum-v1"))
    ],
    "plant: got str, expected a GymnasiumPlant. Use closed_loop for a LinearSystem.": [
        lambda: gymnasium_loop(lambda s: s[:, :1], "Pendulum-v1")
    ],
    "J_start: got '1', expected a number, or nan.": [lambda: closed_gap("1", 1, 1)],
    "num_envs: got True, expected a whole number >= 1.": [lambda: PointMassEnv(True)],
    "max_steps: got 1.5, expected a whole number >= 1.": [lambda: PointMassEnv(2, max_steps=1.5)],
    "num_envs: got PointMass(A=tensor([[1.0000, 0.0000, 0.1000, 0.0000],": [
        lambda: PointMassEnv(pm)
    ],
    "dtype: got torch.int64, expected a floating-point torch.dtype.": [
        lambda: PointMassEnv(2, dtype=torch.int64)
    ],
    "physics: got str, expected a LinearSystem.": [
        lambda: PointMassEnv(2, physics="gaussian"),
        lambda: PointMassGymEnv("brownian"),
    ],
    f"seed: got {10**30}, expected a whole number >= 0 and < 2^63.": [
        lambda: PointMassEnv(2).set_seed(10**30),
        lambda: GymnasiumPlant("Pendulum-v1").vectorised(2, 5, seed=10**30),
    ],
    "physics: got QPMPC, expected a LinearSystem.": [lambda: LinearSystemEnv(mpc, 2, 5)],
    "start_position: got -1.0, expected a finite number >= 0.": [
        lambda: PointMass(start_position=-1.0)
    ],
    "start_velocity: got nan, expected a finite number >= 0.": [
        lambda: PointMass(start_velocity=math.nan)
    ],
    "B: got shape (4, 2), expected shape (3, n_u). Use torch.tensor(.., dtype=to": [
        lambda: PointMass(A=torch.eye(3))
    ],
    "A: got list, expected a floating-point torch.Tensor. Convert it: torch.as_t": [
        lambda: PointMass(A=[[1.0]])
    ],
    "lb_a: got torch.float32, expected torch.float64. Use torch.tensor(.., dtype": [
        lambda: PointMass(lb_a=torch.ones(2) * 2)
    ],
    "A: got NaN or inf, expected finite entries.": [
        lambda: PointMass(A=torch.eye(4).double() * math.nan)
    ],
    "lb_s: got shape (), expected shape (4,). Use torch.tensor(.., dtype=torch.f": [
        lambda: PointMass(lb_s=torch.tensor(-2.0).double())
    ],
    "s: got shape (3,), expected shape (*batch, 4).": [
        lambda: pm.step(torch.zeros(3), torch.zeros(2), torch.zeros(4))
    ],
    "s: got shape (5, 3), expected shape (*batch, 4).": [
        lambda: pm.cost(torch.zeros(5, 3), torch.zeros(5, 2))
    ],
    "a: got shape (5, 1), expected shape (*batch, 2).": [
        lambda: pm.applied(torch.zeros(5, 1)).shape,
        lambda: pm.step(torch.zeros(5, 4), torch.zeros(5, 1), torch.zeros(5, 4)).shape,
    ],
    "rng: got 1, expected a NumPy or torch generator. From a seed: numpy.ra": [
        lambda: pm.starts(1, 3),
        lambda: pm.draw(1, 3),
    ],
    "s: got shape (5, 1), expected shape (*batch, 4).": [
        lambda: pm.violation(torch.zeros(5, 1)).shape
    ],
    "nu: got shape (5, 1), expected shape (*batch, 4).": [
        lambda: pm.step(torch.zeros(5, 4), torch.zeros(5, 2), torch.zeros(5, 1)).shape
    ],
    "step: got no episode, expected one that has started. Call reset() first.": [
        lambda: PointMassGymEnv().step(np.zeros(2))
    ],
    "action: got 'a', expected finite numbers of shape (2,). Pass one action, not": [
        lambda: (lambda e: (e.reset(seed=0), e.step("a")))(PointMassGymEnv())
    ],
    "action: got array([nan, nan]), expected finite numbers of shape (2,). Pass one": [
        lambda: (lambda e: (e.reset(seed=0), e.step(np.full(2, np.nan))))(PointMassGymEnv())
    ],
    "action: got array([[0., 0.]]), expected finite numbers of shape (2,). Pass one": [
        lambda: (lambda e: (e.reset(seed=0), e.step(np.zeros((1, 2)))))(PointMassGymEnv())
    ],
    "num_envs: got 0, expected a whole number >= 1.": [
        lambda: GymnasiumPlant("Pendulum-v1").vectorised(0, 5, 1),
    ],
    "B: got shape (2, 1), expected shape (3, n_u). Use torch.tensor(.., dtype=to": [
        lambda: GrosZanonLTI(A=torch.eye(3))
    ],
    "task.id: got NoneType, expected a str.": [lambda: GymnasiumPlant(None)],
    "max_steps: got 0, expected a whole number >= 1.": [
        lambda: GymnasiumPlant("Pendulum-v1").vectorised(1, 0, 1)
    ],
    "s: got shape (2,), expected shape (*batch, 3).": [
        lambda: GymnasiumPlant("Pendulum-v1").violation(torch.zeros(2))
    ],
    "resume: got /nonexistent, without config.yaml, expected a run's folder.": [
        lambda: resumed("/nonexistent", [])
    ],
    "resume: got it together with seed=2, expected no other override. A run resu": [
        lambda: resumed("/x", ["seed=2"])
    ],
    "resume: got None, expected a path.": [lambda: resumed(None, [])],
}
