"""`improve` beside classical designs: ``python -m tests.benchmarks.rivals``.

Seven plants with a bounded input, hidden states and an asymmetric cost. On Dosing and Balance the
noise grows with state and action in a way that no design knows; the noise of the others is
constant. Sine is Balance with the sine of a real pole, Pipe has a dead time, Masses are two with a
spring, Tails is Dosing with heavy-tailed noise, and Deadband a drift that small inputs do not move.
Each design knows the log, the cost and the input's bounds, and nothing else of the plant:

- ``mean``: MPC with the identified model and filter.
- ``moved``: the same, aimed beyond the set-point by as much as pays for the closed loop's noise.
- ``Riccati``: the regulator for the mean and the noise that were identified, with noise that grows
  (de Koning, Automatica 1982), clipped to the bounds.
- ``two numbers``: ``mean`` with the set-point and the input's weight of least cost in simulated
  loops of the identified, noisy models.
- ``expanded``: ``mean`` with the regulator's cost, that of the output in noise to second order.
- ``improve``: q and the soft bound by gradients through the same loops, from ``mean``.
- ``improve, H``: the weights, too.

J is the mean cost of a step in 1,000 loops of the plant, drawn for each seed, four times as long as
those that train. Finished rows are kept in docs/results/rivals.csv; the table goes into
docs/results/improvement.md.
"""

import argparse
import math
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import scipy
import torch
from tensordict.nn import TensorDictModule
from torch import Tensor

import torch_qpmpc as qm
from tests.benchmarks.table import DOCS, options_of, table, write_section
from torch_qpmpc.envs.closed_loop import closed_loop
from torch_qpmpc.envs.linear_system import float64, normal, uniform
from torch_qpmpc.envs.plant import Plant
from torch_qpmpc.experiment.start import Exploration
from torch_qpmpc.experiment.tasks import plant_layout
from torch_qpmpc.identification.identification import Identified
from torch_qpmpc.learning.closed_loop import filtered, growth, simulated_plant
from torch_qpmpc.mpc.riccati import affine_cost_to_go, riccati_weight

PAGE, RESULTS = DOCS / "results" / "improvement.md", DOCS / "results" / "rivals.csv"
SIZES, SEEDS, EVALUATION = (2000,), range(3041, 3061), 50_000
#: Steps of a log's episodes, the horizon, loops that train and those of J; the number of these.
EPISODE, HORIZON, STEPS, LONG, LOOPS = 50, 10, 50, 200, 1000


class Price(NamedTuple):
    """L = weight (y - r)^2 + slope (y - r) + above (y - r)+^2 + price (r - y)+ + effort u^2."""

    r: float
    weight: float
    slope: float
    above: float
    price: float
    effort: float

    def __call__(self, y: Tensor, u: Tensor) -> Tensor:
        e = y[..., 0] - self.r
        own = self.weight * e.square() + self.slope * e + self.above * e.relu().square()
        return own + self.price * (-e).relu() + self.effort * u.square().sum(-1)


WASTE = Price(r=0.5, weight=0.05, slope=1.0, above=0.0, price=20.0, effort=0.05)
ONE_SIDED = Price(r=0.0, weight=1.0, slope=0.0, above=10.0, price=0.0, effort=0.1)


@dataclass(frozen=True, eq=False, kw_only=True)
class Priced(Plant):
    """x+ = A x + B u + noise; y is x_1 with the noise of its sensor, and x_1 costs `price`."""

    n_y: int = 1
    horizon: int = HORIZON
    price: Price
    A: Tensor
    B: Tensor

    def signals(self, rng, count, length):
        return normal(rng, count, length, 3)

    def cost(self, x, u, w):
        return self.price(x, u)


@dataclass(frozen=True, eq=False, kw_only=True)
class Dosing(Priced):
    """A reagent is dosed, x = [y, reagent]: too little of y is dear, too much is wasted."""

    lb_a: Tensor = field(default_factory=float64(0))
    ub_a: Tensor = field(default_factory=float64(2))
    price: Price = WASTE
    A: Tensor = field(default_factory=float64([0.9, 0.12], [0, 0.8]))
    B: Tensor = field(default_factory=float64([0], [0.2]))

    def starts(self, rng, count):
        return uniform(rng, count, 2) * 0.6

    def output(self, x, w):
        return x[..., :1] + 0.01 * w[..., 2:]

    def step(self, x, u, w):
        size = torch.cat((0.01 + 0.06 * x[..., :1].abs() ** 1.5, 0.02 + 0.2 * u.abs().sqrt()), -1)
        return x @ self.A.mT + u @ self.B.mT + size * w[..., :2]


@dataclass(frozen=True, eq=False, kw_only=True)
class Balance(Priced):
    """A pole with a weak motor, x = [y, velocity]: one side costs eleven times as much."""

    lb_a: Tensor = field(default_factory=float64(-1))
    ub_a: Tensor = field(default_factory=float64(1))
    price: Price = ONE_SIDED
    A: Tensor = field(default_factory=float64([1, 0.1], [0.02, 0.98]))
    B: Tensor = field(default_factory=float64([0], [0.1]))

    def starts(self, rng, count):
        return (uniform(rng, count, 2) - 0.5) * 0.4

    def output(self, x, w):
        return x[..., :1] + 0.005 * w[..., 2:]

    def step(self, x, u, w):
        size = 0.01 + 0.1 * x[..., 1:].abs() + 0.08 * (u.abs() > 0.5) * u.abs()
        noise = torch.cat((torch.zeros_like(size), size * w[..., 1:2]), -1)
        return x @ self.A.mT + u @ self.B.mT + noise


@dataclass(frozen=True, eq=False, kw_only=True)
class Pipe(Priced):
    """A reagent that arrives after three steps, x = [y, the last three inputs]; constant noise."""

    lb_a: Tensor = field(default_factory=float64(0))
    ub_a: Tensor = field(default_factory=float64(2))
    price: Price = WASTE
    A: Tensor = field(
        default_factory=float64([0.9, 0.1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1], [0, 0, 0, 0])
    )
    B: Tensor = field(default_factory=float64([0], [0], [0], [1]))

    def starts(self, rng, count):
        return torch.nn.functional.pad(uniform(rng, count, 1) * 0.6, (0, 3))

    def output(self, x, w):
        return x[..., :1] + 0.01 * w[..., 2:]

    def step(self, x, u, w):
        return x @ self.A.mT + u @ self.B.mT + 0.03 * w[..., :1] * torch.eye(1, 4).to(x)[0]


@dataclass(frozen=True, eq=False, kw_only=True)
class Sine(Balance):
    """Balance with gravity as the sine of y, and constant noise."""

    def step(self, x, u, w):
        y, v = x.tensor_split(2, -1)
        after = 0.98 * v + 0.04 * y.sin() + 0.1 * u + 0.02 * w[..., 1:2]
        return torch.cat((y + 0.1 * v, after), -1)


@dataclass(frozen=True, eq=False, kw_only=True)
class Masses(Balance):
    """Two masses with a spring, x = [positions, velocities]; u pushes one, y is the other."""

    A: Tensor = field(
        default_factory=float64(
            [1, 0, 0.1, 0], [0, 1, 0, 0.1], [-0.2, 0.2, 0.98, 0.02], [0.2, -0.2, 0.02, 0.98]
        )
    )
    B: Tensor = field(default_factory=float64([0], [0], [0], [0.1]))

    def starts(self, rng, count):
        return torch.nn.functional.pad((uniform(rng, count, 1) - 0.5) * 0.4, (0, 1)).repeat(1, 2)

    def step(self, x, u, w):
        return x @ self.A.mT + u @ self.B.mT + 0.01 * torch.nn.functional.pad(w[..., :2], (2, 0))


@dataclass(frozen=True, eq=False, kw_only=True)
class Tails(Dosing):
    """Dosing with constant noise of Student's t, of three degrees of freedom."""

    def signals(self, rng, count, length):
        w = normal(rng, count, length, 9)
        spread = (w[..., 3:].unflatten(-1, (2, 3)).square().mean(-1)).sqrt()
        return torch.cat((w[..., :2] / spread, w[..., 2:3]), -1)

    def step(self, x, u, w):
        noise = torch.cat((0.02 * w[..., :1], 0.05 * w[..., 1:2]), -1)
        return x @ self.A.mT + u @ self.B.mT + noise


@dataclass(frozen=True, eq=False, kw_only=True)
class Deadband(Balance):
    """A drifting position, x = [y, velocity], on which inputs below 0.15 do not act."""

    A: Tensor = field(default_factory=float64([1, 0.1], [0, 0.9]))

    def step(self, x, u, w):
        acting = u - u.clamp(-0.15, 0.15)
        noise = torch.nn.functional.pad(0.03 * w[..., 1:2], (1, 0))
        return x @ self.A.mT + acting @ self.B.mT + noise


PLANTS: dict[str, Priced] = {
    plant.__class__.__name__: plant
    for plant in (Dosing(), Balance(), Pipe(), Sine(), Masses(), Tails(), Deadband())
}


def collect(plant: Priced, transitions: int, seed: int) -> Any:
    """Return a log of random actions, in episodes of 50 steps."""
    env = plant.vectorised(transitions // EPISODE, EPISODE, seed=seed)
    explore = Exploration(plant.lb_a, plant.ub_a, 4, seed)
    log = env.rollout(EPISODE, TensorDictModule(explore, ["observation"], ["action"]))
    return log.contiguous()


def designed(
    plant: Priced,
    found: Identified,
    moved: float = 0.0,
    effort: float = 1.0,
    learn: tuple[str, ...] = ("q",),
) -> qm.QPMPC:
    """Return MPC of the estimate by an identified model, without discount.

    Its set-point is moved by so much, and the input's weight is ``effort`` times the plant's.
    """
    A, B, E, offset = map(torch.tensor, found.model[:4])
    seen, p = plant.observed(found.model), plant.price
    layout = plant_layout(seen, HORIZON)
    r, weight = p.r + moved, torch.zeros(layout.n).double()
    weight[0], weight[-1] = 2 * p.weight + p.above, 2 * effort * p.effort
    q, lower = torch.zeros_like(weight), torch.full((layout.n_x,), -math.inf).double()
    q[0] = p.slope - weight[0] * r
    soft: dict[str, Any] = {}
    if p.price:
        lower[0], learn = r, (*learn, "lb")
        soft = {"state_bounds": (lower, torch.full_like(lower, math.inf)), "state_slack": p.price}
    bounds = qm.Bounds(action_bounds=(plant.lb_a, plant.ub_a), discount_slack=True, **soft)
    q = q.repeat(HORIZON + 1)[: layout.n_z]
    W, aim = torch.diag(weight), torch.zeros_like(weight)
    aim[0] = -weight[0] * r  # the cost to go of the regulator about r
    last = riccati_weight(A, B, W, 1.0)
    end, _ = affine_cost_to_go(A, B, offset, W, aim, last, 1.0)
    q[-layout.n_x :] = end + p.slope * (torch.arange(layout.n_x) == 0)
    cost = qm.Cost(W, last, hessian="block", q=q)
    made = qm.Scheme(layout, qm.Model(A, B, E, offset), cost, bounds, 1.0)
    return qm.QPMPC(made, learn=learn, structure="tied", solver="daqp")


def simulated_cost(plant: Any, policy: Callable[[Tensor], Tensor], seed: int) -> float:
    """Return the mean cost of a step in 64 simulated loops."""
    rng, total = torch.Generator().manual_seed(seed), 0.0
    with torch.no_grad():
        s = plant.starts(rng, 64)
        for _ in range(STEPS):
            a = policy(plant.known(s))
            total += plant.cost(s, a).mean().item() / STEPS
            s = plant.step(s, a, plant.draw(rng, 64))
    return total


class Regulator(NamedTuple):
    """u = u_s - K (x - x_s), the output's standard deviation in its loops, and its `Price`."""

    K: np.ndarray
    x_s: np.ndarray
    u_s: float
    std: float
    price: Price

    def policy(self, plant: Priced) -> Callable[[Tensor], Tensor]:
        """Return the regulator, clipped to the bounds of the plant's input."""
        K, x_s = torch.tensor(self.K), torch.tensor(self.x_s)
        return lambda x: (self.u_s - (x - x_s) @ K.mT).clamp(plant.lb_a, plant.ub_a)


def regulator(plant: Priced, found: Identified) -> Regulator:
    """Return the regulator for innovations whose covariance grows with state and action.

    About the output m, the cost of an output with its standard deviation is quadratic: m minimises
    its mean, and the weight is the second derivative of the mean.
    """
    A, B, _, offset, C, L, S, *_ = found.model
    n, node, mass = len(A), *np.polynomial.hermite_e.hermegauss(80)
    c = _growth(found)
    left = np.block([[A - np.eye(n), B], [C, np.zeros((1, 1))]])

    def steady(m: float) -> np.ndarray:
        return np.linalg.lstsq(left, np.append(-offset, m), rcond=None)[0]

    def mean(m: float, u: float, std: float) -> float:
        costs = plant.price(torch.tensor(m + std * node)[:, None], torch.full((80, 1), u))
        return float(costs.numpy() @ mass / mass.sum())

    std, r = float(S[0, 0]) ** 0.5, plant.price.r
    m = h = w = math.nan
    for _ in range(30):
        around = (r - 6 * std, r + 6 * std)
        m = scipy.optimize.minimize_scalar(
            lambda m, std=std: mean(m, float(steady(m)[-1]), std), bounds=around, method="bounded"
        ).x
        v_s, h = steady(m), std / 2
        w = mean(m + h, 0.0, std) - 2 * mean(m, 0.0, std) + mean(m - h, 0.0, std)
        Q, R = w / h**2 * C.T @ C, 2 * plant.price.effort
        P = Q
        for _ in range(2000):
            M = S[0, 0] * (L.T @ P @ L)[0, 0] * c[1:]
            G = R + (B.T @ P @ B)[0, 0] + M[-1]
            K, last = B.T @ P @ A / G, P
            P = Q + A.T @ P @ A + np.diag(M[:-1]) - G * K.T @ K
            if abs(P - last).max() <= 1e-10 * abs(P).max():
                break
        X, closed = np.zeros((n, n)), A - B @ K
        for _ in range(2000):
            size = c[0] + c[1:] @ (v_s**2 + np.append(np.diag(X), K @ X @ K.T))
            X, last = closed @ X @ closed.T + S[0, 0] * size * L @ L.T, X
            if abs(X - last).max() <= 1e-10 * abs(X).max():
                break
        grown = (C @ X @ C.T).item() ** 0.5
        if not grown < 1e3 * S[0, 0] ** 0.5:  # no gain holds such noise in the mean square
            break
        std = grown
    slope = (mean(m + h, 0.0, std) - mean(m - h, 0.0, std)) / (2 * h)
    price = Price(m - slope * h**2 / w, w / h**2 / 2, 0.0, 0.0, 0.0, plant.price.effort)
    return Regulator(K, v_s[:-1], float(v_s[-1]), std, price)


def _growth(found: Identified) -> np.ndarray:
    """Return how the innovations' variance grows with the squares of state and action."""
    log = found.log.trajectories
    x, e = filtered(found.model, log)
    x[:, len(found.fit.model.A) :] = 0.0  # slow disturbances
    return growth(e, np.hstack((x, np.concatenate([one.u for one in log]))))[0]


def tuned(plant: Priced, found: Identified, simulated: Any, std: float, seed: int) -> qm.QPMPC:
    """Return MPC with the set-point and the input's weight of least cost in simulated loops."""

    def cost(z: Iterable[float]) -> float:
        moved, effort = z
        return simulated_cost(
            simulated, designed(plant, found, std * moved, 10**effort).policy, seed
        )

    z = min(product((-2, -1, 0, 1, 2), (0, 1, 2)), key=cost)
    best = scipy.optimize.minimize(cost, z, method="Nelder-Mead", options={"maxfev": 15}).x
    return designed(plant, found, std * best[0], 10 ** best[1])


DESIGNS = ("mean", "Riccati", "moved", "expanded", "two numbers")
DESIGNS += ("improve", "improve, H")
#: What the designs by gradients learn, besides soft bounds.
LEARNED = {"improve": ("q",), "improve, H": ("q", "H", "H_f")}
#: The rows of what they keep.
KEPT = {"kept, dearer, most": "improve", "the same, H": "improve, H"}
IMPROVE: Any = {"updates": 60, "steps": STEPS}


def run(name: str, size: int, seed: int) -> Iterator[dict[str, Any]]:
    plant = PLANTS[name]
    found = qm.identify(collect(plant, size, seed), HORIZON)
    known = regulator(plant, found)

    def price(p: Tensor, u: Tensor) -> Tensor:
        return plant.price(p, u)

    for design in DESIGNS:
        mpc, model, kept = designed(plant, found), found.model, None
        policy, began = mpc.policy, time.process_time()
        if design == "Riccati":
            policy = known.policy(plant)
        elif design == "moved":
            moved = float((model.C @ known.x_s)[0]) - plant.price.r
            policy = designed(plant, found, moved).policy
        elif design == "expanded":
            policy = designed(replace(plant, price=known.price), found).policy
        elif design == "two numbers":
            models = simulated_plant(found, price, HORIZON, seed=seed)
            policy = tuned(plant, found, models, known.std, seed).policy
        elif design in LEARNED:
            mpc = designed(plant, found, learn=LEARNED[design])
            policy, options = mpc.policy, IMPROVE | {"seed": seed}
            kept = qm.improve(mpc, found, cost=price, **options).kept
        seconds, seen = round(time.process_time() - began, 1), plant.observed(model)
        loop = closed_loop(policy, seen, steps=LONG, starts=LOOPS, seed=EVALUATION + seed)
        names = {"plant": name, "transitions": size, "seed": seed, "design": design}
        yield names | {"J": loop.costs.mean().item(), "seconds": seconds, "kept": kept}


def shown(rows: Any) -> str:
    """Format the median and the worst J of each design, and how `improve` compares with it.

    The last rows have what `improve` kept, and the largest change of J by it.
    """
    marks, cells, plants = compared(rows), {}, []
    for (plant, size), own in rows.groupby(["plant", "transitions"], sort=False):
        for design, J in own.groupby("design")["J"]:
            mark = marks.get((plant, design, size), "")
            cells[plant, size, design] = f"{J.median():.3g}/{J.max():.3g}{mark}"
        plants.append((plant, size))
        for name, design in KEPT.items():
            if {design, "mean"} <= {*own["design"]}:
                cells[plant, size, name] = accepts(own, size, design)
    names = [x for x in (*rows["design"].unique(), *KEPT) if any(x in key for key in cells)]
    lines = [[x, *(cells.get((*key, x), "") for key in plants)] for x in names]
    return table(["", *(f"{plant}, {size:,}" for plant, size in plants)], lines)


def accepts(rows: Any, size: int, design: str) -> str:
    """Format how many theta were kept, how many of them cost more, and the largest change of J."""
    own = rows[rows["transitions"] == size].pivot(index="seed", columns="design")
    kept = own["kept"][design].fillna(value=False).astype(bool)
    if not kept.any():
        return "0"
    change = (own["J"][design] / own["J"]["mean"] - 1)[kept]
    return f"{kept.sum()}/{(change > 0).sum()}/{change.max():+.1%}"


def compared(rows: Any) -> dict[Any, str]:
    """Return on how many seeds `improve` costs less, with * where p < 0.05 by Holm's procedure."""
    J = rows.pivot_table("J", ["plant", "transitions", "seed"], "design")
    better, p = {}, {}
    if "improve" not in J:
        return {}
    for (plant, size), own in J.groupby(["plant", "transitions"]):
        for design in own.columns.drop("improve"):
            if own[design].notna().all():
                key = plant, design, size
                better[key] = int((own["improve"] < own[design]).sum())
                p[key] = float(scipy.stats.wilcoxon(own["improve"], own[design]).pvalue)
    marks, rejects = {}, True
    for i, key in enumerate(sorted(p, key=lambda key: p[key])):
        rejects = rejects and p[key] * (len(p) - i) < 0.05
        marks[key] = f"/{better[key]}" + "*" * rejects
    return marks


def main(arguments: Iterable[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.rivals")
    parser.add_argument("--plants", nargs="+", choices=PLANTS, default=[*PLANTS])
    parser.add_argument("--sizes", type=int, nargs="+", default=SIZES)
    options = options_of(parser, arguments, SEEDS, RESULTS, PAGE)
    torch.set_num_threads(1)
    rows: Any = pd.read_csv(options.results) if options.results.exists() else pd.DataFrame()
    for seed, plant, size in product(options.seeds, options.plants, options.sizes):
        key = [plant, size, seed]
        if not len(rows) or not (rows[["plant", "transitions", "seed"]] == key).all(axis=1).any():
            rows = pd.concat([rows, pd.DataFrame([*run(plant, size, seed)])])
            rows.to_csv(options.results, index=False, float_format="%.6g")
            print(rows.tail(len(DESIGNS)).to_string(header=False, index=False), flush=True)
    write_section(options.page, shown(rows), "rivals")


if __name__ == "__main__":
    main()
