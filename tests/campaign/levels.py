"""Plans on levels against enumeration, HiGHS and SCIP: ``python -m tests.campaign.levels``.

Values of random designs (1 to 3 inputs, 2 to 4 levels, minimum times, costs of starts) with N = 8
equal those of all plans. With N = 24 they equal HiGHS's optimum where costs are linear, and SCIP's
with one input and quadratic costs (``pip install pyscipopt``; without it these are left out). Then
come times for one input on and off, N = 24, in Python and C, beside raw DAQP and SCIP.
"""

import argparse
import importlib.util
import time
import warnings
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import daqp
import numpy as np
import scipy.optimize as optimize
import torch

import torch_qpmpc as qm
from tests.mpc.test_levels import drawn, enumerated
from torch_qpmpc.qp.pipeline.batch import Programs

#: The largest relative difference of two values.
SAME = 1e-6
#: The most seconds of HiGHS or SCIP for a design.
SECONDS = 30.0
N = 24


class Mixed(NamedTuple):
    """min x'Hx / 2 + cost'x + constant, lower <= D x <= upper, ends[0] <= x <= ends[1]."""

    H: np.ndarray
    cost: np.ndarray
    constant: float
    D: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    ends: np.ndarray
    integer: np.ndarray


def mixed(mpc: qm.QPMPC, s: torch.Tensor) -> Mixed:
    """Return V(s) as a mixed-integer program: x = [z; violations; levels; starts]."""
    levels = mpc.levels
    H, q, c, C, b, G, lb, ub, w = (x.detach().numpy() for x in mpc.quadratic_program().tensors())
    soft = np.flatnonzero(np.isfinite(w))
    (m, S), L = levels.rows.shape, levels.values.shape[1]
    counts = np.cumsum([0, len(q), len(soft), m * S * L, m * S])
    n, (_, to_soft, to_pick, to_start, _) = counts[-1], counts
    rows, unit = [], np.eye(n)
    z, off = unit[: len(q)], unit[to_soft:to_pick]
    pick = unit[to_pick:to_start].reshape(m, S, L, n)
    rows += [(row @ z, x, x) for row, x in zip(C, b, strict=True)]
    for e, i in enumerate(soft):
        rows += [(G[i] @ z - off[e], -np.inf, ub[i]), (G[i] @ z + off[e], lb[i], np.inf)]
    rows += [(G[i] @ z, lb[i], ub[i]) for i in np.flatnonzero(np.isinf(w))]
    for a, k in np.ndindex(m, S):
        rows.append((pick[a, k].sum(0), 1.0, 1.0))
        rows.append((G[levels.rows[a, k]] @ z - levels.values[a] @ pick[a, k], 0.0, 0.0))
        if not k:
            continue
        stops = pick[a, k, 0] - pick[a, k - 1, 0]
        rows.append((unit[to_start + a * S + k] + stops, 0.0, np.inf))
        for e in range(k + 1, min(k + levels.rules[a, 1], S)):
            rows.append((pick[a, e, 0] - stops, -np.inf, 1.0))
        for e in range(k + 1, min(k + levels.rules[a, 0], S)):
            rows.append((pick[a, e, 0] - stops, 0.0, np.inf))
    D, lower, upper = map(np.array, zip(*rows, strict=True))
    ends = np.array([np.zeros(n), np.full(n, np.inf)])
    ends[0, : len(q)] = -np.inf
    ends[:, : len(s)] = s.numpy()
    ends[1, to_pick:] = 1.0
    cost = np.concatenate((q, w[soft], np.zeros(m * S * L), levels.starts.ravel()))
    integer = np.zeros(n)
    integer[to_pick:to_start] = 1
    H = np.pad(H, (0, n - len(q)))
    return Mixed(H, cost, float(c), D, lower, upper, ends, integer)


def highs(one: Mixed) -> tuple[float, float]:
    """Return the cost of HiGHS's best plan and its lower bound; H must be zero but for s."""
    fixed = one.ends[0] == one.ends[1]
    assert not one.H[np.ix_(~fixed, ~fixed)].any()
    at = np.where(fixed, one.ends[0], 0.0)
    rows: Any = one.D, one.lower, one.upper
    options = {"mip_rel_gap": 1e-9, "time_limit": SECONDS}
    ends: Any = one.ends
    best = optimize.milp(
        one.cost + one.H @ at,
        integrality=one.integer,
        bounds=optimize.Bounds(*ends),
        constraints=optimize.LinearConstraint(*rows),
        options=options,
    )
    rest = one.constant - at @ one.H @ at / 2
    return best.fun + rest, best.mip_dual_bound + rest


def scip(one: Mixed) -> tuple[float, float]:
    from pyscipopt import Model, quicksum  # pyright: ignore[reportMissingImports]

    model = Model()
    model.hideOutput()
    for name, size in (("limits/time", SECONDS), ("limits/gap", 1e-8), ("numerics/feastol", 1e-9)):
        model.setParam(name, size)
    x: list[Any] = [
        model.addVar(
            vtype="BC"[int(not whole)],
            lb=low if np.isfinite(low) else None,
            ub=high if np.isfinite(high) else None,
        )
        for low, high, whole in zip(*one.ends, one.integer, strict=True)
    ]
    for row, low, high in zip(one.D, one.lower, one.upper, strict=True):
        y = quicksum(v * x[j] for j, v in enumerate(row) if v)
        if low == high:
            model.addCons(y == low)
            continue
        if np.isfinite(low):
            model.addCons(y >= low)
        if np.isfinite(high):
            model.addCons(y <= high)
    total = model.addVar(lb=None)
    squares = quicksum(
        0.5 * one.H[i, j] * x[i] * x[j] for i, j in zip(*one.H.nonzero(), strict=True)
    )
    linear = quicksum(v * x[j] for j, v in enumerate(one.cost) if v)
    model.addCons(total >= squares + linear + one.constant)
    model.setObjective(total)
    model.optimize()
    return model.getObjVal(), model.getDualbound()


def priced(seed: int) -> tuple[qm.QPMPC, torch.Tensor]:
    """Return a random house with prices, a comfort band and one or two heaters, and a state."""
    rng = np.random.default_rng(seed)
    m, rules = int(rng.integers(1, 3)), ("min_on", "min_off")
    stage, n = 2 + m, (2 + m) * N + 2
    q = torch.zeros(n, dtype=torch.float64)
    for a in range(m):
        q[2 + a :: stage] = torch.from_numpy(rng.uniform(0.05, 0.4, N)) * (1 + 0.1 * a)
    mpc = qm.QPMPC.from_model(
        [[rng.uniform(0.7, 0.9), 0.1], [0.02, 0.97]],
        np.vstack((rng.uniform(0.02, 0.05, m), rng.uniform(0.03, 0.07, m))),
        N,
        q=q,
        gamma=1.0,
        stage_weight=np.zeros(stage),
        terminal_weight=np.zeros(2),
        action_levels=[np.cumsum(rng.uniform(1, 4, rng.integers(2, 4))) for _ in range(m)],
        state_bounds=([1.0, -9.0], [1.5, 9.0]),
        state_slack=3.0,
        start_cost=rng.choice([0.0, 0.2], m).tolist(),
        solver="daqp",
        **{name: rng.integers(1, 5, m).tolist() for name in rules},
    )
    return mpc, torch.from_numpy(rng.uniform(0.9, 1.5, 2))


def compared(
    name: str, make: Callable[[int], Any], solve: Callable[[Mixed], Any], count: int
) -> list[str]:
    """Compare values with another solver's, print how many are equal, and return what is wrong."""
    outcomes, wrong = dict.fromkeys(("equal", "NODE_LIMIT", f"{name} ends early"), 0), []
    for seed in range(count):
        mpc, s = make(seed)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)
            solution = mpc.solve(s)
        value, (best, bound) = solution.value.item(), solve(mixed(mpc, s))
        room, capped = SAME * max(abs(best), 1e-3), solution.status == qm.Status.NODE_LIMIT
        outcome = "NODE_LIMIT" if capped else "equal" if abs(value - best) <= room else None
        if value < bound - room or (not capped and value > best + room):
            wrong.append(f"{name}, seed {seed}: {value}, not {best}, at least {bound}")
        else:
            outcomes[outcome or f"{name} ends early"] += 1
    print(f"{count} designs with N = {N}: {outcomes}, {len(wrong)} wrong", flush=True)
    return wrong


def by_daqp(*parts: np.ndarray) -> None:
    model = daqp.Model()
    model.setup(*parts)
    model.solve()


def single(seed: int) -> tuple[qm.QPMPC, torch.Tensor]:
    """Return the next random design with one input, and a state."""
    at = 1000 * seed
    while (drawing := drawn(at, N))[0].n_u > 1:
        at += 1
    return drawing


def times(designs: int, states: int, by_scip: int) -> None:
    seconds: dict[str, list[float]] = {}
    nodes = []

    def timed(name: str, call: Callable[[], Any]) -> None:
        began = time.process_time()
        call()
        seconds.setdefault(name, []).append(time.process_time() - began)

    for seed in range(designs):
        rng = np.random.default_rng(seed)
        A, B = np.array([[rng.uniform(0.8, 0.98), 0.1], [0.0, 0.8]]), np.array([[0.05], [0.2]])
        weights = {"stage_weight": [1.0, 0.1, 0.05], "action_levels": [(0.0, 1.0)]}
        mpc = qm.QPMPC.from_model(A, B, N, **weights, solver="daqp", on_failure="mask")
        policy, qp = qm.CompiledPolicy(mpc), mpc.quadratic_program()
        plan = partial(mpc.levels.plan, mpc.at_rest(), runs=np.zeros(1, np.int64), hint=None)
        for k, p in enumerate(rng.normal(size=(states, 2)) - 1):
            s = torch.from_numpy(p)
            if not k:
                plan(fixed=p[None])
            timed("Python, certified", partial(plan, fixed=p[None]))
            policy.reset()
            timed("C, certified", partial(policy, s[None]))
            nodes.append(int(mpc.solve(s).iterations))
            qps = Programs.of(*qp.tensors(), s, n_kept=3)[0].reduced_qps()
            sense = np.full(qps.u.shape[1], 16, np.int32)
            parts = [x[0].copy() for x in (qps.H, qps.g, qps.G, qps.u, qps.l)]
            timed("raw DAQP, with its setup", partial(by_daqp, *parts, sense))
            if seed * states + k < by_scip:
                timed(f"SCIP, of {by_scip}", partial(scip, mixed(mpc, s)))
    for name, x in seconds.items():
        x = 1e3 * np.array(x)
        print(f"{name}: median {np.median(x):.3g} ms, largest {x.max():.3g} ms")
    print(f"nodes: median {np.median(nodes):.0f}, largest {max(nodes)}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=500, help="designs that are enumerated")
    parser.add_argument("--long", type=int, default=100, help="designs with N = 24, of each cost")
    parser.add_argument(
        "--times", type=int, default=10, help="designs of which 100 plans are timed"
    )
    arguments, wrong = parser.parse_args(), []
    for seed in range(1000, 1000 + arguments.count):
        mpc, s = drawn(seed)
        value, (best, _) = mpc.value(s).item(), enumerated(mpc, s)
        if abs(value - best) > SAME * max(abs(best), 1e-3):
            wrong.append(f"seed {seed}: {value}, enumerated {best}")
    print(f"{arguments.count} designs enumerated, {len(wrong)} wrong", flush=True)
    has_scip = importlib.util.find_spec("pyscipopt") is not None
    wrong += compared("HiGHS", priced, highs, arguments.long)
    if has_scip:
        wrong += compared("SCIP", single, scip, arguments.long)
    print(*wrong, sep="\n")
    if arguments.times:
        times(arguments.times, 100, 20 * has_scip)
    raise SystemExit(bool(wrong))


if __name__ == "__main__":
    main()
