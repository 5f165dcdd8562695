"""Nonlinear MPC of a log beside its rivals: ``python -m tests.benchmarks.nonlinear``.

J is minus the episode's reward, the mean of the episodes of `tests.benchmarks.outside`, and a
decision's time that of one state. The rivals are

- the cross-entropy method (CEM) on the same learned model and cost, with as many simulated steps as
  nonlinear MPC, of which each of a step's derivatives counts as one, and with ten times as many,
- CEM and CasADi's NMPC, by IPOPT from its last plan, with the true model, `AHEAD` steps ahead,
- TorchRL's TD3 and SAC with networks, an update every other transition.

Plants of known optimum have a discounted J, in the same episodes as the optimum's. The share of the
gap is (J - J*) / (J_0 - J*), where J_0 is that of zero action.

Finished rows are kept in docs/results/nonlinear.csv; tables go into docs/results/outside.md.
"""

import argparse
import itertools
import tempfile
import time
import warnings
from collections.abc import Callable, Iterable
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import pandas as pd
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl import modules
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import SACLoss, SoftUpdate, TD3Loss

from tests.benchmarks import outside
from tests.benchmarks.plants import CONVERSE, Converse, pendulum, swing
from tests.benchmarks.table import DOCS, options_of, significant, table, write_section
from torch_qpmpc.envs.gymnasium_plant import GymnasiumPlant
from torch_qpmpc.experiment.algorithms import evaluate
from torch_qpmpc.experiment.choosing import NONLINEAR, candidates
from torch_qpmpc.experiment.evaluation import cost_text
from torch_qpmpc.experiment.rivals import zero_action
from torch_qpmpc.experiment.start import collect_log, make_start
from torch_qpmpc.experiment.tasks import make_mpc, make_physics
from torch_qpmpc.learning.operators import warm_policy

RESULTS, HERE = DOCS / "results" / "nonlinear.csv", "tests.benchmarks.nonlinear"
SEEDS = (501, 502, 503)
FIELDS = ("plant", "design", "seed", "J", "seconds", "transitions", "steps", "chosen")
OURS, START, OPTIMUM, ZERO = "MPC of a log", "`start=data`", "optimum", "zero action"
CEM_SAME, CEM_MANY = "CEM, same model", "CEM, ten times as many"
CEM_TRUE, NMPC, AGENTS = "CEM, true model", "NMPC, true model", ("TD3", "SAC")
FINAL = (OPTIMUM, ZERO, START)
#: CEM's iterations: with few plans, with ten times as many, and with the true model; its plans.
FEW, MORE, MANY = 3, 5, (5, 100)
#: NMPC's steps ahead, its first plans, and for how many steps they hold an action.
AHEAD, FIRST, HOLD = 40, 8, 5
#: TorchRL: environments side by side, random transitions, the batch and the rate.
ENVS, RANDOM, BATCH, RATE = 8, 1000, 256, 1e-3


class Plant(NamedTuple):
    """A plant: its name in `outside`, its function, and the state of an observation."""

    name: str
    function: Callable[..., tuple[tuple[Any, ...], Any]]
    state: Callable[[Any], tuple[Any, ...]]


PLANTS = {
    "Pendulum": Plant("Pendulum", pendulum, lambda y: (np.arctan2(y[1], y[0]), y[2])),
    "Cart-pole": Plant(
        "Cart-pole from hanging", swing, lambda y: (y[0], y[1], np.arctan2(y[3], y[2]), y[4])
    ),
}
for name, known in CONVERSE.items():
    id = f"Converse{name.partition('-')[0]}-v0"
    if id not in gymnasium.registry:  # this module is __main__, too
        make: Any = partial(Converse, name)
        gymnasium.register(id, make, max_episode_steps=known.steps)
    more = (f"task.gamma={known.gamma}", "task.episode_steps=5")
    outside.PLANTS[name] = outside.Outside(f"{HERE}:{id}", "gymnasium", None, more)


class CrossEntropy:
    """The policy of the cross-entropy method for ``cost(p, plans)`` ``(B, K)``."""

    def __init__(self, cost: Any, physics: Any, N: int, sizes: tuple[int, int], seed: int) -> None:
        self.cost, self.sizes = cost, sizes
        self.low, self.high = physics.lb_a, physics.ub_a
        self.rng = torch.Generator().manual_seed(seed)
        self.mean = ((self.low + self.high) / 2).expand(1, N, -1)

    def __call__(self, p: Tensor) -> Tensor:
        iterations, count = self.sizes
        half, best = (self.high - self.low) / 2, torch.zeros(0)
        mean = self.mean.expand(len(p), -1, -1)
        width = 0.6 * half.expand_as(mean)
        for _ in range(iterations):
            shape = len(p), count, *mean.shape[1:]
            noise = torch.randn(shape, generator=self.rng, dtype=torch.float64)
            noise[:, 0] = 0.0
            plans = (mean[:, None] + width[:, None] * noise).clamp(self.low, self.high)
            costs = self.cost(p, plans).nan_to_num(torch.inf)
            top = costs.topk(max(2, count // 10), 1, largest=False).indices
            best = plans[torch.arange(len(p))[:, None], top]
            mean, width = best.mean(1), best.std(1) + 0.005 * half
        self.mean = torch.cat((mean[:, 1:], mean[:, -1:]), 1)
        return best[:, 0, 0]


def on_plant(plant: Plant, p: Tensor, plans: Tensor) -> Tensor:
    s, u, J = tuple(x[:, None] for x in plant.state(p.numpy().T)), plans.numpy()[..., 0], 0.0
    for k in range(u.shape[-1]):
        s, cost = plant.function(s, u[..., k])
        J = J + cost
    return torch.as_tensor(J)


def on_model(mpc: Any, p: Tensor, plans: Tensor) -> Tensor:
    with torch.no_grad():
        return mpc.sequential.simulated(p[:, None], plans)[1]


class Ipopt:
    """NMPC with the true plant: each episode keeps its plan, and the first is the best of some."""

    def __init__(self, plant: Plant, physics: Any) -> None:
        ca, self.plant, self.plans = import_module("casadi"), plant, {}
        n, rows, w, J = len(plant.state(physics.lb_s.numpy())), [], [], 0.0
        first, u = ca.SX.sym("s", n), ca.SX.sym("u", AHEAD)
        s = ca.vertsplit(first)
        for k in range(AHEAD):
            after, cost = plant.function(s, u[k])
            x = ca.SX.sym(f"x{k}", n)
            rows, w, J, s = (
                [*rows, ca.vertcat(*after) - x],
                [*w, u[k], x],
                J + cost,
                ca.vertsplit(x),
            )
        nlp = {"x": ca.vertcat(*w), "f": J, "g": ca.vertcat(*rows), "p": first}
        quiet = {"ipopt.print_level": 0, "print_time": 0, "ipopt.sb": "yes", "ipopt.max_iter": 200}
        self.solver = ca.nlpsol("nmpc", "ipopt", nlp, quiet)
        self.low, self.high = physics.lb_a.item(), physics.ub_a.item()
        free = np.full((AHEAD, n), np.inf)
        ends = ((self.low, -free), (self.high, free))
        sides = [np.insert(x, 0, b, 1).ravel() for b, x in ends]
        self.bounds = {"lbx": sides[0], "ubx": sides[1], "lbg": 0.0, "ubg": 0.0}
        self.rng = np.random.default_rng(0)

    def solved(self, s: tuple[Any, ...], u: np.ndarray) -> tuple[float, np.ndarray]:
        w, at = [], s
        for a in u:
            at, _ = self.plant.function(at, a)
            w += [a, *at]
        out = self.solver(x0=w, p=[*s], **self.bounds)
        J = float(out["f"]) if self.solver.stats()["success"] else np.inf
        return J, np.asarray(out["x"]).reshape(AHEAD, -1)[:, 0]

    def __call__(self, p: Tensor) -> Tensor:
        actions = []
        for i, y in enumerate(p.numpy()):
            s = tuple(map(float, self.plant.state(y)))
            if (plan := self.plans.get(i)) is None:
                held = self.rng.uniform(self.low, self.high, (FIRST, AHEAD // HOLD))
                held = held.repeat(HOLD, 1)
                plan = min((self.solved(s, u) for u in held), key=lambda x: x[0])[1]
            else:
                plan = self.solved(s, np.append(plan[1:], plan[-1]))[1]
            self.plans[i] = plan
            actions.append(np.clip(plan[:1], self.low, self.high))
        return torch.as_tensor(np.array(actions))


def agent(name: str, id: str, seed: int, count: int) -> Callable[[Tensor], Tensor]:
    """Return the policy of TD3 or SAC after a number of transitions."""
    torch.manual_seed(seed)
    plant = GymnasiumPlant(id)
    env = plant.vectorised(ENVS, None, seed=seed)
    n, m, low, high = plant.n_x, len(plant.lb_a), plant.lb_a.float(), plant.ub_a.float()
    sizes: Any = {"num_cells": [128, 128], "activation_class": nn.ReLU}
    critic = modules.ValueOperator(modules.MLP(n + m, 1, **sizes), ["observation", "action"])
    actor: Any
    bounds: Any = (low, high)
    if name == "TD3":
        net: Any = TensorDictModule(modules.MLP(n, m, **sizes), ["observation"], ["param"])
        squashed: Any = modules.TanhModule(["param"], ["action"], low=low, high=high)
        actor = TensorDictSequential(net, squashed)
        loss: Any = TD3Loss(actor, critic, bounds=bounds)
        noise: Any = modules.AdditiveGaussianModule(env.action_spec, sigma_init=0.1, sigma_end=0.1)
        explore: Any = TensorDictSequential(actor, noise)
    else:
        head = nn.Sequential(modules.MLP(n, 2 * m, **sizes), modules.NormalParamExtractor())
        actor = explore = modules.ProbabilisticActor(
            TensorDictModule(head, ["observation"], ["loc", "scale"]),
            in_keys=["loc", "scale"],
            distribution_class=modules.TanhNormal,
            distribution_kwargs={"low": low, "high": high},
            return_log_prob=True,
        )
        loss = SACLoss(actor, critic, action_spec=env.action_spec)
    loss.make_value_estimator(gamma=0.98)
    target, optimizer = SoftUpdate(loss, tau=0.005), torch.optim.Adam(loss.parameters(), RATE)
    frames: Any = {"frames_per_batch": ENVS, "total_frames": count}
    collector = Collector(env, explore, init_random_frames=RANDOM, **frames)
    replay = ReplayBuffer(storage=LazyTensorStorage(count), batch_size=BATCH)
    for k, batch in enumerate(collector, 1):
        replay.extend(batch.reshape(-1))
        for i in range(ENVS // 2 * (k * ENVS > RANDOM)):
            losses, late = loss(replay.sample()), {"loss_actor"} if name == "TD3" and i % 2 else ()
            optimizer.zero_grad()
            own = (losses[x] for x in {*losses.keys()} - {*late} if x.startswith("loss_"))
            total: Any = sum(own)
            total.backward()
            optimizer.step()
            target.step()
    collector.shutdown()

    def policy(s: Tensor) -> Tensor:
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            return actor(TensorDict({"observation": s.float()}, [len(s)]))["action"].double()

    return policy


class Rows(NamedTuple):
    """The rows of a plant and a seed, which the file gets one by one."""

    path: Path
    plant: str
    seed: int
    cfg: Any
    physics: Any

    def add(self, design: str, transitions: int, make: Any, physics: Any, **more: Any) -> None:
        """Evaluate the policies that ``make`` returns, in all episodes and in one alone."""
        if self.has(design, transitions):
            return
        loop = evaluate(self.cfg, make(), physics, outside.EVAL_SEED)
        policy, seconds = make(), []

        def timed(p: Tensor) -> Tensor:
            began = time.process_time()
            action = policy(p)
            seconds.append(time.process_time() - began)
            return action

        evaluate(self.cfg, timed, physics, outside.EVAL_SEED, starts=1)
        J = loop.discounted(self.cfg.task.gamma) if self.plant in CONVERSE else loop.J
        row = {"plant": self.plant, "design": design, "seed": self.seed, "J": f"{J:.6g}"}
        row |= {"seconds": f"{np.median(seconds):.3g}", "transitions": transitions} | more
        frame = pd.DataFrame([row], columns=pd.Index(FIELDS))
        frame.to_csv(self.path, mode="a", header=not self.path.exists(), index=False)
        print(*row.values(), flush=True)

    def has(self, design: str, transitions: int | None = None) -> bool:
        rows: Any = pd.read_csv(self.path) if self.path.exists() else pd.DataFrame(columns=FIELDS)
        own = (rows["plant"] == self.plant) & (rows["seed"] == self.seed)
        own &= rows["design"] == design
        return transitions in (None, *rows["transitions"][own]) and bool(own.any())


def from_log(rows: Rows) -> None:
    torch.manual_seed(rows.seed)
    log = collect_log(rows.cfg, rows.physics)
    start = candidates(rows.cfg, rows.physics, log)[NONLINEAR]
    plant: Any = rows.physics.observed(start.observer)
    transitions = rows.cfg.start.transitions
    mpc: Any = make_mpc(rows.cfg, plant, start)
    model, count = mpc.sequential, []
    hook = model.dynamics.register_forward_pre_hook(lambda _, x: count.append(x[0].shape[:-1]))
    with torch.no_grad():
        mpc.policy(torch.zeros(1, plant.n_x, dtype=torch.float64))
    hook.remove()
    N = start.horizon
    steps = sum(shape.numel() for shape in count) + N * sum(model.sizes) * model.iterations
    rows.add(OURS, transitions, lambda: warm_policy(mpc), plant, steps=steps)
    plans = -(-steps // (FEW * N))
    for design, sizes in ((CEM_SAME, (FEW, plans)), (CEM_MANY, (MORE, 10 * FEW * plans // MORE))):
        if design == CEM_SAME or rows.seed == SEEDS[0]:
            make = partial(CrossEntropy, partial(on_model, mpc), plant, N, sizes, rows.seed)
            rows.add(design, transitions, make, plant, steps=sizes[0] * sizes[1] * N)


def true_model(rows: Rows) -> None:
    plant = PLANTS[rows.plant]
    make = partial(CrossEntropy, partial(on_plant, plant), rows.physics, AHEAD, MANY, rows.seed)
    rows.add(CEM_TRUE, 0, make, rows.physics, steps=MANY[0] * MANY[1] * AHEAD)
    rows.add(NMPC, 0, partial(Ipopt, plant, rows.physics), rows.physics)


def optimum(rows: Rows) -> None:
    known = CONVERSE[rows.plant]

    def policy(p: Tensor) -> Tensor:
        return torch.as_tensor(np.array([known.optimum(x) for x in p.numpy()]))

    rows.add(OPTIMUM, 0, lambda: policy, rows.physics)
    rows.add(ZERO, 0, lambda: zero_action(rows.physics), rows.physics)
    if not rows.has(START):
        with tempfile.TemporaryDirectory() as folder:
            torch.manual_seed(rows.seed)
            start: Any = make_start(rows.cfg, rows.physics, folder)
        plant, summary = rows.physics.observed(start.observer), start.summary
        transitions = rows.cfg.start.transitions + summary["start_transitions"]
        mpc = make_mpc(rows.cfg, plant, start)
        rows.add(START, transitions, lambda: warm_policy(mpc), plant, chosen=summary["start"])


def rivals(rows: Any) -> str:
    """Format the rows beside rivals: J of each seed, and the time of a decision."""
    lines, own = [], rows[rows["plant"].isin(PLANTS)]
    counts = own["transitions"].where(own["design"].isin(AGENTS), 0)
    for (design, _), same in own.groupby(["design", counts], sort=False):
        cells = []
        for plant in PLANTS:
            runs: Any = same[same["plant"] == plant]
            J = "/".join(cost_text(float(x)) for x in runs["J"])
            cells += [J, significant(1e3 * float(runs["seconds"].median())) if J else ""]
        count = same["transitions"].median()
        lines.append([str(design), *cells, f"{count:,.0f}" if count else ""])
    head = [cell for plant in PLANTS for cell in (plant, "ms")]
    return table(["J", *head, "transitions"], lines)


def gaps(rows: Any) -> str:
    """Format the rows of plants of known optimum."""
    lines = []
    for plant in CONVERSE:
        runs = {name: rows[(rows["plant"] == plant) & (rows["design"] == name)] for name in FINAL}
        best, zero, own = (runs[name]["J"] for name in FINAL)
        if len(own):
            share = (own.median() - best.mean()) / (zero.mean() - best.mean())
            cells = [cost_text(float(x)) for x in (best.mean(), zero.mean())]
            each = "/".join(cost_text(float(x)) for x in own)
            chosen = "/".join(x.removesuffix(" MPC") for x in runs[START]["chosen"])
            lines.append([plant, *cells, each, f"{share:.2g}", chosen])
    return table(["J", "optimum", "zero action", "start", "share", "chosen"], lines)


def main(arguments: Iterable[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m tests.benchmarks.nonlinear", description="Write the tables of rivals."
    )
    parser.add_argument("--plants", nargs="*", default=[*PLANTS, *CONVERSE])
    parser.add_argument("--count", type=int, default=20_000, help="transitions of TD3 and SAC")
    options = options_of(parser, arguments, SEEDS, RESULTS, outside.PAGE)
    torch.set_num_threads(1)
    warnings.filterwarnings("ignore")  # rows have what they say
    for seed, plant in itertools.product(options.seeds, options.plants):
        name = plant if plant in CONVERSE else PLANTS[plant].name
        cfg = outside.configuration(name, seed)
        rows = Rows(options.results, plant, seed, cfg, make_physics(cfg))
        if plant in CONVERSE:
            optimum(rows)
            continue
        if not rows.has(OURS):
            from_log(rows)
        if seed == SEEDS[0]:
            true_model(rows)
        for kind in AGENTS:
            if not rows.has(kind, options.count):
                policy = agent(kind, outside.PLANTS[name].id, seed, options.count)
                rows.add(kind, options.count, lambda policy=policy: policy, rows.physics)
    rows = pd.read_csv(options.results)
    write_section(options.page, rivals(rows), "rivals")
    write_section(options.page, gaps(rows), "gaps")


if __name__ == "__main__":
    main()
