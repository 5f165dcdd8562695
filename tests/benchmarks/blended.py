"""Pendulum-v1 by models of a log alone: ``python -m tests.benchmarks.blended``.

Each log has 2,000 random actions, as in the first command of the page of other plants; nothing is
learned after it. The cost is that fitted to the rewards, and J is the mean of 16 episodes.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from tests.benchmarks.outside import EVAL_SEED, configuration
from torch_qpmpc import QPMPC
from torch_qpmpc.envs.closed_loop import cost_text, gymnasium_loop
from torch_qpmpc.experiment.start import make_start
from torch_qpmpc.experiment.tasks import make_mpc, make_physics
from torch_qpmpc.mpc.blended import CENTRES, BlendedModel, identify_blended
from torch_qpmpc.study.markdown import table

HORIZON, STARTS = 20, 16


def along(mpc: QPMPC, model: BlendedModel) -> Callable[[Tensor], Tensor]:
    """Return the policy whose model is linearised along the plan of the step before."""
    plan: Tensor | None = None

    def policy(s: Tensor) -> Tensor:
        nonlocal plan
        C, b = model.constraints(s, mpc.horizon, plan)
        qp = replace(mpc.quadratic_program(), C=C, b=b, check_values=False)
        u = mpc.predicted(mpc.solve(s, qp=qp).z)[1]
        plan = torch.cat((u[:, 1:], u[:, -1:]), 1)
        return u[:, 0]

    return policy


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.blended")
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(11, 16)))
    text = "numbers of centres among which prediction decides"
    parser.add_argument("--centres", type=int, nargs="+", default=list(CENTRES), help=text)
    parser.add_argument("--horizon", type=int, default=HORIZON, help="N")
    options = parser.parse_args(arguments)
    rows = []
    for seed in options.seeds:
        cfg = configuration(
            "Pendulum", seed, f"task.horizon={options.horizon}", "task.start_episodes=0"
        )
        physics: Any = make_physics(cfg)
        with tempfile.TemporaryDirectory() as folder:
            start = make_start(cfg, physics, folder, written=False)
        assert start is not None
        mpc = make_mpc(cfg, physics, start)
        policies: dict[str, Callable[[Tensor], Tensor]] = {
            "zero action": lambda s: s.new_zeros(len(s), 1),
            "linear": mpc.policy,
        }
        model = identify_blended(start.log, options.horizon, options.centres)
        at_s = make_mpc(cfg, physics, start._replace(blended=model))
        policies |= {"at s": at_s.policy, "along the plan": along(mpc, model)}
        episodes = {"starts": STARTS, "seed": EVAL_SEED}
        J = [gymnasium_loop(policy, physics, **episodes).J for policy in policies.values()]
        rows.append([str(seed), *map(cost_text, J), str(len(model.centres))])
        print(table(["seed", *policies, "centres"], rows), flush=True)


if __name__ == "__main__":
    main()
