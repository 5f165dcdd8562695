"""The policy's gradient beside the solution and the value's gradient.

    python -m tests.benchmarks.policy

CPU time on one thread with DAQP, the median of rounds in which the three take turns; theta moves
in its last digits before each round. The bounded LQRs are those of Table 1 in
https://arxiv.org/abs/2505.01353: 128 initial states, N = 20, n_x = 8, n_u = 4.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from tests.benchmarks.problems import Size, make_mpc, nudge, transitions
from tests.benchmarks.table import significant
from torch_qpmpc import QPMPC
from torch_qpmpc.study.markdown import table

ROUNDS, WARM_UP, HORIZON = 30, 2, 20
TITLES = ["batch", "solution", "value's gradient", "policy's gradient"]


def bounded_lqr(u_max: float) -> tuple[QPMPC, Tensor]:
    n_x, n_u, random = 8, 4, np.random.RandomState(42)
    A, B = np.eye(n_x) + 0.2 * random.randn(n_x, n_x), random.randn(n_x, n_u)
    offset, states = random.randn(n_x), random.randn(128, n_x)
    mpc = QPMPC.of(
        n_x,
        n_u,
        HORIZON,
        A=A,
        B=B,
        offset=offset,
        gamma=1.0,
        structure="tied",
        hessian="block",
        stage_weight=np.eye(n_x + n_u),
        terminal_weight=np.eye(n_x),
        action_bounds=([-u_max] * n_u, [u_max] * n_u),
        learn=("H", "C", "b"),
        solver="daqp",
    )
    return mpc, torch.from_numpy(states)


def point_mass(horizon: int) -> tuple[QPMPC, Tensor]:
    return make_mpc(Size(horizon, 4, 2), dense=False), transitions(4, 2, 256).s


PROBLEMS: dict[str, tuple[QPMPC, Tensor]] = {
    "bounded LQRs, u_max = 1e4": bounded_lqr(1e4),
    "bounded LQRs, u_max = 1": bounded_lqr(1.0),
    "banded C, N = 10": point_mass(10),
    "banded C, N = 40": point_mass(40),
}


def gradient(mpc: QPMPC, function: Callable[[Tensor], Tensor], states: Tensor) -> None:
    mpc.zero_grad()
    function(states).sum().backward()


def measured(mpc: QPMPC, states: Tensor) -> list[float]:
    """Return the CPU seconds of a solution, a value's and a policy's gradient in theta.

    Each is the median of rounds in which the three take turns, after untimed rounds.
    """
    functions: list[Callable[[], object]] = [
        torch.no_grad()(lambda: mpc.policy(states)),
        lambda: gradient(mpc, mpc.value, states),
        lambda: gradient(mpc, mpc.policy, states),
    ]
    seconds = np.empty((ROUNDS + WARM_UP, len(functions)))
    for row in seconds:
        for k, run in enumerate(functions):
            nudge(mpc)
            began = time.process_time()
            run()
            row[k] = time.process_time() - began
    return np.median(seconds[WARM_UP:], axis=0).tolist()


def main() -> None:
    torch.set_num_threads(1)
    rows = []
    for name, (mpc, states) in PROBLEMS.items():
        times = [significant(1e3 * seconds) for seconds in measured(mpc, states)]
        rows.append([name, str(len(states)), *times])
    print(table(["", *TITLES], rows))


if __name__ == "__main__":
    main()
