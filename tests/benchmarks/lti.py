"""Gros and Zanon's linear system, compared with mpcrl: ``python -m tests.benchmarks.lti``.

Both learn a linear MPC scheme with a wrong model in one endless episode, on the same noise. The
schemes are the same but for the terminal cost, an undiscounted regulator's there and the discounted
one's here. Ours learns as `task=gros_zanon` does, after 25 steps or after each as mpcrl; and all
numbers by TD errors alone, as mpcrl does. The tables go into docs/results/mpcrl.md.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path
from statistics import median

import numpy as np
import torch

from tests.benchmarks import mpcrl_lti
from tests.benchmarks.mpcrl_lti import Stream
from tests.benchmarks.table import DOCS
from tests.runs import make_config
from torch_qpmpc import GaussNewton
from torch_qpmpc.envs import GrosZanonLTI
from torch_qpmpc.experiment.algorithms import make_errors, make_optimizer, make_scheduler
from torch_qpmpc.experiment.tasks import make_mpc
from torch_qpmpc.mpc.tightening import BackOff
from torch_qpmpc.study.markdown import replaced, table

PAGE = DOCS / "results" / "mpcrl.md"
SEEDS, STEPS, LAST = (69, 1, 2, 3), 5000, 500
#: Untimed steps of each contender at first, during which kernels are compiled.
WARMUP = 50
#: Settings that differ from the task's: updates after each step, TD errors alone.
SINGLE = ("steps_per_update=1",)
TD = ("constraint=mpc", "task.learn_cost=[q,c]")


def run(
    seed: int, steps: int = STEPS, overrides: Sequence[str] = (), *, learn: bool = True
) -> Stream:
    """Run one episode under the learning QP, or under the initial one."""
    cfg, physics = make_config("task=gros_zanon", "solver=daqp", *overrides), GrosZanonLTI()
    # Read once: OmegaConf's lookups would count as time of the loop.
    every, exploration = cfg.steps_per_update, cfg.exploration_std
    cfg.updates = steps // every
    mpc = make_mpc(cfg, physics)
    errors = make_errors(cfg, mpc)
    back_off = None if cfg.back_off is None else BackOff(mpc, cfg.back_off)
    optimizer = make_optimizer(cfg, mpc, errors=errors)
    assert isinstance(optimizer, GaussNewton)
    scheduler, gamma = make_scheduler(cfg, optimizer), cfg.task.gamma
    # mpcrl's agents draw the seed of each episode.
    rng = np.random.default_rng(int(np.random.default_rng(seed).integers(2**32)))
    draws = torch.Generator().manual_seed(seed)
    s, still = physics.starts(rng, 1), torch.zeros(1, 2)
    states, actions = s.new_zeros(steps + 1, 2), s.new_zeros(steps, 1)
    states[0] = s
    began = time.perf_counter()
    with torch.no_grad():
        qp = mpc.quadratic_program()
        for k in range(steps):
            noise = exploration * torch.randn(1, 1, generator=draws)
            a = physics.applied(mpc.solve(s, qp=qp).z[:, 2:3] + noise)
            s = physics.step(s, a, physics.noise(still, physics.draw(rng, 1)))
            actions[k], states[k + 1] = a, s
            if not learn or (k + 1) % every:
                continue
            batch = torch.arange(k + 1 - every, k + 1)
            if errors is not None:
                errors.add(states[batch], actions[batch], states[batch + 1])
            visited = states[batch], actions[batch]
            following = mpc.solve(states[batch + 1], qp=qp)
            optimizer.step(*visited, physics.cost(*visited) + gamma * following.value)
            scheduler.step()
            if back_off is not None and errors is not None:
                back_off.tighten(errors.covariance(mpc.quadratic_program()))
            qp = mpc.quadratic_program()
    seconds = time.perf_counter() - began
    costs = physics.cost(states[:-1], actions)
    return Stream(costs.numpy(), physics.violation(states[:-1]).numpy(), seconds)


CONTENDERS: dict[str, Callable[[int, int], Stream]] = {
    "mpcrl": mpcrl_lti.run,
    "adaptive MPC": run,
    "adaptive MPC, after each step": lambda seed, steps: run(seed, steps, SINGLE),
    "adaptive MPC, with q": lambda seed, steps: run(seed, steps, ("task.learn_cost=[q,c]",)),
    "TD errors alone": lambda seed, steps: run(seed, steps, TD),
    "TD errors alone, after each step": lambda seed, steps: run(seed, steps, (*TD, *SINGLE)),
    "without learning": lambda seed, steps: run(seed, steps, learn=False),
}


def tables(streams: dict[str, list[Stream]], seeds: list[int]) -> str:
    """Format each contender's streams, in the order of the seeds, as Markdown."""
    blocks = []
    for caption, of, digits in (
        ("total cost", lambda stream: stream.costs.sum(), 0),
        (f"cost a step, last {LAST}", lambda stream: stream.costs[-LAST:].mean(), 4),
        ("total violation", lambda stream: stream.violations.sum(), 2),
        ("ms a step", lambda stream: 1000 * stream.seconds / len(stream.costs), 2),
    ):
        lines = []
        for label, each in streams.items():
            numbers = [float(of(stream)) for stream in each]
            lines.append([label, *(f"{x:,.{digits}f}" for x in (*numbers, median(numbers)))])
        blocks.append(table([caption, *(f"seed {seed}" for seed in seeds), "median"], lines))
    return "\n\n".join(blocks)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m tests.benchmarks.lti", description="Write the comparison with mpcrl."
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=list(SEEDS))
    parser.add_argument("--steps", type=int, default=STEPS)
    parser.add_argument("--page", type=Path, default=PAGE, help="the file that gets the tables")
    options = parser.parse_args(arguments)
    page = options.page.read_text(encoding="utf-8")
    replaced(page, "", "mpcrl")  # fail before the runs, which take minutes
    torch.set_num_threads(1)
    for contender in CONTENDERS.values():
        contender(options.seeds[0], WARMUP)
    streams: dict[str, list[Stream]] = {label: [] for label in CONTENDERS}
    for seed in options.seeds:
        for label, contender in CONTENDERS.items():
            stream = contender(seed, options.steps)
            streams[label].append(stream)
            line = f"seed {seed}, {label}: {stream.costs.sum():.0f}, {stream.seconds:.0f} s"
            print(line, flush=True)
    versions = ", ".join(f"{name} {version(name)}" for name in ("mpcrl", "casadi", "daqp", "torch"))
    caption = f"{options.steps:,} steps, one thread, in one run with {versions}."
    text = replaced(page, f"{caption}\n\n{tables(streams, options.seeds)}", "mpcrl")
    options.page.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
