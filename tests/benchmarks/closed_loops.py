"""`improve` from one log: ``python -m tests.benchmarks.closed_loops``.

Gros and Zanon's system from 500 logged steps of random actions, also with bounds that `tighten` has
moved, controlgym's he2 from 2,000 (``pip install --no-deps controlgym``), and the engineer's heated
tank from 900, where the start is the controller that `Controller.learn` leaves. The model, its
noise and its filter are identified from the log; gradients through closed loops of the model move
theta, without a transition of the plant. J is that of the plant: on Gros and Zanon's system the
cost of a step, after 100 steps, in 32 loops that chose nothing; on he2 that of an episode; on the
tank that of a step, in 32 loops of 96. Finished rows are kept in docs/results/closed_loops.csv; the
table goes into docs/results/improvement.md.
"""

import argparse
import itertools
import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import torch

import torch_qpmpc as qm
from tests.benchmarks import outside
from tests.benchmarks.improvement import SHORT_EPISODES
from tests.benchmarks.table import DOCS, keep, options_of, table, write_section
from tests.runs import make_config
from torch_qpmpc.envs.closed_loop import closed_loop
from torch_qpmpc.experiment.algorithms import evaluate
from torch_qpmpc.experiment.start import collect_log
from torch_qpmpc.experiment.tasks import make_mpc, make_physics
from torch_qpmpc.experiment.tasks.identified import identified_start
from torch_qpmpc.learning.operators import warm_policy
from torch_qpmpc.mpc.tightening import prediction_covariance, tighten

PAGE, RESULTS = DOCS / "results" / "improvement.md", DOCS / "results" / "closed_loops.csv"
SEEDS = range(16, 36)
#: The temperature outside of the tank, in the mean.
T_OUT = 5.0
#: The weight of Gros and Zanon's cost, and the price of a violation.
WEIGHT, PRICE = torch.diag(torch.tensor([1.0, 1.0, 0.5]).double()), 50.0


class Case(NamedTuple):
    """J on the plant, how it is improved, and the number of transitions."""

    J: Callable[[], float]
    improve: Callable[..., Any]
    transitions: int


def gros_zanon(seed: int, tightened: bool = False) -> Case:
    """Return MPC with a model of 25 episodes of 20 random actions, and the known cost.

    With its soft bounds ``tightened`` by the model's noise, it does not learn them.
    """
    cfg = make_config(*SHORT_EPISODES, f"seed={seed}")
    plant: Any = make_physics(cfg)
    log = collect_log(cfg, plant)
    found = qm.identify(log, 10, order=0)
    mpc = qm.QPMPC.of(
        **found.arguments,
        hessian="block",
        stage_weight=WEIGHT,
        state_bounds=(plant.lb_s, plant.ub_s),
        state_slack=PRICE,
        discount_slack=True,
        action_bounds=(plant.lb_a, plant.ub_a),
        structure="tied",
        learn=("H", "H_f", "q", "b", *(() if tightened else ("lb", "ub"))),
        solver="daqp",
    )
    if tightened:
        A, S = (torch.tensor(x) for x in (found.model.A, found.model.S))
        tighten(mpc, prediction_covariance(A, S, 10))

    def J() -> float:
        policy = lambda s: mpc.policy(s).detach()  # noqa: E731
        return closed_loop(policy, plant, steps=400, seed=777).costs[100:].mean().item()

    options: Any = {"updates": 60, "steps": 400, "window": 40, "held_out": 128}
    return Case(J, partial(qm.improve, mpc, found, **options), log.numel())


def he2(seed: int) -> Case:
    """Return MPC of the estimate by a model of 20 episodes, with the cost fitted to the rewards."""
    id = outside.PLANTS["controlgym he2"].id
    own = ["start=data", "constraint=fixed", "task.learn_cost=[H,H_f]", "task.gamma=1.0"]
    own += ["task.terminal_weight=riccati", f"eval_seed={outside.EVAL_SEED}", f"seed={seed}"]
    cfg = make_config("task=gymnasium", f"task.id={id}", *own)
    physics = make_physics(cfg)
    log = collect_log(cfg, physics)
    start = identified_start(cfg, physics, log)
    plant = physics.observed(start.observer)
    mpc = make_mpc(cfg, plant, start)

    def J() -> float:
        return evaluate(cfg, warm_policy(mpc), plant).costs.sum(0).mean().item()

    found = qm.identify(log, 10, order=start.order)
    found = replace(found, model=found.fit.model)  # whose state the start's MPC has
    return Case(J, partial(qm.improve, mpc, found, updates=40), log.numel())


class Tank(gymnasium.Env):
    """The heated tank of the engineer's guide; T_out is its forecast for 25 steps."""

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict]:
        self.rng, self.T = np.random.default_rng(seed), np.array([18.0])
        self.out = T_OUT + 4 * np.sin(np.arange(1000) / 40 + self.rng.uniform(0, 6))
        return self.T, {"known": {"T_out": self.out[:25]}}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict]:
        noise = 0.05 * self.rng.normal()
        self.T = self.T + 0.1 * (self.out[0] - self.T) + 0.25 * action + noise
        self.out = self.out[1:]
        return self.T, 0.0, False, False, {"known": {"T_out": self.out[:25]}}


def tank(seed: int) -> Case:
    """Return the guide's controller of a third of its log, which has learned from all of it."""
    rng, env = np.random.default_rng(seed), Tank()
    q = rng.uniform(0, 12, 90).repeat(10)
    T, T_out = [env.reset(seed=seed)[0][0]], env.out[:900]
    for k in range(899):
        T.append(env.step(q[k])[0][0])
    signals = {"T": np.array(T), "q": q, "T_out": T_out}
    names: Any = {"outputs": ["T"], "inputs": ["q"], "known": ["T_out"]}
    log = qm.read_log(signals, **names)
    first = qm.read_log({name: x[:300] for name, x in signals.items()}, **names)
    mpc = qm.LinearMPC(
        qm.identify(first, 24),
        24,
        Q={"T": 1.0},
        dR={"q": 0.1},
        y_bounds={"T": (16.0, 24.0)},
        u_bounds={"q": (0.0, 12.0)},
        du_bounds={"q": (-3.0, 3.0)},
        learn=("H", "H_f", "lb", "ub"),
    )
    controller = qm.Controller(mpc)
    controller.reset(y={"T": 18.0}, u={"q": 5.2}, known={"T_out": T_OUT})
    controller.learn(log, steps=48)

    def J() -> float:
        costs = []
        for k in range(32):
            r = np.random.default_rng([777, k]).uniform(16, 24, 8).repeat(12)[:, None]
            run = controller.simulate(Tank(), 96, np.vstack((r, r[-1:])), seed=10_000 + k)
            costs.append(run.cost.mean())
        return float(np.mean(costs))

    options: Any = {"r": [20.0], "spread": 4.0, "updates": 40, "steps": 48, "loops": 16}
    return Case(J, partial(controller.improve, log, **options), log.steps)


CASES = {
    "Gros-Zanon": gros_zanon,
    "Gros-Zanon, tightened": partial(gros_zanon, tightened=True),
    "controlgym he2": he2,
    "Heated tank, after learn": tank,
}


def run(name: str, seed: int) -> dict[str, Any]:
    case = CASES[name](seed)
    before, began = case.J(), time.process_time()
    report = case.improve(seed=seed)
    seconds = time.process_time() - began
    J = {"before": before, "after": case.J(), "kept": report.kept}
    of_model = {"model before": report.before, "model after": report.after}
    ends = {"transitions": case.transitions, "seconds": round(seconds)}
    return {"case": name, "seed": seed} | J | of_model | ends


def main(arguments: Iterable[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.closed_loops")
    parser.add_argument("--cases", nargs="+", choices=CASES, default=[*CASES])
    options = options_of(parser, arguments, SEEDS, RESULTS, PAGE)
    torch.set_num_threads(1)
    rows = keep(options.results, itertools.product(options.cases, options.seeds), run)
    write_section(options.page, shown(rows), "closed-loops")


def shown(rows: Any) -> str:
    lines = []
    for name in CASES:
        own = rows[rows["case"] == name]
        if len(own):
            J = [own["before"].median(), own["after"].median(), own["after"].max()]
            kept = f"{int(own['kept'].sum())} of {len(own)}"
            ends = [kept, f"{own['transitions'].max():,}", f"{own['seconds'].median():.0f} s"]
            lines.append([name, *(f"{x:.4g}" for x in J), *ends])
    head = ["J, medians", "start", "improved", "worst", "kept", "transitions", "CPU"]
    return table(head, lines)


if __name__ == "__main__":
    main()
