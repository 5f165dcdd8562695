"""Plants of other packages, from their id and data: ``python -m tests.benchmarks.outside``.

Each plant is a Gymnasium id, with a shim where its package has none, and its start is that of

    python train.py task=gymnasium task.id=ID start=data

Beside it are zero action and a reference that knows the plant, in the same episodes, which chose
nothing. The packages are optional:

    pip install 'gymnasium[mujoco]' pcgym
    pip install --no-deps controlgym building-energy-storage-simulation 'setuptools<81'

Finished rows are kept in docs/results/outside.csv and not repeated; the table goes into
docs/results/outside.md.
"""

from __future__ import annotations

import argparse
import importlib.util
import math
import tempfile
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from importlib import import_module
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import torch
from scipy.optimize import linprog

from tests.benchmarks import plants
from tests.benchmarks.table import DOCS, keep, options_of, table, write_section
from tests.runs import compose_config
from torch_qpmpc.experiment.algorithms import evaluate
from torch_qpmpc.experiment.choosing import LINEAR
from torch_qpmpc.experiment.config import Config
from torch_qpmpc.experiment.evaluation import cost_text
from torch_qpmpc.experiment.rivals import zero_action
from torch_qpmpc.experiment.start import make_start
from torch_qpmpc.experiment.tasks import AnyPlant, make_mpc, make_physics
from torch_qpmpc.experiment.tasks.code import run_code
from torch_qpmpc.learning.operators import warm_policy

PAGE = DOCS / "results" / "outside.md"
RESULTS = DOCS / "results" / "outside.csv"
SEEDS, EVAL_SEED = (1, 2, 3), 9002
#: Rows of the table: a cost that is above zero action's by more than this many standard errors.
ERRORS = 2.0
#: The module that `gymnasium.make` imports for an id of a shim.
HERE = "tests.benchmarks.outside"


class Outside(NamedTuple):
    """A plant of another package.

    Attributes:
        id: as in ``task.id``.
        package: the one that it needs, as Python imports it.
        reference: returns J of its own controller; None for the reward that its package calls
            solved, if it has one.
        overrides: further ones of train.py.
    """

    id: str
    package: str
    reference: Callable[[], float] | None = None
    overrides: Sequence[str] = ()


# pcgym: the package's examples and default tasks, and its NMPC with the true model.
LEVELS = np.repeat
PCGYM: dict[str, dict[str, Any]] = {
    "cstr": {
        "N": 100,
        "tsim": 26,
        "SP": {"Ca": [*LEVELS([0.85, 0.9], 50)]},
        "o_space": {"low": np.array([0.7, 300, 0.8]), "high": np.array([1, 350, 0.9])},
        "a_space": {"low": np.array([295]), "high": np.array([302])},
        "x0": np.array([0.8, 330, 0.8]),
    },
    "four_tank": {
        "N": 60,
        "tsim": 1000,
        "SP": {"h3": [*LEVELS([0.5, 0.1, 0.2], 20)], "h4": [*LEVELS([0.2, 0.3, 0.4], 20)]},
        "o_space": {"low": np.zeros(6), "high": np.full(6, 0.6)},
        "a_space": {"low": np.full(2, 0.1), "high": np.full(2, 10.0)},
        "x0": np.array([0.141, 0.112, 0.072, 0.42, 0.5, 0.2]),
    },
    "multistage_extraction": {
        "N": 60,
        "tsim": 60,
        "SP": {"X5": [*LEVELS([0.3, 0.4, 0.3], 20)]},
        "o_space": {"low": np.array([0.0] * 10 + [0.3]), "high": np.array([1.0] * 10 + [0.4])},
        "a_space": {"low": np.array([5.0, 10.0]), "high": np.array([500.0, 1000.0])},
        "x0": np.array([0.55, 0.3, 0.45, 0.25, 0.4, 0.20, 0.35, 0.15, 0.25, 0.1, 0.3]),
    },
    "nonsmooth_control": {
        "N": 60,
        "tsim": 5,
        "SP": {"X1": [0.0] * 60},
        "o_space": {"low": np.full(3, -1.0), "high": np.full(3, 1.0)},
        "a_space": {"low": np.array([-1.0]), "high": np.array([1.0])},
        "x0": np.array([0.8, 0.0, 0.0]),
    },
}


def pcgym_parameters(model: str) -> dict[str, Any]:
    common = {"normalise_a": True, "normalise_o": True, "noise": True, "noise_percentage": 0.001}
    own = PCGYM[model]
    common |= {"r_scale": dict.fromkeys(own["SP"], 1e3), "integration_method": "casadi"}
    return {**common, **own, "model": model}


class PcGym(gymnasium.Wrapper):
    """A pcgym environment, whose noise is of NumPy's global generator."""

    def __init__(self, model: str) -> None:
        super().__init__(import_module("pcgym").make_env(pcgym_parameters(model)))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        if seed is not None:
            np.random.seed(seed)  # noqa: NPY002 (pcgym's)
        return self.env.reset()


class _Seconds(float):
    """A sample time by which do-mpc's times, arrays of one entry, divide to numbers."""

    __array_ufunc__ = None

    def __rtruediv__(self, time: Any) -> float:
        return float(np.ravel(time)[0]) / float(self)

    def __radd__(self, time: Any) -> Any:
        return time + float(self)


def pcgym_oracle(model: str) -> float:
    """Return J of the inputs of pcgym's NMPC, which has the true model."""
    parameters = pcgym_parameters(model)
    make_env = import_module("pcgym").make_env
    oracle = import_module("pcgym.oracle").oracle(make_env, pcgym_parameters(model))
    names, scale = oracle.model_info["states"], parameters["r_scale"]
    oracle.Q = np.diag([scale.get(name, 0.0) for name in names]) / max(scale.values())
    oracle.env.dt = _Seconds(oracle.env.dt)
    _, inputs = oracle.mpc()
    low, high = (parameters["a_space"][name][:, None] for name in ("low", "high"))
    env = PcGym(model)
    env.reset(seed=EVAL_SEED)
    J = 0.0
    for u in (2 * (inputs - low) / (high - low) - 1).T:
        _, reward, terminated, truncated, _ = env.step(u)
        J -= float(reward)
        if terminated or truncated:
            break
    return J


#: Points of the partial differential equations, so that an episode takes less than a second; and
#: the limit of the actions where 1 is too little for the plant.
SETTINGS: dict[str, Any] = {
    id: {"n_state": 64} for id in ("convection_diffusion_reaction", "allen_cahn")
}
SETTINGS["he3"] = {"action_limit": 10.0}


class ControlGym(gymnasium.Wrapper):
    """A controlgym environment; its actions are limited, so that a log can be collected."""

    def __init__(self, plant: str) -> None:
        super().__init__(controlgym(plant))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        return self.env.reset(seed=seed)


def controlgym(plant: str) -> Any:
    with warnings.catch_warnings():  # the package turns all warnings into errors
        package, _ = import_module("controlgym"), import_module("controlgym.controllers")
    settings = {"n_steps": 100, "action_limit": 1.0} | SETTINGS.get(plant, {})
    return package.make(plant, **settings)


def controlgym_lqg(plant: str, crossed: bool = True) -> float:
    """Return J of LQG with the true matrices, the limits of the action and an unknown first state.

    The filter begins with the distribution of the first states of 1,000 resets. If not ``crossed``,
    the regulator's weight has no products of states and actions, as a `LinearMPC` has none.
    """
    env = controlgym(plant)
    make = import_module("controlgym.controllers").LQG
    if crossed:
        lqg = make(env)
    else:
        whole, env.S = env.S, np.zeros_like(env.S)
        lqg, env.S = make(env), whole
    A, B, C = env.A, env.B2, env.C
    if hasattr(env, "B1"):
        W, V = (env.noise_cov * x @ x.T for x in (env.B1, env.D21))
    else:
        W, V = env.process_noise_cov * np.eye(len(A)), env.sensor_noise_cov * np.eye(len(C))
    first = np.array([env.reset(seed=i)[1]["state"] for i in range(1000)])

    def corrected(x: Any, P: Any, y: Any) -> Any:
        gain = P @ C.T @ np.linalg.pinv(C @ P @ C.T + V)
        return x + gain @ (y - C @ x), P - gain @ C @ P

    costs = []
    for i in range(32):
        y, over, J = env.reset(seed=EVAL_SEED + i)[0], False, 0.0
        x, P = corrected(first.mean(0), np.cov(first.T).reshape(A.shape), y)
        while not over:
            u = np.clip(lqg.select_action(x), env.action_space.low, env.action_space.high)
            y, reward, terminated, truncated, _ = env.step(u)  # y is of the state before
            x, P = corrected(x, P, y)
            x, P = A @ x + B @ u, A @ P @ A.T + W
            J, over = J - float(reward), terminated or truncated
        costs.append(J)
    return float(np.mean(costs))


BATTERY, WEEK = "building_energy_storage_simulation", 168  # hours


class Battery(gymnasium.Wrapper):
    """A battery in a building, in a week that NumPy's global generator chooses."""

    def __init__(self) -> None:
        package = import_module(BATTERY)
        building = package.BuildingSimulation()
        super().__init__(package.Environment(building, WEEK, randomize_start_time_step=True))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        if seed is not None:
            np.random.seed(seed)  # noqa: NPY002 (the package's)
        return self.env.reset()


def battery_plans() -> float:
    """Return J of linear programs that know each week's loads and prices."""
    env, costs = Battery(), []
    low = np.tril(np.ones((WEEK, WEEK)))  # sums of the charge
    none = np.zeros((WEEK, WEEK))
    for i in range(32):
        env.reset(seed=EVAL_SEED + i)
        building: Any = env.get_wrapper_attr("building_simulation")
        week = slice(building.start_index, building.start_index + WEEK)
        net = (building.electricity_load_profile - building.solar_generation_profile)[week]
        battery, price = building.battery, building.electricity_price[week]
        most = battery.max_battery_charge_per_timestep
        # Charge b and energy from the grid, which is at least net + b, and at most net + most.
        A = np.block([[np.eye(WEEK), -np.eye(WEEK)], [low, none], [-low, none]])
        b = np.concatenate([-net, np.full(WEEK, battery.capacity), np.zeros(WEEK)])
        grid = [(0.0, max(0.0, x + most)) for x in net]
        c = np.concatenate([np.zeros(WEEK), price])
        costs.append(linprog(c, A, b, bounds=[(-most, most)] * WEEK + grid).fun)
    return float(np.mean(costs))


def _own(name: str, make: Callable[..., gymnasium.Env], rule: Callable[[int], float]) -> Outside:
    id = _registered(f"{name}-v0", make, 100)
    return Outside(id, "gymnasium", partial(rule, EVAL_SEED))


def _registered(name: str, make: Callable[..., gymnasium.Env], steps: int) -> str:
    if name not in gymnasium.registry:  # this module is __main__, too
        gymnasium.register(name, entry_point=make, max_episode_steps=steps)
    return f"{HERE}:{name}"


def _pcgym(model: str) -> Outside:
    name = f"Pcgym-{model}-v0"
    id = _registered(name, partial(PcGym, model), PCGYM[model]["N"])
    return Outside(id, "pcgym", partial(pcgym_oracle, model))


def _controlgym(plant: str, *overrides: str) -> Outside:
    id = _registered(f"Controlgym-{plant}-v0", partial(ControlGym, plant), 100)
    return Outside(id, "controlgym", partial(controlgym_lqg, plant), overrides)


PLANTS = {
    "Pendulum": Outside("Pendulum-v1", "gymnasium"),
    "Inverted pendulum": Outside("InvertedPendulum-v5", "mujoco"),
    "Inverted double pendulum": Outside("InvertedDoublePendulum-v5", "mujoco"),
    "Reacher": Outside("Reacher-v5", "mujoco"),
    "pcgym cstr": _pcgym("cstr"),
    "pcgym four_tank": _pcgym("four_tank"),
    "pcgym multistage_extraction": _pcgym("multistage_extraction"),
    "Cart-pole from hanging": _own("SwingUp", plants.CartPole, plants.cross_entropy),
    "Two stocks in a row": _own("TwoStocks", plants.TwoStocks, plants.base_stocks),
    "controlgym psm": _controlgym("psm"),
    "controlgym dis1": _controlgym("dis1"),
    "controlgym he1": _controlgym("he1"),
    "controlgym he1, log of short episodes": _controlgym("he1", "task.episode_steps=20"),
    "controlgym ac5": _controlgym("ac5"),
    "controlgym he2": _controlgym("he2"),
    "controlgym umv": _controlgym("umv"),
    "controlgym cm1": _controlgym("cm1"),
    "controlgym toy": _controlgym("toy"),
    "controlgym je2": _controlgym("je2"),
    "controlgym he4": _controlgym("he4"),
    "controlgym he3": _controlgym("he3"),
    "controlgym convection_diffusion_reaction": _controlgym("convection_diffusion_reaction"),
    "controlgym allen_cahn": _controlgym("allen_cahn")._replace(reference=None),
    "pcgym nonsmooth_control": _pcgym("nonsmooth_control"),
    "Battery in a building": Outside(
        _registered("Battery-v0", Battery, WEEK), BATTERY, battery_plans
    ),
}


def configuration(name: str, seed: int, *overrides: str) -> Any:
    plant = PLANTS[name]
    own = ("task=gymnasium", f"task.id={plant.id}", "start=data", f"seed={seed}")
    return run_code(compose_config(*own, "figures=false", *plant.overrides, *overrides))


def reference(plant: Outside) -> float:
    """Return J of the plant's reference; nan if it has none."""
    if plant.reference is not None:
        return plant.reference()
    name = plant.id.rpartition(":")[2]
    if (threshold := gymnasium.spec(name).reward_threshold) is None:
        return math.nan
    return -threshold


def run(name: str, seed: int) -> dict[str, Any]:
    cfg = configuration(name, seed)
    physics: Any = make_physics(cfg)
    began = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        torch.manual_seed(seed)
        start = make_start(cfg, physics, folder)
        assert start is not None
    seconds = time.process_time() - began
    plant, costs = physics.observed(start.observer), {"zero": _costs(cfg, physics)}
    costs["start"] = _costs(cfg, plant, warm_policy(make_mpc(cfg, plant, start)))
    excess = costs["start"] - costs["zero"]
    row = {"plant": name, "seed": seed, **{key: x.mean().item() for key, x in costs.items()}}
    row |= {"excess": excess.mean().item(), "error": (excess.std() / len(excess) ** 0.5).item()}
    summary = start.summary
    row |= {"chosen": summary["start"], "R2_cost": start.cost.R2 if start.cost else math.nan}
    row |= {"order": summary["order"], "reference": reference(PLANTS[name])}
    row |= {"transitions": cfg.start.transitions, "choosing": summary["start_transitions"]}
    return row | {"seconds": round(seconds, 1)}


def _costs(cfg: Config, physics: AnyPlant, policy: Any = None) -> torch.Tensor:
    """Return the costs of the episodes of an evaluation, by default with zero action."""
    return evaluate(cfg, policy or zero_action(physics), physics, EVAL_SEED).costs.sum(0)


def outcomes(rows: Any) -> str:
    """Format the rows: of each plant the median and the worst log, and how many are too dear."""
    lines, worse, count = [], 0, 0
    for name in PLANTS:
        runs = rows[rows["plant"] == name]
        if not len(runs):
            continue
        J = [float(runs[key].median()) for key in ("zero", "start")]
        J += [float(runs["start"].max()), float(runs["reference"].median())]
        cells = ["" if math.isnan(x) else cost_text(x) for x in J]
        worse += int((runs["excess"] > ERRORS * runs["error"]).sum())
        count += len(runs)
        of_x_N = f"{LINEAR}, "  # the names of the two linear ones begin alike
        names = (x.removeprefix(of_x_N).replace("MPC of the ", "") for x in runs["chosen"])
        names = (x.removesuffix(" MPC") for x in names)
        lines.append([name, *cells, "; ".join(dict.fromkeys(names))])
    head = ["plant", "zero action", "start, median", "worst", "reference", "chosen"]
    total = f"In {worse} of {count} runs the start cost more than zero action."
    return f"{table(head, lines)}\n\n{total}"


def cases(seeds: Iterable[int], parts: Iterable[str]) -> Iterator[tuple[str, int]]:
    """Yield plants whose names have one of ``parts`` and whose package is there, and seeds."""
    for seed in seeds:
        for name, plant in PLANTS.items():
            if not any(part in name for part in parts):
                continue
            if importlib.util.find_spec(plant.package):
                yield name, seed
            else:
                print(f"skipped: {name}, which needs {plant.package}")


def main(arguments: Iterable[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m tests.benchmarks.outside", description="Write the table of other plants."
    )
    parser.add_argument("--plants", nargs="+", default=[""], help="parts of the plants' names")
    options = options_of(parser, arguments, SEEDS, RESULTS, PAGE)
    torch.set_num_threads(1)
    warnings.filterwarnings("ignore", category=UserWarning)  # rows have what they say
    rows = keep(options.results, cases(options.seeds, options.plants), run, "plant", "nan")
    write_section(options.page, outcomes(rows), "starts")


if __name__ == "__main__":
    main()
