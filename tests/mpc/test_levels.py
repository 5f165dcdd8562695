"""Actions on levels: V, Q and the policy equal enumeration, and gradients finite differences."""

import functools
import itertools

import numpy as np
import pytest
import torch

import torch_qpmpc as qm
from tests.problems import central_difference, normal
from tests.refused import refused
from torch_qpmpc.export.library import compiler
from torch_qpmpc.proofs import Polytope, largest_difference

N = 8


def drawn(seed: int, horizon: int = N, most: int = 70_000) -> tuple[qm.QPMPC, torch.Tensor]:
    rng = np.random.default_rng(seed)
    while True:
        n_x, m = int(rng.integers(1, 4)), int(rng.integers(1, 4))
        counts = rng.integers(2, 5, m)
        rules = {name: rng.integers(1, 4, m).tolist() for name in ("min_on", "min_off")}
        sequences = [
            len(sequences_of(count, rules["min_off"][a], rules["min_on"][a], horizon))
            for a, count in enumerate(counts)
        ] if horizon == N else [1]  # fmt: skip
        if np.prod(sequences) <= most:
            break
    A = rng.uniform(0.7, 1.02) * np.eye(n_x) + 0.1 * rng.normal(size=(n_x, n_x))
    mpc = qm.QPMPC.from_model(
        A,
        rng.normal(size=(n_x, m)),
        horizon,
        stage_weight=np.concatenate((np.ones(n_x), np.full(m, rng.choice([0.0, 0.01, 0.3])))),
        state_bounds=([-1.0] * n_x, [rng.uniform(0.2, 1.0)] * n_x),
        state_slack=rng.choice([1.0, 30.0]),
        action_levels=[np.cumsum(rng.uniform(0.1, 1.0, n)) - rng.uniform(0, 1.5) for n in counts],
        start_cost=rng.choice([0.0, 0.2, 1.0], m).tolist(),
        solver="daqp",
        **rules,
    )
    return mpc, torch.from_numpy(2 * rng.normal(size=n_x))


@functools.cache
def sequences_of(count: int, off: int, on: int, horizon: int) -> np.ndarray:
    """Return all sequences of levels that keep minimum times, ``(n, horizon)``."""
    found = [()]
    for _ in range(horizon):
        found = [(*x, level) for x in found for level in range(count) if _may(x, level, off, on)]
    return np.array(found)


def _may(before: tuple[int, ...], level: int, off: int, on: int) -> bool:
    if not before or (level > 0) == (before[-1] > 0):
        return True
    run = next(
        (i for i, x in enumerate(reversed(before)) if (x > 0) != (before[-1] > 0)), len(before)
    )
    return run == len(before) or run >= (on if before[-1] > 0 else off)


def enumerated(
    mpc: qm.QPMPC, s: torch.Tensor, first: np.ndarray | None = None
) -> tuple[float, np.ndarray]:
    """Return the least cost of all plans, and the plan: all states follow from the actions."""
    bounds, levels = mpc.scheme.bounds, mpc.levels
    each = [
        sequences_of(len(bounds.action_levels[a]), bounds.min_off[a], bounds.min_on[a], mpc.horizon)
        for a in range(mpc.n_u)
    ]
    plans = np.stack([np.stack(x, -1) for x in itertools.product(*each)])  # (n, N, m)
    u = levels.values[np.arange(mpc.n_u), plans]
    if first is not None:
        keep = (np.abs(u[:, 0] - first) < 1e-9).all(-1)
        plans, u = plans[keep], u[keep]
    starts = ((plans[:, 1:] > 0) & (plans[:, :-1] == 0)) @ np.array(bounds.start_cost)
    cost = starts @ mpc.gamma ** np.arange(1, mpc.horizon)
    A, B = (x.detach().numpy() for x in (mpc.scheme.model.A, mpc.scheme.model.B))
    x, stages = np.repeat(s.numpy()[None], len(u), 0), []
    for k in range(mpc.horizon):
        stages += [x, u[:, k]]
        x = x @ A.T + u[:, k] @ B.T
    z = np.concatenate((*stages, x), -1)
    H, q, c, _, _, G, lb, ub, w = (x.detach().numpy() for x in mpc.quadratic_program().tensors())
    y = z @ G.T
    off = np.maximum(0, np.maximum(lb - y, y - ub))[:, np.isfinite(w)]
    cost = cost + 0.5 * ((z @ H) * z).sum(-1) + z @ q + c + off @ w[np.isfinite(w)]
    return cost.min(), u[cost.argmin()]


@pytest.mark.parametrize("size", [1e-5, 1e5])
def test_units_of_actions_decide_no_level(size):
    """H is nearly singular in these units: curvature for one action would drown the other's."""
    for seed in range(3):
        rng = np.random.default_rng(seed)
        B, s = rng.normal(size=(2, 2)), torch.from_numpy(2 * rng.normal(size=2))
        values = []
        for unit in (1.0, size):
            mpc = qm.QPMPC.from_model(
                0.9 * np.eye(2) + 0.1 * np.eye(2, k=1),
                B / [1.0, unit],
                N,
                stage_weight=np.array([1.0, 1.0, 0.1, 0.1 / unit**2]),
                action_bounds=([-np.inf, -2 * unit], [np.inf, unit]),
                action_levels=[(-1.0, 0.0, 1.0), None],
                start_cost=0.2,
            )
            values.append(mpc.value(s).item())
        assert values[1] == pytest.approx(values[0], rel=1e-7)


@pytest.mark.parametrize("seed", range(24))
def test_value_and_policy_equal_enumeration(seed):
    mpc, s = drawn(seed, most=5000)
    best, u = enumerated(mpc, s)
    solution = mpc.solve(s)
    assert solution.status == qm.Status.SOLVED
    assert solution.value.item() == pytest.approx(best, rel=1e-6, abs=1e-9)
    plan = mpc.predicted(solution.z)[1].detach().numpy()
    np.testing.assert_allclose(plan[0], u[0], atol=1e-6)


@pytest.mark.parametrize("seed", range(6))
def test_action_value_equals_enumeration_on_levels_and_is_infeasible_between_them(seed):
    mpc, s = drawn(seed, most=5000)
    rng = np.random.default_rng(seed)
    a = torch.tensor([rng.choice(x) for x in mpc.scheme.bounds.action_levels])
    best, _ = enumerated(mpc, s, a.numpy())
    assert mpc.action_value(s, a).item() == pytest.approx(best, rel=1e-6, abs=1e-9)
    assert mpc.action_value(s, mpc.policy(s)).item() == pytest.approx(mpc.value(s).item(), rel=1e-6)
    between = torch.from_numpy(mpc.levels.values[:, :2].mean(-1))
    with pytest.raises(qm.SolverError, match="INFEASIBLE"):
        mpc.action_value(s, between)


def of(**options) -> qm.QPMPC:
    """Return an integrator, whose best plan wanders between levels."""
    defaults = {"stage_weight": [1.0, 0.1], "action_levels": [(-1.0, 0.0, 2.0)], "solver": "daqp"}
    return qm.QPMPC.from_model([[1.0]], [[0.7]], 6, **{**defaults, **options})


def test_gradients_of_the_value_are_finite_differences():
    mpc = of(learn=("H", "q", "c", "C", "b"), state_bounds=([-1.5], [0.4]))
    s = torch.tensor([1.3], dtype=torch.float64, requires_grad=True)
    leaves = [s, *mpc.parameters()]
    gradients = torch.autograd.grad(mpc.value(s), leaves)
    for i, (leaf, gradient) in enumerate(zip(leaves, gradients, strict=True)):
        direction = normal(*leaf.shape, seed=i)
        expected = central_difference(lambda: mpc.value(s), leaf, direction, 1e-5)
        assert (gradient * direction).sum().item() == pytest.approx(expected.item(), rel=1e-5)


def test_actions_are_levels_to_the_last_bit_and_a_batch_may_be_empty():
    levels = {"action_levels": [(-0.3, 0.0, 0.7)], "solver": "daqp"}
    mpc = qm.QPMPC.from_model([[0.9]], [[0.5]], 4, stage_weight=[1.0, 0.1], **levels)
    s = torch.linspace(-3, 3, 101).double()[:, None]
    u = mpc.policy(s)
    assert {*u.flatten().tolist()} == {-0.3, 0.0, 0.7}
    assert mpc.value(s[:0]).shape == (0,)
    assert mpc.predict(s[:0]).shape == (0, 1)


def test_the_only_level_is_feasible_in_single_precision():
    levels = {"action_levels": [(0.1,)], "solver": "daqp"}
    mpc = qm.QPMPC.from_model([[0.9]], [[0.5]], 2, stage_weight=[1.0, 0.1], **levels)
    assert mpc.action_value(torch.ones(1), torch.tensor([0.1])).isfinite()
    with pytest.raises(qm.SolverError, match=r"INFEASIBLE: .* check s, a, b, lb, ub and levels"):
        mpc.action_value(torch.ones(1), torch.tensor([0.2]))
    one = "mpc: got one with levels, expected one without, for "
    with pytest.raises(qm.QPError, match=rf"{one}gradients of closed loops\. Without"):
        qm.improve(mpc, None)
    with pytest.raises(qm.QPError, match=f"{one}proofs"):
        largest_difference(mpc, mpc, Polytope.box([-1.0], [1.0]))


def test_relaxed_stages_and_continuous_actions_cost_less_and_keep_the_levels_of_the_others():
    full, short = of(), of(integer_horizon=2)
    s = torch.tensor([[1.3], [-2.6], [0.2]], dtype=torch.float64)
    u = short.predicted(short.solve(s).z)[1]
    on = torch.tensor([-1.0, 0.0, 2.0], dtype=torch.float64)
    assert (u[:, :2] - on).abs().min(-1).values.max() < 1e-9
    assert (short.value(s) <= full.value(s) + 1e-9).all()
    two = qm.QPMPC.from_model(
        [[1.0]], [[0.7, 0.2]], 6, stage_weight=[1.0, 0.1, 5.0], solver="daqp",
        action_levels=[(-1.0, 0.0, 2.0), None], action_bounds=([-9.0, -1.0], [9.0, 1.0]),
    )  # fmt: skip
    assert (two.value(s) <= full.value(s) + 1e-9).all()
    kept = of(action_bounds=([-0.5], [9.0]))  # the level -1 is not taken
    assert kept.predicted(kept.solve(s).z)[1].min() > -1e-9


@pytest.mark.parametrize("seed", [0, 1, 2, 15])
def test_prices_without_curvature_equal_enumeration(seed):
    rng, q = np.random.default_rng(seed), torch.zeros(3 * N + 2, dtype=torch.float64)
    q[2::3] = torch.from_numpy(rng.uniform(0.05, 0.4, N))
    mpc = qm.QPMPC.from_model(
        [[0.8, 0.1], [0.02, 0.97]], [[0.0], [0.06]], N, q=q, gamma=1.0, solver="daqp",
        stage_weight=np.zeros(3), terminal_weight=np.zeros(2), action_levels=[(0.0, 6.0)],
        state_bounds=([1.0, -9.0], [1.5, 9.0]), state_slack=3.0,
        min_on=[3], min_off=[2], start_cost=[0.2],
    )  # fmt: skip
    s = torch.from_numpy(rng.uniform(0.9, 1.5, 2))
    assert mpc.value(s).item() == pytest.approx(enumerated(mpc, s)[0], rel=1e-6)


def test_a_search_that_ends_early_says_so_with_its_gap():
    mpc = qm.QPMPC.from_model(
        [[0.9, 0.1], [0.0, 0.8]], [[0.05], [0.2]], 16, stage_weight=[1.0, 0.1, 0.02],
        action_levels=[(-1.0, 1.0)], solver="daqp",
    )  # fmt: skip
    s = torch.tensor([0.3, -1.0], dtype=torch.float64)
    best = mpc.solve(s)
    assert best.status == qm.Status.SOLVED
    capped = qm.QPMPC.of(**mpc.arguments | {"max_nodes": 24})
    with pytest.warns(RuntimeWarning, match="1 of 1 plans may not be the best: .* max_nodes"):
        solution = capped.solve(s)
    assert solution.status == qm.Status.NODE_LIMIT
    assert solution.value >= best.value * (1 - 1e-9)
    assert solution.value - best.value <= solution.value_error * solution.value.abs() + 1e-9
    assert solution.iterations == 24
    with pytest.raises(qm.SolverError, match=r"1 NOT_CONVERGED: .* more max_nodes"):
        qm.QPMPC.of(**mpc.arguments | {"max_nodes": 1}).solve(s)


def test_a_saved_qpmpc_keeps_its_levels_and_states_do_not_mix(tmp_path):
    numbers = {"min_on": np.array([2]), "start_cost": np.float64(0.3), "max_nodes": np.int64(99)}
    mpc = of(**numbers, integer_horizon=4)
    mpc.save(tmp_path / "mpc")
    twin = qm.QPMPC.load(tmp_path / "mpc")
    s = torch.tensor([[1.3], [-2.6]], dtype=torch.float64)
    assert torch.equal(twin.value(s), mpc.value(s))
    with pytest.raises(qm.QPError, match="state_dict with action_levels"):
        of().load_state_dict(mpc.state_dict())


@refused(
    ({"action_levels": [(1.0, 0.0)]}, "action_levels: got ..1.0, 0.0.., expected for each"),
    ({"action_levels": [(0.0, 1.0), None]}, "action_levels: got 2 entries, expected 1"),
    ({"action_levels": 3.0}, "action_levels: got 3.0"),
    ({"action_bounds": ([0.5], [1.5])}, r"action_bounds: got \[0.5, 1.5\] of action 0, expected"),
    ({"action_slack": 10.0}, "action_slack: got a price, expected hard bounds"),
    ({"blocks": [2, 4]}, "blocks: .* expected no blocks"),
    ({"integer_horizon": 9}, "integer_horizon: got 9, expected at most the horizon 6"),
    ({"min_on": 1.5}, "min_on: got 1.5"),
    ({"min_off": 0}, "min_off: got 0"),
    ({"start_cost": -1.0}, "start_cost: got -1.0, expected a number >= 0, or 1 of them"),
    ({"action_levels": None, "min_on": 2}, "min_on: got 2, expected action_levels or u_levels"),
    ({"max_nodes": 0}, "max_nodes: got 0"),
)
def test_wrong_levels_are_errors(options):
    of(**options)


@pytest.mark.skipif(compiler() is None, reason="no C compiler")
@pytest.mark.parametrize("seed", [2, 5])
def test_compiled_policies_equal_python(seed):
    mpc, _ = drawn(seed, most=5000)
    policy, rng = qm.CompiledPolicy(mpc), np.random.default_rng(seed)
    s = torch.from_numpy(2 * rng.normal(size=(10, mpc.n_p)))
    for _ in range(2):  # from nothing, and from the last plan
        torch.testing.assert_close(policy.value(s), mpc.value(s), rtol=1e-8, atol=1e-9)
        torch.testing.assert_close(policy(s), mpc.policy(s), rtol=0, atol=1e-8)
    capped = qm.CompiledPolicy(qm.QPMPC.of(**mpc.arguments | {"max_nodes": 20}))
    assert capped.value(s).isfinite().all()
    assert 5 in capped.last.codes


def test_what_depends_on_values_refuses_to_be_traced():
    with pytest.raises(qm.QPError, match=r"action_levels: got a traced call.*deactivate_vmap"):
        torch.func.grad(lambda s: of().value(s).sum())(torch.ones(1, dtype=torch.float64))
