"""Controllers by the engineer's guide, of plants that do not start at rest.

    python -m tests.benchmarks.guide --seeds 6 7 8 9 10 --write

A log of 4,000 random actions, `identify`, and `Controller` with its defaults and the plant's own
weights. Beside it are the start of the Gymnasium route, two logs of 2,000 actions, and two
references that know the plant: one with these weights, and one with the plant's own cost, of which
umv's has a product of an output and an input. All are the mean of the 32 episodes of
`tests.benchmarks.outside`.
"""

import argparse
from typing import Any

import gymnasium
import numpy as np
import pandas as pd
import scipy.linalg
import torch
from gymnasium.spaces import Box

import torch_qpmpc as qm
from tests.benchmarks import outside
from tests.benchmarks.table import publish, significant, table

HERE = "tests.benchmarks.guide"
HORIZON, ACTIONS, EPISODES, DELAY = 20, 4_000, 32, 5
DELAYED = "delay of five steps"
HEAD = ["J of each log", "by the guide", "reference with its weights", "`start=data`", "reference"]
#: The outputs' and inputs' weights of each plant.
WEIGHTS: dict[str, dict[str, Any]] = {
    "controlgym umv": {"Q": {"y2": 1.0}, "R": {"u1": 1.0}},
    "controlgym cm1": {"Q": {"y1": 1.0, "y2": 1.0}, "R": {"u1": 1.5}},
    DELAYED: {"Q": {"y1": 1.0}, "R": {"u1": 0.1}},
}


class Delay(gymnasium.Env):
    """x+ = 0.9 x + 0.5 u_{k-5} + w with |u| <= 1, w of 0.1, and x_0 in [-2, 2]."""

    observation_space = Box(-np.inf, np.inf, (1,), np.float64)
    action_space = Box(-1.0, 1.0, (1,), np.float64)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.x, self.queue = self.np_random.uniform(-2, 2), [0.0] * DELAY
        return np.array([self.x]), {}

    def step(self, action: Any) -> Any:
        u = float(action[0])
        cost = self.x**2 + 0.1 * u**2
        self.queue.append(u)
        self.x = 0.9 * self.x + 0.5 * self.queue.pop(0) + 0.1 * self.np_random.normal()
        return np.array([self.x]), -cost, False, False, {}


gymnasium.register("Delay-v0", entry_point=f"{HERE}:Delay", max_episode_steps=60)


def J(env: Any, make: Any) -> float:
    """Return the mean cost of the episodes of a policy that ``make`` returns for each."""
    costs = []
    for i in range(EPISODES):
        (y, _), over, cost, policy = env.reset(seed=outside.EVAL_SEED + i), False, 0.0, make(env)
        while not over:
            y, reward, terminated, truncated, _ = env.step(policy(y))
            cost, over = cost - float(reward), terminated or truncated
        costs.append(cost)
    return float(np.mean(costs))


def regulator(env: Any) -> Any:
    """Return the LQR of the known plant with the inputs on their way, clipped."""
    A, B = np.diag(np.ones(DELAY), 1), np.eye(DELAY + 1)[:, -1:]
    A[0, :2], Q, R = (0.9, 0.5), np.zeros((DELAY + 1, DELAY + 1)), np.array([[0.1]])
    Q[0, 0] = 1.0
    P = scipy.linalg.solve_discrete_are(A, B, Q, R)
    K = np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)

    def policy(y: Any) -> Any:
        return np.clip(-K @ np.concatenate((y, env.unwrapped.queue)), -1.0, 1.0)

    return policy


outside.PLANTS[DELAYED] = outside.Outside(
    f"{HERE}:Delay-v0", HERE, lambda: J(gymnasium.make("Delay-v0"), regulator)
)


def logged(env: Any, seed: int) -> Any:
    rng, rows, m = np.random.default_rng(seed), [], env.action_space.shape[0]
    while len(rows) < ACTIONS:
        episode = 0 if not rows else rows[-1][0] + 1
        (y, _), over = env.reset(seed=1000 * seed + episode), False
        while not over and len(rows) < ACTIONS:
            u = rng.uniform(-1, 1, m)
            rows.append((episode, *y, *u))
            y, _, terminated, truncated, _ = env.step(u)
            over = terminated or truncated
    inputs = [f"u{i + 1}" for i in range(m)]
    outputs = [f"y{i}" for i in range(1, len(rows[0]) - m)]
    data = pd.DataFrame(rows, columns=pd.Index(["episode", *outputs, *inputs]))
    return qm.read_log(data, outputs=outputs, inputs=inputs, episode="episode")


def by_guide(name: str, seed: int) -> float:
    env = gymnasium.make("Delay-v0") if name == DELAYED else outside.controlgym(name.split()[-1])
    model = qm.identify(logged(env, seed), horizon=HORIZON)
    mpc = qm.LinearMPC(model, horizon=HORIZON, u_bounds=(-1.0, 1.0), **WEIGHTS[name])
    none = np.zeros(len(model.log.outputs))

    def make(env: Any) -> Any:
        controller = qm.Controller(mpc)
        return lambda y: controller.step(y, none)

    return J(env, make)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.guide", description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[6, 7])
    parser.add_argument("--write", action="store_true", help="write the table to the page")
    options = parser.parse_args()
    torch.set_num_threads(1)
    kept, lines = pd.read_csv(outside.RESULTS, index_col=["plant", "seed"]), []
    for name in WEIGHTS:
        own, starts, known = [], [], 0.0
        for seed in options.seeds:
            known_before = (name, seed) in kept.index
            row = kept.loc[(name, seed)] if known_before else outside.run(name, seed)
            own.append(by_guide(name, seed))
            starts.append(float(row["start"]))
            known = float(row["reference"])
            print(name, seed, *map(significant, (own[-1], starts[-1], known)), flush=True)
        plain = outside.controlgym_lqg(name.split()[-1], False) if name != DELAYED else known
        cells = (", ".join(map(significant, x)) for x in (own, [plain], starts, [known]))
        lines.append([name, *cells])
    publish(table(HEAD, lines), "guide", options.write, outside.PAGE)


if __name__ == "__main__":
    main()
