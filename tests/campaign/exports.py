"""Problems for the export: their QPs, random states, and the states of a closed loop."""

import functools
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

import train
from tests.benchmarks.problems import Size, make_mpc, model
from tests.examples import example
from tests.exported import rates, tied
from tests.runs import make_config
from torch_qpmpc import QPMPC
from torch_qpmpc.envs import GrosZanonLTI, LinearSystem, PointMass
from torch_qpmpc.envs.closed_loop import closed_loop
from torch_qpmpc.experiment.tasks import make_mpc as make_task_mpc
from torch_qpmpc.experiment.tasks import make_physics
from torch_qpmpc.study.runs import FinishedRun

Policy = Callable[[Tensor], Tensor]
Known = Callable[[np.random.Generator, int], np.ndarray]


class Problem(NamedTuple):
    """A QP, a function that draws p of ordinary size, and one that runs a policy on a plant.

    The latter returns the p of each step, ``(steps, starts, n_p)``.
    """

    mpc: QPMPC
    known: Known
    loop: Callable[[Policy], Tensor]


def box(size: list[float]) -> Known:
    return lambda rng, count: rng.uniform(-1, 1, (count, len(size))) * size


def linear(mpc: QPMPC, plant: LinearSystem, size: list[float]) -> Problem:
    return Problem(mpc, box(size), lambda policy: closed_loop(policy, plant).known[:-1])


def simulated(mpc: QPMPC, size: list[float]) -> Problem:
    """Return a scheme whose plant is its own model, with noise."""
    A, B = (x.detach() for x in mpc.model()[:2]) if mpc.structure != "free" else model(12, 4)

    def loop(policy: Policy) -> Tensor:
        rng = np.random.default_rng(1)
        s = [torch.as_tensor(box(size)(rng, 32))]
        for _ in range(50):
            noise = 0.01 * torch.as_tensor(rng.standard_normal(s[-1].shape))
            s.append(s[-1] @ A.mT + policy(s[-1]) @ B.mT + noise)
        return torch.stack(s[:-1])

    return Problem(mpc, box(size), loop)


def mass(horizon: int) -> Problem:
    return linear(make_mpc(Size(horizon, 4, 2), dense=False), PointMass(), [2.2, 2.2, 3.0, 3.0])


def learned(constraint: str, seed: int) -> Problem:
    """Train the paper's point mass, and return what it has learned."""
    cfg = make_config(f"constraint={constraint}", f"seed={seed}", "solver=daqp", "figures=false")
    with tempfile.TemporaryDirectory() as folder:
        train.train(cfg, folder, quiet=True)
        run = FinishedRun(Path(folder))
        return linear(run.policy, PointMass(), [2.2, 2.2, 3.0, 3.0])


def house() -> Problem:
    """Return the example house, with the signals of random days and random temperatures."""
    example("house")
    cfg = make_config("task=house")
    plant: Any = make_physics(cfg)
    mpc = make_task_mpc(cfg, plant)

    def known(rng: np.random.Generator, count: int) -> np.ndarray:
        def drawn(p: torch.Tensor) -> torch.Tensor:
            return 12 * torch.rand(len(p), 1).double()

        loop = closed_loop(drawn, plant, steps=96, starts=-(-count // 97))
        p = loop.known.flatten(0, 1).numpy()[:count]
        p[:, -1] = rng.uniform(8, 26, count)
        return p

    return Problem(mpc, known, lambda policy: closed_loop(policy, plant, steps=96).known[:-1])


def gros_zanon() -> Problem:
    cfg = make_config("task=gros_zanon")
    mpc = make_task_mpc(cfg, make_physics(cfg))
    return linear(mpc, GrosZanonLTI(), [1.2, 1.2])


def rate_limits() -> Problem:
    """Return the rate limits, whose loop is one of random states."""
    known = box([1.2, 1.2, 1.0])
    draws = known(np.random.default_rng(1), 1600).reshape(50, 32, 3)
    return Problem(rates(), known, lambda _: torch.as_tensor(draws))


PROBLEMS: dict[str, Callable[[], Problem]] = {
    "point mass, N = 5": functools.partial(mass, 5),
    "point mass, N = 10": functools.partial(mass, 10),
    "point mass, N = 40": functools.partial(mass, 40),
    "12 states, 4 actions, N = 10": lambda: simulated(
        make_mpc(Size(10, 12, 4), dense=False), [2.2] * 12
    ),
    "house, N = 32": house,
    "Gros and Zanon, N = 10": gros_zanon,
    "tied, mixed constraints, N = 8": lambda: simulated(tied(), [2.5, 1.5]),
    "rate limits, N = 6": rate_limits,
    "learned, C free": functools.partial(learned, "free", 1),
    "learned, deviation": functools.partial(learned, "deviation", 2),
    "learned, linear MPC": functools.partial(learned, "mpc", 3),
}
