"""Inputs on levels: minimum times over what was applied, limits, files and errors."""

import numpy as np
import pytest

import torch_qpmpc as qm
from tests.control.controllers import load
from tests.refused import refused
from torch_qpmpc.export.library import compiler

LEVELS = (0.0, 4.0, 8.0)


def of(model=([[0.9]], [[0.1]]), **options) -> qm.LinearMPC:
    defaults = {
        "Q": {"T": 1.0},
        "u_levels": {"q": LEVELS},
        "min_on": {"q": 3},
        "min_off": {"q": 2},
        "start_cost": {"q": 0.5},
        "integer_horizon": 5,
        "inputs": ["q"],
        "outputs": ["T"],
    }
    return qm.LinearMPC(model, 8, **{**defaults, **options})


def runs_of(u: np.ndarray) -> list[tuple[bool, int]]:
    """Return the runs of on and off, without the first and the last one."""
    on, ends = u > 2, np.flatnonzero(np.diff(u > 2)) + 1
    parts = np.split(on, ends)
    return [(bool(part[0]), len(part)) for part in parts[1:-1]]


def closed_loop(controller: qm.Controller, steps: int, manual=()) -> np.ndarray:
    rng, T, applied = np.random.default_rng(0), 0.0, []
    for k in range(steps):
        y = [np.nan if rng.random() < 0.1 and k else T]
        r = [2.0 + 2.0 * (k // 20 % 2)]
        if k in manual:
            u = np.array([8.0])
            controller.observe(y, u)
        else:
            u = controller.step(y, r=r)
            assert controller.status in (0, 4)
        applied.append(u[0])
        T = 0.9 * T + 0.1 * u[0] + 0.05 * rng.normal()
    return np.array(applied)


@pytest.mark.parametrize("levels", [{}, {"u_levels": {"u1": (0.0, 1.0)}}])
@pytest.mark.parametrize("seed", [6, 20, 21])
def test_zones_need_no_weight_of_outputs(seed, levels):
    """The cost to go of the state is zero, of which rounding leaves 1e-30 of any sign."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 5))
    A = rng.normal(size=(n, n))
    A *= 0.95 / np.abs(np.linalg.eigvals(A)).max()
    weights = {"R": [1e-4, 0.01], "dR": [0.0, 0.05], "y_slack": 20.0}
    bounds = {"y_bounds": (-0.5, 0.5), "u_bounds": (0.0, 1.0)}
    mpc = qm.LinearMPC((A, rng.normal(size=(n, 2))), 8, **weights, **bounds, **levels)
    controller = qm.Controller(mpc)
    controller.reset(u=[0.0, 0.5])
    for _ in range(3):
        controller.step(0.7 * rng.normal(size=n))
        assert controller.status.name == "SOLVED"
    assert not any("terminal" in str(fault) for fault in controller.review().faults)


def test_minimum_times_count_what_was_applied_with_missing_outputs_and_manual_mode():
    u = closed_loop(qm.Controller(of()), 60)
    assert set(u) <= {*LEVELS}
    assert len(runs_of(u)) > 4
    assert all(length >= (3 if on else 2) for on, length in runs_of(u))
    controller = qm.Controller(of())
    controller.reset(y=[0.0], u=[0.0])
    controller.observe([0.0], [8.0])  # goes on, by hand
    u = [controller.step([9.0], r=[0.0])[0] for _ in range(4)]  # too warm from now on
    assert min(u[:2]) > 0  # on for three steps
    assert u[2] == u[3] == 0


def test_explain_names_the_next_switch():
    controller = qm.Controller(of(Q={"T": 0.1}))
    controller.reset(y=[0.0], u=[0.0])
    controller.step([0.0], r=[2.2])
    explanation = controller.explain()
    assert set(explanation.u[:5, 0].round(9)) <= {*LEVELS}
    u = explanation.u[:5, 0].round(9)
    k = np.flatnonzero(u != u[0])[0]
    assert f"q goes {'off' if u[k] == 0 else f'to {u[k]:.4g}'} in {k} step" in str(explanation)
    assert "e-1" not in str(explanation)
    assert not [limit for limit in explanation.limits if limit.signal == "q"]


def test_the_review_says_what_levels_hold_and_their_price():
    finding = qm.Controller(of()).review(r=[2.2])["levels"]
    assert finding.ok
    assert "T 1.952 to 2.79, mean 2.365; q 0 to 4, mean 2.5" in finding.text
    assert "without levels 0." in finding.text
    band = {"min_on": {"q": 12}, "y_bounds": {"T": (1.8, 2.6)}}
    finding = qm.Controller(of(**band)).review(r=[2.2])["levels"]
    assert not finding.ok
    assert "add a level, or widen y_bounds of T" in finding.remedy
    hard = qm.Controller(of(**band, y_slack={"T": np.inf})).review(r=[2.2])["levels"]
    assert "has no plan" in hard.text


def test_a_redesign_that_contradicts_a_minimum_time_is_refused_and_changes_nothing():
    controller = qm.Controller(of())
    controller.reset(y=[0.0], u=[0.0])
    controller.observe([0.0], [8.0])
    match = r"u_bounds: got levels 0 of q, expected one that is on for 2 more steps, by min_on"
    with pytest.raises(qm.QPError, match=match):
        controller.redesign(u_bounds={"q": (0.0, 3.0)})
    assert controller.step([0.0], r=[9.0])[0] == 8.0
    controller.step([0.0], r=[9.0])
    controller.redesign(u_bounds={"q": (0.0, 3.0)})
    assert controller.step([0.0], r=[9.0])[0] == 0.0


def test_a_file_goes_on_in_the_middle_of_a_minimum_time(tmp_path):
    controller = qm.Controller(of())
    closed_loop(controller, 13)
    controller.save(tmp_path / "c")
    twin = qm.Controller.load(tmp_path / "c")
    y = [[x] for x in (1.0, 3.0, 5.0, 0.0, 1.0)]
    assert [controller.step(x)[0] for x in y] == [twin.step(x)[0] for x in y]


def test_redesign_keeps_levels_within_new_bounds_and_refuses_bounds_without_any():
    controller = qm.Controller(of(min_on=1, min_off=1))
    controller.step([0.0], r=[6.0])
    controller.redesign(u_bounds={"q": (0.0, 5.0)})
    assert {controller.step([0.0], r=[6.0])[0] for _ in range(3)} == {4.0}
    with pytest.raises(qm.QPError, match=r"u_bounds: got \[1, 3\] of q, expected bounds with one"):
        controller.redesign(u_bounds={"q": (1.0, 3.0)})


def test_without_a_plan_the_input_stays_on_a_level():
    controller = qm.Controller(of())
    controller.reset(y=[1.0], u=[2.7])
    assert controller.step([1.0], r=[np.nan])[0] == 4.0
    assert controller.status.name == "INVALID"


@pytest.mark.skipif(compiler() is None, reason="no C compiler")
def test_a_limit_that_is_a_known_signal_holds_with_and_without_a_plan_alike_in_c(tmp_path):
    limit = {"known": ["most"], "E": [[0.0]], "u_bounds": {"q": (0.0, "most")}}
    controller = qm.Controller(of(**limit, min_on=1))
    twin = load(controller.export_c(tmp_path).files, controller)
    limits, expected = (9, 9, 7, 7, 3, 9, 9), (0, 8, 4, 4, 0, 0, 0)  # off twice by min_off
    for k, (most, wanted) in enumerate(zip(limits, expected, strict=True)):
        known, r = np.full((9, 1), most), [8.0 if k % 2 else np.nan]
        u = controller.step([1.0], r=r, known=known)
        got, code = twin.step([1.0], r, known)
        assert (got[0], code) == (u[0], controller.status)
        assert u[0] == wanted


def test_bounds_are_those_of_the_levels_within_them():
    """Stages that are not decided on levels, and manual inputs, went up to a bound between two."""
    controller = qm.Controller(of(u_bounds={"q": (1.0, 9.0)}, min_on=1, min_off=1))
    assert [side.tolist() for side in controller.mpc.design.u_bounds] == [[4.0], [8.0]]


@refused(
    ({"u_levels": {"p": LEVELS}}, "u_levels: got {'p': .*, expected a mapping from"),
    ({"u_levels": LEVELS}, "u_levels: got .* expected a mapping"),
    ({"u_levels": np.zeros(2)}, "u_levels: got .* expected a mapping"),
    ({"u_levels": None, "min_on": "two"}, "min_on: got 'two', expected action_levels or u_level"),
    ({"u_levels": {"q": 3}}, "u_levels: got .3., expected for each action up to 100 ascending"),
    ({"min_on": {"T": 2}}, "min_on: got 'T', expected names among q"),
    ({"u_bounds": {"q": (1.0, 2.0)}}, "u_bounds: got .1, 2. of q"),
    ({"u_levels": None}, "min_on: got {'q': 3}, expected action_levels or u_levels"),
    ({"du_bounds": {"q": (-4.0, 3.0)}}, "du_bounds: got .-4, 3. of q, expected moves of 4"),
    ({"blocks": [2, 6]}, "blocks: .* expected no blocks"),
)
def test_wrong_levels_are_errors(options):
    of(**options)


#: Designs whose C is compared: three levels, on and off beside an input without levels, and a cap.
DESIGNS = {
    "levels": dict,
    "a limit of moves": lambda: {"du_bounds": {"q": (-4.0, 4.0)}, "R": {"q": 0.01}},
    "few nodes": lambda: {"max_nodes": 6},
    "two inputs": lambda: {
        "model": ([[0.9, 0.05], [0.0, 0.8]], [[0.1, 0.0], [0.02, 0.1]]),
        "inputs": ["q", "v"],
        "u_levels": {"q": (0.0, 6.0)},
        "u_bounds": {"v": (-1.0, 1.0)},
        "outputs": ["T", "h"],
        "Q": {"T": 1.0, "h": 1.0},
    },
}


@pytest.mark.skipif(compiler() is None, reason="no C compiler")
@pytest.mark.parametrize("name", DESIGNS)
def test_c_equals_python_with_minimum_times_manual_mode_and_missing_outputs(name, tmp_path):
    controller = qm.Controller(of(**DESIGNS[name]()))
    report = controller.export_c(tmp_path, missing=True)
    twin, rng = load(report.files, controller), np.random.default_rng(0)
    A, B, C = (np.array(getattr(controller.mpc.design.plant, x)) for x in "ABC")
    x, codes, applied = np.zeros(len(A)), set(), []
    for k in range(130):
        y = C @ x + 0.02 * rng.normal(size=len(C))
        y[rng.random(len(C)) < 0.1 * (k > 0)] = np.nan
        r = np.append([2.0 + 2.0 * (k // 20 % 2)], np.zeros(len(C) - 1))
        r = np.nan * r if k == 70 else r
        if 50 <= k < 54 or k == 120:
            u = np.append([6.0 * (k < 53)], np.zeros(B.shape[1] - 1))
            controller.observe(y, u)
            twin.observe(y, u)
        else:
            u = controller.step(y, r)
            got, code = twin.step(y, r)
            np.testing.assert_allclose(got, u, atol=1e-9)
            assert code == controller.status
            codes.add(code)
            applied.append(u[0])
        x = A @ x + B @ u
    assert codes == {0, 3, 4, *[5] * (name == "few nodes")}
    assert {*applied} <= {*controller.mpc.design.levels["q"]}
    text = next(file for file in report.files if file.name == "policy.h").read_text()
    assert f"has {twin.state_bytes} bytes" in text
    plan = next(file for file in report.files if file.name == "policy_plan.h").read_text()
    assert f"at most {controller.mpc.design.switching['max_nodes'] + 1}." in plan


def test_a_simulation_goes_on_with_the_best_plan_that_the_search_found():
    controller = qm.Controller(of(max_nodes=6))
    assert {*controller.simulate(steps=20, r=[3.0]).u[:, 0]} <= {*LEVELS}
