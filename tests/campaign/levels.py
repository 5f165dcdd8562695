"""Plans on levels against enumeration and SCIP: ``python -m tests.campaign.levels``.

Values of random designs (1 to 3 inputs, 2 to 4 levels, minimum times, start costs) with N = 8 equal
those of all plans, and with ``--scip`` and N = 24 the mixed-integer optimum of SCIP (``pip install
pyscipopt``) to 1e-6. ``--times`` prints the times of searches with one input on and off, N = 24,
beside raw DAQP, which solves the same problems without minimum times and starts.
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
from torch_qpmpc.qp.pipeline.batch import Programs

#: The largest relative difference of two values.
SAME = 1e-6


def scip(mpc: qm.QPMPC, s: torch.Tensor, seconds: float = 60.0) -> tuple[float, float]:
    """Return the cost of SCIP's best plan and its lower bound."""
    from pyscipopt import Model, quicksum

    levels, bounds, model = mpc.levels, mpc.scheme.bounds, Model()
    assert levels is not None
    model.hideOutput()
    model.setParam("limits/time", seconds)
    model.setParam("limits/gap", 1e-8)
    model.setParam("numerics/feastol", 1e-9)
    H, q, c, C, b, G, lb, ub, w = (x.detach().numpy() for x in mpc.quadratic_program().tensors())
    z = [model.addVar(lb=None) for _ in q]
    for i, x in enumerate(s.tolist()):
        model.addCons(z[i] == x)
    for row, right in zip(C, b, strict=True):
        model.addCons(quicksum(v * z[j] for j, v in enumerate(row) if v) == right)
    terms = [float(c), quicksum(v * z[j] for j, v in enumerate(q) if v)]
    for i in np.flatnonzero(np.isfinite(w)):
        y, sigma = quicksum(v * z[j] for j, v in enumerate(G[i]) if v), model.addVar()
        terms.append(w[i] * sigma)
        if np.isfinite(ub[i]):
            model.addCons(y - sigma <= ub[i])
        if np.isfinite(lb[i]):
            model.addCons(y + sigma >= lb[i])
    m, S = levels.rows.shape
    for a in range(m):
        count, on = levels.counts[a], []
        for k in range(S):
            pick = [model.addVar(vtype="B") for _ in range(count)]
            model.addCons(quicksum(pick) == 1)
            value = quicksum(x * v for x, v in zip(pick, levels.values[a], strict=False))
            model.addCons(z[k * mpc.layout.n + mpc.n_x + a] == value)
            on.append(1 - pick[0])
        for k in range(1, S):
            up = model.addVar(ub=1)
            model.addCons(up >= on[k] - on[k - 1])
            terms.append(levels.starts[a, k] * up)
            for e in range(k + 1, min(k + bounds.min_on[a], S)):
                model.addCons(on[e] >= on[k] - on[k - 1])
            for e in range(k + 1, min(k + bounds.min_off[a], S)):
                model.addCons(1 - on[e] >= on[k - 1] - on[k])
    objective = model.addVar(lb=None)
    squares = quicksum(0.5 * H[i, j] * z[i] * z[j] for i, j in zip(*H.nonzero(), strict=True))
    model.addCons(objective >= quicksum(terms) + squares)
    model.setObjective(objective)
    model.optimize()
    return model.getObjVal(), model.getDualbound()


def times(count: int) -> None:
    """Print the times of one on/off input, N = 24, and those of raw DAQP."""
    import daqp

    own, raw, nodes = [], [], []
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
            searches, runs = Searches(levels, qp, 3, "daqp"), np.zeros(1, np.int64)
            searches.solve(s.numpy()[None], runs)
            began = time.process_time()
            searches.solve(s.numpy()[None], runs)
            own.append(time.process_time() - began)
            nodes.append(int(levels.solve(qp, s, 3, "daqp", "mask").iterations))
        programs, _ = Programs.of(*qp.tensors(), s, n_kept=3)
        qps, model = programs.reduced_qps(), daqp.Model()
        began = time.process_time()
        sense = np.full(qps.u.shape[1], 16, np.int32)
        model.setup(qps.H[0], qps.g[0].copy(), qps.G[0], qps.u[0].copy(), qps.l[0].copy(), sense)
        model.solve()
        raw.append(time.process_time() - began)
    for name, x in (("on levels, certified", own), ("raw DAQP, with its setup", raw)):
        x = 1e3 * np.array(x)
        print(f"{name}: median {np.median(x):.2f} ms, largest {x.max():.2f} ms")
    print(f"nodes: median {np.median(nodes):.0f}, largest {max(nodes)}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=500, help="designs that are enumerated")
    parser.add_argument("--scip", type=int, default=0, help="designs with N = 24 for SCIP")
    parser.add_argument("--times", type=int, default=0, help="searches that are timed")
    arguments, wrong = parser.parse_args(), []
    for seed in range(1000, 1000 + arguments.count):
        mpc, s = drawn(seed)
        value, (best, _) = mpc.value(s).item(), enumerated(mpc, s)
        if abs(value - best) > SAME * max(abs(best), 1e-3):
            wrong.append(f"seed {seed}: {value}, enumerated {best}")
    print(f"{arguments.count} designs enumerated, {len(wrong)} wrong", *wrong, sep="\n")
    outcomes = {"equal": 0, "NODE_LIMIT, and not below SCIP": 0, "SCIP ends early": 0}
    for seed in range(arguments.scip):
        mpc, s = drawn(seed, 24)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)
            solution = mpc.solve(s)
        value, (best, bound) = solution.value.item(), scip(mpc, s)
        room = SAME * max(abs(best), 1e-3)
        if value < bound - room or (solution.status == qm.Status.SOLVED and value > best + room):
            wrong.append(f"seed {seed}: {value}, SCIP {best}, at least {bound}")
        elif solution.status == qm.Status.NODE_LIMIT:
            outcomes["NODE_LIMIT, and not below SCIP"] += 1
        else:
            outcomes["equal" if abs(value - best) <= room else "SCIP ends early"] += 1
    if arguments.scip:
        print(f"{arguments.scip} designs with N = 24: {outcomes}", *wrong, sep="\n")
    if arguments.times:
        times(arguments.times)
    raise SystemExit(bool(wrong))


if __name__ == "__main__":
    main()
