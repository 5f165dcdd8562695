"""The exported C: solutions, codes, limits, and what compilers say."""

import subprocess

import numpy as np
import pytest
import torch

from tests.exported import (
    DRIVER,
    SCHEMES,
    STRICT,
    compilers,
    draw_known,
    load,
    random_qp,
    rates,
    tied,
)
from tests.problems import drawn_mpc
from torch_qpmpc import QPMPC, Status, export_c
from torch_qpmpc.export.comparison import actions, reference
from torch_qpmpc.export.library import compiler

pytestmark = pytest.mark.skipif(compiler() is None, reason="no C compiler")

SOLVED, LIMIT, INFEASIBLE, INVALID = range(4)
#: Random QPs: 7 has infeasible p, 35 and 350 have equations of p, 13 and 21 many dependent rows.
SEEDS = (2, 7, 13, 21, 35, 350)
COMPILERS = compilers()


def check(mpc, count=200, seed=0, **settings):
    """Compare cold steps and one controller's steps with exact solutions."""
    library, tables = load(mpc, **settings)
    p = draw_known(mpc, count, seed)
    cold = library.steps(library.states(count), p, tables.n_u)
    state = library.states(1)
    warm = [library.steps(state, p[i : i + 1], tables.n_u) for i in range(count)]
    known = reference(mpc, p, "torch")
    codes = np.select([known.status == Status.SOLVED, known.status == 1], [SOLVED, INFEASIBLE], -1)
    np.testing.assert_array_equal(cold.codes, codes)
    np.testing.assert_array_equal([step.codes[0] for step in warm], codes)
    solved = codes == SOLVED
    scale = 1 + np.abs(known.value[solved])
    assert np.isfinite(cold.u).all()
    for u in (cold.u, np.concatenate([step.u for step in warm])):
        np.testing.assert_allclose(u[solved], actions(mpc, known)[solved], rtol=1e-7, atol=1e-7)
    assert (np.abs(cold.value - known.value)[solved] <= 1e-8 * scale).all()
    assert (cold.gap[solved] <= 1e-8 * scale).all()
    return cold, codes


@pytest.mark.parametrize("name", SCHEMES)
def test_a_scheme_agrees_with_an_exact_solver(name):
    check(SCHEMES[name]())


@pytest.mark.parametrize("seed", SEEDS)
def test_rows_of_every_kind_agree_with_an_exact_solver(seed):
    check(random_qp(seed), 150)


def test_hard_rows_that_no_plan_satisfies_are_infeasible():
    cold, codes = check(tied(4, state_slack=torch.inf))
    assert {SOLVED, INFEASIBLE} == {*codes}
    assert (cold.violation[codes == INFEASIBLE] > 1e-6).all()
    assert (np.abs(cold.u) <= 1).all()


def test_a_soft_row_at_its_bound_is_certified_whatever_its_price():
    """A price times the rounding of a row is large beside the value."""
    D, most = [[0.0, 0.0, 1.0], [1.0, 0.3, 0.2]], torch.tensor([0.3, 0.7])
    options = {"stage_weight": [1.0, 1.0, 0.1], "constraints": (D, -most, most)}
    A, B = [[0.9, 0.2], [0.0, 0.8]], [[0.1], [1.0]]
    mpc = QPMPC.from_model(A, B, 4, constraint_slack=1e8, **options)
    library, _ = load(mpc)
    p = np.random.default_rng(0).normal(size=(300, 2))
    steps, exact = library.steps(library.states(300), p, 1), reference(mpc, p, "torch")
    assert (steps.codes == SOLVED).all()
    np.testing.assert_allclose(steps.u, actions(mpc, exact), rtol=0, atol=1e-6)
    np.testing.assert_allclose(steps.value, exact.value, rtol=1e-6)


def test_a_known_hard_row_decides_feasibility_and_a_soft_one_is_a_cost():
    def scheme(slack: float) -> QPMPC:
        bounds = {"state_bounds": ([-1.0], [1.0]), "state_slack": slack}
        weight = [1.0, 1.0]
        return QPMPC.from_model([[0.1]], [[1.0]], 1, stage_weight=weight, **bounds)

    p = np.array([[0.5], [1.0], [1.5]])
    for slack, codes in ((torch.inf, [0, 0, 2]), (3.0, [0, 0, 0])):
        library, _ = load(mpc := scheme(slack))
        steps = library.steps(library.states(3), p, 1)
        assert [*steps.codes] == codes
        solved = steps.codes == SOLVED
        value = mpc.value(torch.as_tensor(p[solved])).detach().numpy()
        np.testing.assert_allclose(steps.value[solved], value, rtol=1e-9)
    assert steps.violation.max() == 0


@pytest.mark.parametrize("length", [1e-6, 1.0, 1e6])
def test_a_row_of_p_alone_is_judged_by_its_own_terms(length):
    """As the QP layer judges it: see tests/qp/pipeline/test_certificate.py."""
    G = np.array([[length, 0.0]])
    bounds = {"constraints": (G, [-torch.inf], [0.5 * length]), "constraint_slack": torch.inf}
    mpc = QPMPC.from_model(
        [[0.1]], [[1.0]], 1, stage_weight=[1.0, 1.0], on_failure="mask", **bounds
    )
    p = 0.5 * (1 + np.array([[3e-8], [3e-5]]))
    library, _ = load(mpc)
    assert [*library.steps(library.states(2), p, 1).codes] == [SOLVED, INFEASIBLE]
    assert mpc.solve(torch.as_tensor(p)).solved.tolist() == [True, False]


@pytest.mark.parametrize("levels", [{}, {"action_levels": [(-1.0, 0.2, 1.0)]}])
def test_a_step_from_far_away_leaves_no_trace(levels):
    """Its multipliers have more rounding than those of later steps are large."""
    mpc = tied(4, constraint_slack=torch.inf, **levels)
    library, _ = load(mpc)
    p, count = draw_known(mpc, 20), 20
    state, fresh = library.states(1), library.steps(library.states(count), p, 1)
    assert {SOLVED, INFEASIBLE} == {*fresh.codes}
    for i in range(count):
        library.steps(state, 1e20 * p[i : i + 1], 1)
        step, solved = library.steps(state, p[i : i + 1], 1), fresh.codes[i] == SOLVED
        assert step.codes == fresh.codes[i]
        np.testing.assert_allclose(step.u[0], fresh.u[i] if solved else step.u[0], atol=1e-9)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e308])
def test_an_invalid_p_holds_the_last_action(bad):
    mpc = rates()
    library, _ = load(mpc)
    state = library.states(1)
    p = np.zeros((1, mpc.n_p))
    assert [*library.steps(state, p + bad, 1).u[0]] == [0.0]
    p[0, -1] = 0.3
    before = library.steps(state, p, 1)
    p[0, 1] = bad
    held = library.steps(state, p, 1)
    assert held.codes == INVALID
    np.testing.assert_array_equal(held.u, before.u)
    p[0, 1] = 0.0
    after = library.steps(state, p, 1)
    assert after.codes == SOLVED
    np.testing.assert_allclose(after.u, before.u, atol=1e-12)


def test_the_limit_of_iterations_is_reported_and_the_next_step_continues(tmp_path):
    mpc = SCHEMES["point mass"]()
    library, _ = load(mpc, max_iterations=3)
    p = np.array([[2.1, -2.0, 4.0, -5.0]])
    state, codes = library.states(1), []
    for _ in range(60):
        steps = library.steps(state, p, 2)
        codes.append(int(steps.codes[0]))
        assert steps.iterations[0] <= 5
        assert (np.abs(steps.u) <= 1).all()
        if codes[-1] == SOLVED:
            break
    assert codes[0] == LIMIT
    assert codes[-1] == SOLVED
    np.testing.assert_allclose(steps.u, actions(mpc, reference(mpc, p, "torch")), atol=1e-9)
    export_c(mpc, tmp_path, max_iterations=3)  # its self-test leaves out states beyond the limit


def test_a_qp_without_rows_has_a_linear_policy():
    mpc = drawn_mpc(2, 1, 3, stage_weight=[1.0, 1.0, 0.1])
    library, tables = load(mpc, flags=("-O2", *STRICT))
    assert len(tables.Q) == 0
    p = draw_known(mpc, 50)
    steps = library.steps(library.states(50), p, 1)
    assert not steps.codes.any()
    np.testing.assert_allclose(steps.u, actions(mpc, reference(mpc, p, "torch")), atol=1e-9)


def built(command, folder, *flags):
    """Compile the driver and the policy, and run it on 40 states: its lines as numbers."""
    program = folder / "driver"
    files = [str(DRIVER), str(folder / "policy.c"), f"-I{folder}"]
    subprocess.run(
        [*command, *flags, *files, "-o", str(program)], check=True, capture_output=True, text=True
    )
    ended = subprocess.run(
        [str(program), str(folder / "p.bin")], capture_output=True, text=True, check=False
    )
    assert ended.returncode == 0, ended.stderr
    return np.array([[float(x) for x in line.split()] for line in ended.stdout.splitlines()])


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """A scheme with infeasible states, exported with its self-test, and 40 states of it."""
    folder, mpc = tmp_path_factory.mktemp("c"), tied(4, state_slack=torch.inf)
    export_c(mpc, folder)
    p = draw_known(mpc, 40)
    p[3, 0] = np.nan
    (folder / "p.bin").write_bytes(p.tobytes())
    return folder, built(["cc", "-std=c99"], folder, "-O0", *STRICT)


@pytest.mark.parametrize("name", COMPILERS)
@pytest.mark.parametrize(
    "level", ["-O2", *(pytest.param(f"-O{i}", marks=pytest.mark.slow) for i in (0, 1, 3))]
)
def test_compilers_agree_without_a_warning(name, level, exported):
    folder, expected = exported
    assert {*expected[:, 0]} == {SOLVED, INFEASIBLE, INVALID}
    found = built(COMPILERS[name], folder, level, *STRICT)
    solved = expected[:, 0] == SOLVED
    np.testing.assert_array_equal(found[:, 0], expected[:, 0])
    np.testing.assert_allclose(found[solved], expected[solved], rtol=1e-9, atol=1e-9)


def test_sanitizers_find_nothing(tmp_path):
    levels = {"action_levels": [(-1.0, 0.2, 1.0)], "min_on": 2, "start_cost": 0.1}
    mpc = tied(4, **levels)
    export_c(mpc, tmp_path)
    (tmp_path / "p.bin").write_bytes(draw_known(mpc, 40).tobytes())
    flags = (*STRICT, "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
    try:
        found = built(["cc", "-std=c99"], tmp_path, *flags)
    except subprocess.CalledProcessError as error:
        pytest.skip(f"no sanitizers: {error.stderr[-100:]}")
    assert len(found) == 40
