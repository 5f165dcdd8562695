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
    GrosZanonLTIEnv,
    GymnasiumPlant,
    LinearSystemEnv,
    PointMass,
    PointMassEnv,
    PointMassGymEnv,
)
from torch_qpmpc.envs.closed_loop import closed_gap, closed_loop, gymnasium_loop
from torch_qpmpc.experiment.run_state import resumed
from torch_qpmpc.study.statistics import bootstrap_interval, interquartile_mean

MISTAKES: dict[str, tuple[Callable[[], Any], str]] = {
    "closed_loop: policy mpc": (
        lambda: closed_loop(mpc, pm),
        "s: got shape (32, 4), expected shape (*batch, 2).",
    ),
    "closed_loop: policy op": (
        lambda: closed_loop(op.get_policy_operator(), pm),
        "s: got shape (32, 4), expected shape (*batch, 2).",
    ),
    "closed_loop: steps 0": (
        lambda: closed_loop(lambda s: s[:, :2], pm, steps=0),
        "steps: got 0, expected a whole number >= 1.",
    ),
    "closed_loop: starts 0": (
        lambda: closed_loop(lambda s: s[:, :2], pm, starts=0).J,
        "starts: got 0, expected a whole number >= 1.",
    ),
    "closed_loop: seed": (
        lambda: closed_loop(lambda s: s[:, :2], pm, seed=-1),
        "seed: got -1, expected a whole number >= 0 and < 2^63.",
    ),
    "closed_loop: gamma": (
        lambda: closed_loop(lambda s: s[:, :2], pm, gamma=2.0).J_discounted,
        "gamma: got 2.0, expected a discount factor in [0, 1].",
    ),
    "closed_loop: swapped": (
        lambda: closed_loop(pm, mpc.policy),
        "policy: got PointMass, expected a function. Pass a function of states, such",
    ),
    "closed_loop: gymplant": (
        lambda: closed_loop(lambda s: s, GymnasiumPlant("Pendulum-v1")),
        "physics: got GymnasiumPlant, expected a LinearSystem. Use gymnasium_loop",
    ),
    "gymnasium_loop: id": (
        lambda: gymnasium_loop(lambda s: s[:, :1], "Pendulum-v1"),
        "plant: got str, expected a GymnasiumPlant. Use closed_loop for a LinearSystem.",
    ),
    "gymnasium_loop: steps": (
        lambda: gymnasium_loop(lambda s: s[:, :1], GymnasiumPlant("Pendulum-v1"), steps=0),
        "steps: got 0, expected a whole number >= 1.",
    ),
    "gymnasium_loop: starts": (
        lambda: gymnasium_loop(
            lambda s: s[:, :1], GymnasiumPlant("Pendulum-v1"), starts=0, steps=1
        ),
        "starts: got 0, expected a whole number >= 1.",
    ),
    "closed_gap: str": (
        lambda: closed_gap("1", 1, 1),
        "J_start: got '1', expected a number, or nan.",
    ),
    "interquartile_mean: empty": (
        lambda: interquartile_mean(np.array([])),
        "x: got no values, expected at least one along axis 0.",
    ),
    "interquartile_mean: axis": (
        lambda: interquartile_mean(np.ones(3), axis=2),
        "x: got source: axis 2 is out of bounds for array of dimension 1, expected n",
    ),
    "interquartile_mean: str": (
        lambda: interquartile_mean(["a"]),
        "x: got could not convert string to float: 'a', expected numbers along axis ",
    ),
    "bootstrap_interval: array": (
        lambda: bootstrap_interval(np.ones(3)),
        "strata: got ndarray, expected a list of arrays. Pass [x] for a single strat",
    ),
    "bootstrap_interval: float": (
        lambda: bootstrap_interval(1.0),
        "strata: got float, expected a list of arrays. Pass [x] for a single stratum",
    ),
    "bootstrap_interval: level": (
        lambda: bootstrap_interval([np.ones(3)], level=95),
        "level: got 95, expected a level in (0, 1). 95% is 0.95.",
    ),
    "bootstrap_interval: resamples": (
        lambda: bootstrap_interval([np.ones(3)], resamples=0),
        "resamples: got 0, expected a whole number >= 1.",
    ),
    "bootstrap_interval: stat": (
        lambda: bootstrap_interval([np.ones(3)], "median"),
        "statistic: got 'median', expected a function, such as numpy.median.",
    ),
    "bootstrap_interval: shapes": (
        lambda: bootstrap_interval([np.ones((3, 2)), np.ones((3, 3))]),
        "strata: got shapes [(3, 2), (3, 3)], expected (n_i, ...) with ... the same ",
    ),
    "bootstrap_interval: seed": (
        lambda: bootstrap_interval([np.ones(3)], seed=-1),
        "seed: got -1, expected a whole number >= 0 and < 2^63.",
    ),
    "bootstrap_interval: scalar strata": (
        lambda: bootstrap_interval([1.0, 2.0]),
        "strata: got shapes [(), ()], expected (n_i, ...) with ... the same for all.",
    ),
    "PointMassEnv: num f": (
        lambda: PointMassEnv(1.5),
        "num_envs: got 1.5, expected a whole number >= 1.",
    ),
    "PointMassEnv: num bool": (
        lambda: PointMassEnv(True),
        "num_envs: got True, expected a whole number >= 1.",
    ),
    "PointMassEnv: max f": (
        lambda: PointMassEnv(2, max_steps=1.5),
        "max_steps: got 1.5, expected a whole number >= 1.",
    ),
    "PointMassEnv: physics first": (
        lambda: PointMassEnv(pm),
        "num_envs: got PointMass(A=tensor([[1.0000, 0.0000, 0.1000, 0.0000],",
    ),
    "PointMassEnv: dtype": (
        lambda: PointMassEnv(2, dtype=torch.int64),
        "dtype: got torch.int64, expected a floating-point torch.dtype.",
    ),
    "PointMassEnv: physics str": (
        lambda: PointMassEnv(2, physics="gaussian"),
        "physics: got str, expected a LinearSystem.",
    ),
    "PointMassEnv: set_seed": (
        lambda: PointMassEnv(2).set_seed(10**30),
        f"seed: got {10**30}, expected a whole number >= 0 and < 2^63.",
    ),
    "GymnasiumPlant: seed": (
        lambda: GymnasiumPlant("Pendulum-v1").vectorised(2, 5, seed=10**30),
        f"seed: got {10**30}, expected a whole number >= 0 and < 2^63.",
    ),
    "PointMassEnv: seed neg": (
        lambda: PointMassEnv(2, seed=-1),
        "seed: got -1, expected a whole number >= 0 and < 2^63.",
    ),
    "PointMassEnv: physics other": (
        lambda: LinearSystemEnv(mpc, 2, 5),
        "physics: got QPMPC, expected a LinearSystem.",
    ),
    "PointMass: start neg": (
        lambda: PointMass(start_position=-1.0),
        "start_position: got -1.0, expected a finite number >= 0.",
    ),
    "PointMass: start nan": (
        lambda: PointMass(start_velocity=math.nan),
        "start_velocity: got nan, expected a finite number >= 0.",
    ),
    "PointMass: A": (
        lambda: PointMass(A=torch.eye(3)),
        "B: got shape (4, 2), expected shape (3, n_u). Use torch.tensor(.., dtype=to",
    ),
    "PointMass: A list": (
        lambda: PointMass(A=[[1.0]]),
        "A: got list, expected a floating-point torch.Tensor. Convert it: torch.as_t",
    ),
    "PointMass: bounds": (
        lambda: PointMass(lb_a=torch.ones(2) * 2),
        "lb_a: got torch.float32, expected torch.float64. Use torch.tensor(.., dtype",
    ),
    "PointMass: A nan": (
        lambda: PointMass(A=torch.eye(4).double() * math.nan),
        "A: got NaN or inf, expected finite entries.",
    ),
    "PointMass: lb shape": (
        lambda: PointMass(lb_s=torch.tensor(-2.0).double()),
        "lb_s: got shape (), expected shape (4,). Use torch.tensor(.., dtype=torch.f",
    ),
    "PointMass: step shape": (
        lambda: pm.step(torch.zeros(3), torch.zeros(2), torch.zeros(4)),
        "s: got shape (3,), expected shape (*batch, 4).",
    ),
    "PointMass: cost shape": (
        lambda: pm.cost(torch.zeros(5, 3), torch.zeros(5, 2)),
        "s: got shape (5, 3), expected shape (*batch, 4).",
    ),
    "PointMass: applied": (
        lambda: pm.applied(torch.zeros(5, 1)).shape,
        "a: got shape (5, 1), expected shape (*batch, 2).",
    ),
    "PointMass: starts seed": (
        lambda: pm.starts(1, 3),
        "rng: got 1, expected a NumPy or torch generator. From a seed: numpy.ra",
    ),
    "PointMass: draw seed": (
        lambda: pm.draw(1, 3),
        "rng: got 1, expected a NumPy or torch generator. From a seed: numpy.ra",
    ),
    "PointMass: viol": (
        lambda: pm.violation(torch.zeros(5, 1)).shape,
        "s: got shape (5, 1), expected shape (*batch, 4).",
    ),
    "PointMass: corrupted": (
        lambda: pm.corrupted(-1),
        "seed: got -1, expected a whole number >= 0 and < 2^63.",
    ),
    "PointMass: nu 1d": (
        lambda: pm.step(torch.zeros(5, 4), torch.zeros(5, 2), torch.zeros(5, 1)).shape,
        "nu: got shape (5, 1), expected shape (*batch, 4).",
    ),
    "PointMass: a scalar col": (
        lambda: pm.step(torch.zeros(5, 4), torch.zeros(5, 1), torch.zeros(5, 4)).shape,
        "a: got shape (5, 1), expected shape (*batch, 2).",
    ),
    "PointMassGymEnv: before reset": (
        lambda: PointMassGymEnv().step(np.zeros(2)),
        "step: got no episode, expected one that has started. Call reset() first.",
    ),
    "PointMassGymEnv: action str": (
        lambda: (lambda e: (e.reset(seed=0), e.step("a")))(PointMassGymEnv()),
        "action: got 'a', expected finite numbers of shape (2,). Pass one action, not",
    ),
    "PointMassGymEnv: action nan": (
        lambda: (lambda e: (e.reset(seed=0), e.step(np.full(2, np.nan))))(PointMassGymEnv()),
        "action: got array([nan, nan]), expected finite numbers of shape (2,). Pass one",
    ),
    "PointMassGymEnv: physics": (
        lambda: PointMassGymEnv("brownian"),
        "physics: got str, expected a LinearSystem.",
    ),
    "PointMassGymEnv: (1,2)": (
        lambda: (lambda e: (e.reset(seed=0), e.step(np.zeros((1, 2)))))(PointMassGymEnv()),
        "action: got array([[0., 0.]]), expected finite numbers of shape (2,). Pass one",
    ),
    "GrosZanonLTI: num": (
        lambda: GrosZanonLTIEnv(0),
        "num_envs: got 0, expected a whole number >= 1.",
    ),
    "GrosZanonLTI: A": (
        lambda: GrosZanonLTI(A=torch.eye(3)),
        "B: got shape (2, 1), expected shape (3, n_u). Use torch.tensor(.., dtype=to",
    ),
    "GymnasiumPlant: none": (
        lambda: GymnasiumPlant(None),
        "task.id: got NoneType, expected a str.",
    ),
    "GymnasiumPlant: vec 0": (
        lambda: GymnasiumPlant("Pendulum-v1").vectorised(0, 5, 1),
        "num_envs: got 0, expected a whole number >= 1.",
    ),
    "GymnasiumPlant: vec steps": (
        lambda: GymnasiumPlant("Pendulum-v1").vectorised(1, 0, 1),
        "max_steps: got 0, expected a whole number >= 1.",
    ),
    "GymnasiumPlant: viol": (
        lambda: GymnasiumPlant("Pendulum-v1").violation(torch.zeros(2)),
        "s: got shape (2,), expected shape (*batch, 3).",
    ),
    "GymnasiumPlant: module": (
        lambda: GymnasiumPlant("nomod:Env-v0"),
        "task.id: got 'nomod:Env-v0', expected an environment that Gymnasium can mak",
    ),
    "resumed: none": (
        lambda: resumed("/nonexistent", []),
        "resume: got /nonexistent, without config.yaml, expected a run's folder.",
    ),
    "resumed: others": (
        lambda: resumed("/x", ["seed=2"]),
        "resume: got it together with seed=2, expected no other override. A run resu",
    ),
    "resumed: type": (
        lambda: resumed(None, []),
        "resume: got None, expected a path.",
    ),
}
