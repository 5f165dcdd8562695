"""Plans on levels against enumeration: ``python -m tests.campaign.levels``.

Values of random designs (1 to 3 inputs, 2 to 4 levels, minimum times, start costs) with N = 8 equal
those of all plans. ``--times`` prints the times of searches with one input on and off, N = 24.
"""

from __future__ import annotations

import argparse
import time
import warnings

import numpy as np
import torch

import torch_qpmpc as qm
from tests.mpc.test_levels import drawn, enumerated
from torch_qpmpc.mpc.levels import Searches

#: The largest relative difference of two values.
SAME = 1e-6


def times(count: int) -> None:
    """Print the times of one on/off input, N = 24."""
    seconds, nodes = [], []
    for seed in range(count):
        rng = np.random.default_rng(seed)
        A, B = np.array([[rng.uniform(0.8, 0.98), 0.1], [0.0, 0.8]]), np.array([[0.05], [0.2]])
        mpc = qm.QPMPC.from_model(
            A, B, 24, stage_weight=[1.0, 0.1, 0.05], action_levels=[(0.0, 1.0)], solver="daqp"
        )
        s = torch.from_numpy(rng.normal(size=2) - 1)
        levels, qp = mpc.levels, mpc.quadratic_program()
        assert levels is not None
        with torch.no_grad(), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            searches, runs = Searches(mpc), np.zeros(1, np.int64)
            searches.solve(s.numpy()[None], runs)
            began = time.process_time()
            searches.solve(s.numpy()[None], runs)
            seconds.append(time.process_time() - began)
            nodes.append(int(levels.solve(qp, s, 3, "daqp", "mask").iterations))
    x = 1e3 * np.array(seconds)
    print(f"on levels, certified: median {np.median(x):.2f} ms, largest {x.max():.2f} ms")
    print(f"nodes: median {np.median(nodes):.0f}, largest {max(nodes)}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=500, help="designs that are enumerated")
    parser.add_argument("--times", type=int, default=0, help="searches that are timed")
    arguments, wrong = parser.parse_args(), []
    for seed in range(1000, 1000 + arguments.count):
        mpc, s = drawn(seed)
        value, (best, _) = mpc.value(s).item(), enumerated(mpc, s)
        if abs(value - best) > SAME * max(abs(best), 1e-3):
            wrong.append(f"seed {seed}: {value}, enumerated {best}")
    print(f"{arguments.count} designs enumerated, {len(wrong)} wrong", *wrong, sep="\n")
    if arguments.times:
        times(arguments.times)
    raise SystemExit(bool(wrong))


if __name__ == "__main__":
    main()
