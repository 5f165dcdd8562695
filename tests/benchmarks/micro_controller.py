"""Three steps ahead on a micro-controller: ``python -m tests.benchmarks.micro_controller``.

Three masses in a row are held at rest by two motors whose forces are limited, as are their moves in
a step; kicks are rare, and the positions of the outer masses should stay within soft bounds. Each
seed draws masses, springs and dampers. The state and the model are known, and every design that is
tuned or trained uses the simulator of the true plant:

- ``N = 40``: what sees as far as matters, and plans without kicks.
- ``N = 3``: the cost of x_N is the regulator's; also with a twentieth of the price of a bound, as
  three steps ahead most violations come too late to be avoided.
- ``regulator``: its gain, clipped to the limits.
- ``three moves``: N = 40 with blocks of 2, 6 and 32 steps.
- ``three weights``: N = 3 with the weights of positions and forces and the price of a bound that
  cost least, by Bayesian optimisation (Gaussian process, expected improvement).
- ``network``: two layers of 32 units that imitate N = 40 on its own loops.
- ``improve``: N = 3 with a twentieth of the price, moved by gradients through closed loops. It
  has the same number of simulated steps as the three weights.

J is the mean cost of a step in 64 new loops of 400 steps. ``--write`` puts the table into
docs/results/improvement.md; seeds 1 and 2 chose the settings.
"""

import argparse
import math
import subprocess
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy
import torch
from torch import Tensor, nn

import torch_qpmpc as qm
from tests.benchmarks.export import compiled
from tests.benchmarks.improvement import PAGE
from tests.benchmarks.table import publish, table
from torch_qpmpc.envs.closed_loop import closed_loop
from torch_qpmpc.envs.linear_system import LinearSystem, normal, uniform
from torch_qpmpc.export.library import required_compiler

#: Seconds of a step, the soft bounds, limits of forces and moves, and the price of a violation.
DT, BOUND, FORCE, MOVE, PRICE = 0.15, 0.35, 1.0, 0.2, 20.0
#: The price in three steps ahead before `improve`.
LOWER = PRICE / 20
#: Weights of three positions, three velocities, two forces and their moves.
WEIGHT = torch.tensor([1.0, 0, 1, 0, 0, 0, 0.05, 0.05, 0.1, 0.1]).double()
POSITIONS, FORCES = [0, 2], [6, 7]
#: Loops and steps of a trial of weights; trials, of which the first are random.
LOOPS, STEPS, TRIALS, RANDOM = 64, 100, 66, 16
UPDATES = 100
SEEDS = range(101, 121)


@dataclass(frozen=True, eq=False, kw_only=True)
class Masses(LinearSystem):
    """x has the positions, velocities and last forces, which saturate; the action is their move."""

    clips_states = False

    def step(self, s, a, nu):
        forces = s[..., FORCES]
        a = (forces + a.clamp(self.lb_a, self.ub_a)).clamp(-FORCE, FORCE) - forces
        return s @ self.A.mT + a @ self.B.mT + nu

    def starts(self, rng, count):
        return torch.zeros(count, 8).double()

    def draw(self, rng, count):
        return torch.cat((normal(rng, count, 3), uniform(rng, count, 3)), -1)

    def noise(self, nu, draw):
        w, kicked = draw[..., :3], draw[..., 3:] < 0.02
        w = 0.005 * w + w * kicked * torch.tensor([0.3, 0.9, 0.3]).double()
        rest = torch.zeros_like(w)
        return torch.cat((rest, w, rest[..., :2]), -1)

    def cost(self, s, a):
        beyond = (s[..., POSITIONS].abs() - BOUND).relu().sum(-1)
        return (WEIGHT * torch.cat((s, a), -1).square()).sum(-1) + PRICE * beyond


def masses(seed: int) -> Masses:
    rng = np.random.default_rng(seed)
    m, k, d = (
        rng.uniform(low, high, n) for low, high, n in ((0.7, 1.4, 3), (0.7, 1.4, 4), (0.05, 0.2, 3))
    )
    A, B = np.zeros((6, 6)), np.zeros((6, 2))
    A[:3, 3:] = np.eye(3)
    A[3:, :3] = (np.diag(k[1:3], 1) + np.diag(k[1:3], -1) - np.diag(k[:3] + k[1:])) / m[:, None]
    A[3:, 3:] = -np.diag(d / m)
    B[3, 0], B[5, 1] = 1 / m[0], 1 / m[2]
    A, B = np.split(scipy.linalg.expm(DT * np.block([[A, B], [np.zeros((2, 8))]]))[:6], [6], axis=1)
    B = torch.from_numpy(np.vstack((B, np.eye(2))))
    A = torch.cat((torch.from_numpy(np.vstack((A, np.zeros((2, 6))))), B), 1)
    free, move = torch.full((8,), torch.inf).double(), torch.full((2,), MOVE).double()
    return Masses(A=A, B=B, lb_s=-free, ub_s=free, lb_a=-move, ub_a=move)


def regulator(plant: Masses, weight: Tensor = WEIGHT) -> tuple[Tensor, Tensor]:
    """Return the regulator's cost P of x and its gain K, u = -K x."""
    A, B, Q = plant.A.numpy(), plant.B.numpy(), weight.diag().numpy()
    P = scipy.linalg.solve_discrete_are(A, B, Q[:8, :8], Q[8:, 8:])
    K = np.linalg.solve(Q[8:, 8:] + B.T @ P @ B, B.T @ P @ A)
    return torch.from_numpy(P), torch.from_numpy(K)


def mpc(
    plant: Masses, N: int, weight: Tensor = WEIGHT, price: float = PRICE, **own: Any
) -> qm.QPMPC:
    bound, slack = torch.full((8,), torch.inf).double(), torch.full((8,), price).double()
    bound[POSITIONS], bound[FORCES], slack[FORCES] = BOUND, FORCE, 1e3
    P, _ = regulator(plant, weight)
    return qm.QPMPC.from_model(
        plant.A,
        plant.B,
        N,
        hessian="block",
        stage_weight=2 * weight.diag(),
        terminal_weight=2 * P,
        state_bounds=(-bound, bound),
        state_slack=slack,
        action_bounds=(plant.lb_a, plant.ub_a),
        gamma=1.0,
        solver="daqp",
        **own,
    )


def J(policy: Callable[[Tensor], Tensor], plant: Masses, seed: int, steps: int = 400) -> float:
    with torch.no_grad():
        return closed_loop(policy, plant, steps=steps, starts=LOOPS, seed=seed).costs.mean().item()


def three_weights(plant: Masses, seed: int) -> qm.QPMPC:
    """Return N = 3 with the best of `TRIALS` weights between a hundredth and a hundred times."""
    rng = np.random.default_rng(seed)

    def made(z: np.ndarray) -> qm.QPMPC:
        positions, forces, price = np.exp(math.log(100) * z)
        factor = torch.ones(10).double()
        factor[POSITIONS], factor[FORCES] = positions, forces
        return mpc(plant, 3, WEIGHT * factor, PRICE * price)

    def cost(z: np.ndarray) -> float:
        return math.log(J(made(z).policy, plant, seed, STEPS))

    z = np.vstack((np.zeros(3), rng.uniform(-1, 1, (RANDOM - 1, 3))))
    found = np.array([cost(x) for x in z])
    while len(found) < TRIALS:
        near = z[found.argmin()] + 0.1 * rng.normal(size=(500, 3))
        tries = np.clip(np.vstack((rng.uniform(-1, 1, (1500, 3)), near)), -1, 1)
        chosen = tries[expected_gain(z, found, tries).argmax()]
        z, found = np.vstack((z, chosen)), np.append(found, cost(chosen))
    return made(z[found.argmin()])


def expected_gain(z: np.ndarray, values: np.ndarray, tries: np.ndarray) -> np.ndarray:
    """Return the expected improvement of a Gaussian process, its length the most likely of five."""
    y = (values - values.mean()) / values.std()
    best: Any = (-np.inf,)
    for length in (0.1, 0.2, 0.4, 0.8, 1.6):
        K = kernel(z, z, length) + 1e-4 * np.eye(len(z))
        factor = scipy.linalg.cho_factor(K)
        likelihood = -y @ scipy.linalg.cho_solve(factor, y) / 2 - np.log(np.diag(factor[0])).sum()
        best = max(best, (likelihood, length, factor), key=lambda x: x[0])
    _, length, factor = best
    k = kernel(tries, z, length)
    mean = k @ scipy.linalg.cho_solve(factor, y)
    deviation = np.sqrt(np.maximum(1 - (k * scipy.linalg.cho_solve(factor, k.T).T).sum(1), 1e-12))
    gain = y.min() - mean
    normal_ = scipy.stats.norm
    return gain * normal_.cdf(gain / deviation) + deviation * normal_.pdf(gain / deviation)


def kernel(x: np.ndarray, y: np.ndarray, length: float) -> np.ndarray:
    r = math.sqrt(5) * np.linalg.norm(x[:, None] - y, axis=-1) / length
    return (1 + r + r**2 / 3) * np.exp(-r)


def network(plant: Masses, seed: int) -> Callable[[Tensor], Tensor]:
    """Return a network that imitates N = 40 on 1,000 loops of its own, of 64 steps."""
    torch.manual_seed(seed)
    with torch.no_grad():
        loop = closed_loop(mpc(plant, 40).policy, plant, steps=64, starts=1000, seed=seed)
    s, u = loop.states[: len(loop.actions)].flatten(0, 1), loop.actions.flatten(0, 1)
    layers = nn.Linear(8, 32), nn.Tanh(), nn.Linear(32, 32), nn.Tanh(), nn.Linear(32, 2)
    net, size = nn.Sequential(*layers, nn.Hardtanh()).double(), s.std(0)
    optimizer = torch.optim.Adam(net.parameters(), 3e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, 4000)
    for _ in range(4000):
        at = torch.randint(len(s), (256,))
        loss = (net(s[at] / size) - u[at] / MOVE).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    return lambda s: MOVE * net(s / size)


def improved(plant: Masses, seed: int) -> qm.QPMPC:
    policy = mpc(plant, 3, price=LOWER, structure="tied", learn=("H", "H_f", "lb", "ub", "w"))
    qm.improve(policy, plant, updates=UPDATES, loops=32, steps=STEPS, held_out=128, seed=seed)
    return policy


DESIGNS: dict[str, Callable[[Masses, int], Any]] = {
    "N = 40": lambda plant, seed: mpc(plant, 40),
    "N = 40, three moves": lambda plant, seed: mpc(plant, 40, blocks=(2, 6, 32)),
    "regulator": lambda plant, seed: regulator(plant)[1],
    "network": network,
    "N = 3": lambda plant, seed: mpc(plant, 3),
    "N = 3, a lower price": lambda plant, seed: mpc(plant, 3, price=LOWER),
    "N = 3, three weights": three_weights,
    "N = 3, improve": improved,
}


def policy_of(design: Any) -> Callable[[Tensor], Tensor]:
    if isinstance(design, Tensor):
        return lambda s: (-s @ design.mT).clamp(-MOVE, MOVE)
    return design.policy if isinstance(design, qm.QPMPC) else design


def on_a_controller(design: Any, plant: Masses, seed: int) -> str:
    """Return kB of code and tables of the exported C, and the largest microseconds of a step."""
    if not isinstance(design, qm.QPMPC):
        return ""
    with torch.no_grad(), tempfile.TemporaryDirectory() as folder:
        try:
            run = compiled(design, Path(folder))
        except qm.QPError:
            return "refused"
        loop = closed_loop(design.policy, plant, steps=400, starts=16, seed=seed)
        p = loop.states[:-1].transpose(0, 1).reshape(-1, 8).numpy()
        slowest = np.min([run(p, False).steps for _ in range(5)], 0).max()
        source, target = Path(folder) / "policy.c", Path(folder) / "policy.o"
        subprocess.run(
            [*required_compiler(), "-Os", "-c", str(source), "-o", str(target)], check=True
        )
        sizes = subprocess.run(["size", str(target)], check=True, capture_output=True, text=True)
    text, data, *_ = map(int, sizes.stdout.splitlines()[1].split()[:3])
    return f"{(text + data) / 1e3:.0f}, {slowest:.0f}"


def measured(seeds: list[int], names: list[str]) -> tuple[dict[str, list[float]], dict[str, Any]]:
    """Return J of each design by seed, relative to that of N = 40, and the first seed's designs."""
    ratios: dict[str, list[float]] = {name: [] for name in names}
    first: dict[str, Any] = {}
    for seed in seeds:
        plant = masses(seed)
        designs = {name: DESIGNS[name](plant, seed) for name in names}
        costs = {name: J(policy_of(x), plant, 10_000 + seed) for name, x in designs.items()}
        first = first or designs
        for name, cost in costs.items():
            ratios[name].append(cost / costs["N = 40"])
        print(seed, *(f"{name}: {ratios[name][-1]:.3f}" for name in names), sep=", ", flush=True)
    return ratios, first


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.micro_controller")
    parser.add_argument("--seeds", type=int, nargs="+", default=[*SEEDS])
    parser.add_argument("--designs", nargs="+", choices=DESIGNS, default=[*DESIGNS])
    parser.add_argument("--write", action="store_true", help="write the table into the docs")
    options = parser.parse_args()
    torch.set_num_threads(1)
    (ratios, designs), rows, seed = measured(options.seeds, options.designs), [], options.seeds[0]
    del ratios["N = 40"]
    for name, own in ratios.items():
        numbers = f"{np.median(own):.3f}", f"{min(own):.3f} to {max(own):.3f}"
        rows.append([name, *numbers, on_a_controller(designs[name], masses(seed), seed)])
    head = ["J relative to N = 40", "median", "range", "kB, microseconds in C"]
    publish(table(head, rows), "micro-controller", options.write, PAGE)


if __name__ == "__main__":
    main()
