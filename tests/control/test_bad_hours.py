"""Dropouts, absurd signals, manual mode and new bounds: what Python does, and C beside it."""

import itertools
import subprocess
from typing import Any

import numpy as np
import pytest
import torch

import torch_qpmpc as qm
from tests.campaign.soak import soak
from tests.control.controllers import exported, learned
from tests.exported import STRICT, compilers
from torch_qpmpc.control.law import Outcome

A, B, C = np.array([[0.9, 0.0], [0.2, 0.8]]), np.array([[0.25], [0.0]]), np.array([[0.0, 1.0]])
BAD = (np.nan, np.inf, 3.4e38, -1e300)


def tanks(**options: Any) -> qm.Controller:
    """Return the controller of two tanks, of which the second one's temperature is measured."""
    design = {"Q": 1.0, "dR": 0.1, "u_bounds": (0.0, 12.0), **options}
    mpc = qm.LinearMPC((A, B, C), 12, inputs=["q"], outputs=["T"], **design)
    return qm.Controller(mpc, noise=0.05, drift=0.02)


def two_by_two(**options: Any) -> qm.Controller:
    model = (np.diag([0.9, 0.8]) + 0.05, np.eye(2), np.array([[1.0, 0.2], [0.0, 1.0]]))
    return qm.Controller(qm.LinearMPC(model, 8, Q=1.0, dR=0.1, u_bounds=(-1.0, 1.0), **options))


def two_signals() -> qm.Controller:
    return qm.Controller(learned())


def driven() -> qm.Controller:
    options: Any = {"u_bounds": (-9.0, 9.0), "known": ["d"], "E": [[0.1]]}
    return qm.Controller(qm.LinearMPC(([[0.9]], [[0.25]]), 8, Q=1.0, dR=0.1, **options))


# Missing outputs


@pytest.mark.parametrize("bad", [None, *BAD])
def test_a_dropout_is_predicted_through_alike_in_c(bad):
    controller, twin = exported(tanks, y_bounds=(0.0, 30.0))
    controller.reset(y={"T": 10.0}, u={"q": 4.0})
    twin.reset([10.0], [4.0])
    x, statuses = np.array([10.0, 10.0]), []
    for k in range(80):
        y = bad if 12 <= k < 17 else x[1]
        r = [10.0] if k < 10 else [14.0]
        u, code = twin.step([np.nan if y is None else y], [r])
        assert abs(controller.step(y={"T": y}, r=r)["q"] - u[0]) < 1e-9
        assert controller.status == code
        assert np.abs(controller.w).max() < 1e-9, "the plant is the model: there is no load"
        x = A @ x + B @ u
        statuses.append(code)
    assert statuses == [0] * 12 + [4] * 5 + [0] * 63
    assert abs(x[1] - 14) < 1e-3


@pytest.mark.parametrize("bad", [None, *BAD])
def test_the_other_outputs_correct_the_estimates_while_one_is_missing(bad):
    controller, twin = exported(two_by_two, missing=True)
    observer = controller.observer
    # Of the first output alone, from the steady covariance.
    before, gain = np.zeros(4), observer.L @ observer.S[:, 0] / observer.S[0, 0]
    controller.reset([0.0, 0.0])
    twin.reset([0.0, 0.0])
    controller.step([0.1, bad], [0.3, 0.2])
    H, F = controller.observer.H, controller.observer.F
    corrected = before + gain * (0.1 - H[0] @ before)
    predicted = F @ corrected + controller.observer.G @ controller.u
    assert np.allclose(np.concatenate((controller.x, controller.w)), predicted)
    assert twin.step([0.1, np.nan if bad is None else bad], [[0.3, 0.2]])[1] == Outcome.MISSING
    for y in ([0.1, 0.2], [None, 0.3], [0.2, None], None, [0.3, 0.3]):
        u = controller.step(y)
        numbers = None if y is None else [np.nan if x is None else x for x in y]
        assert np.allclose(u, twin.step(numbers)[0], atol=1e-12)


@pytest.mark.parametrize("y", [None, [None, None], [0.5, None], [0.5, np.inf]])
def test_the_last_input_stays_until_all_outputs_have_been_seen(y):
    controller, twin = exported(two_by_two)
    controller.reset(u=[0.3, 0.4])
    twin.reset(u=[0.3, 0.4])
    numbers = None if y is None else [np.nan if x is None else x for x in y]
    for _ in range(3):
        assert controller.step(y, [0.5, 0.5]).tolist() == [0.3, 0.4]
        u, code = twin.step(numbers, [[0.5, 0.5]])
        assert (u.tolist(), code, controller.status) == ([0.3, 0.4], 3, Outcome.INVALID)
        assert not controller.x.any()
    u = controller.step([0.5, 0.6])
    assert controller.status == Outcome.SOLVED
    assert np.allclose(u, twin.step([0.5, 0.6])[0], atol=1e-12)
    controller.reset(y=[0.5, 0.6], u=[0.3, 0.4])  # says what the sensors do not
    controller.step(y)
    assert controller.status == Outcome.MISSING


@pytest.mark.parametrize("bad", BAD)
def test_absurd_set_points_and_forecasts_hold_the_input_and_the_estimates_go_on(bad):
    controller, twin = exported(two_signals)
    controller.reset(y=[0.5], u=[0.1], known=[0.3, 0.2])
    twin.reset([0.5], [0.1], [0.3, 0.2])
    known = np.tile([0.4, 0.2], (5, 1))
    spoiled = known.copy()
    spoiled[3, 0] = bad
    steps = ((known, 0.6, 0), (spoiled, 0.6, 3), (known, bad, 3), (known, None, 0))
    for ahead, r, expected in steps:
        last, estimate = controller.u, controller.x
        got, code = twin.step([0.52], None if r is None else [r], ahead)
        u = controller.step([0.52], None if r is None else [r], ahead)
        assert np.allclose(u, got, atol=1e-12)
        assert (code, controller.status) == (expected, expected)
        assert (u == last).all() == (expected == 3)
        assert (controller.x != estimate).any()
    assert controller.r[0] == 0.6


def test_estimates_are_copies():
    controller = tanks()
    controller.step([1.0], [1.0])
    for name in ("x", "w", "u", "r"):
        before = getattr(controller, name).copy()
        getattr(controller, name)[:] = 7.0
        assert np.array_equal(getattr(controller, name), before)


# Starts


@pytest.mark.parametrize("known", [[8.0], [5.0], [3.4e38], None])
def test_a_reset_takes_the_known_signals_at_rest(known):
    controller, twin = exported(driven)
    twin.reset([18.0], [5.2], known)
    plausible = known is not None and known[0] < 1e9
    controller.reset(y=[18.0] if plausible else None, u=[5.2], known=known if plausible else [5.0])
    for k in range(4):
        u = controller.step([18.0 + k], [18.0], [8.0])
        assert np.allclose(u, twin.step([18.0 + k], [18.0], np.full((9, 1), 8.0))[0], atol=1e-9)


@pytest.mark.parametrize(
    ("bounds", "y_bounds"),
    [((0.0, 12.0), (0.0, 30.0)), ((2.0, np.inf), None), ((-np.inf, np.inf), (0.0, 30.0))],
)
def test_ordinary_bounds_are_exported(tmp_path, bounds, y_bounds):
    controller = tanks(u_bounds=bounds, y_bounds=y_bounds)
    controller.reset(y={"T": 10.0}, u={"q": 4.0})
    assert (controller.export_c(tmp_path).difference or 0.0) < 1e-9


# Manual mode


def automatic(controller: qm.Controller, x: Any, twin: Any = None) -> float:
    """Return the squared error of a loop after the switch, with C's inputs beside it."""
    error = 0.0
    for _ in range(60):
        u = controller.step(x[1:], [14.0])
        assert twin is None or np.allclose(u, twin.step(x[1:], [[14.0]])[0], atol=1e-9)
        error += float(x[1] - 14) ** 2
        x = A @ x + B @ (u + LOAD)
    return error


#: What nobody knows is added to the input.
LOAD = -0.8


def test_the_switch_to_automatic_has_no_bump():
    (controller, twin), x = exported(tanks), np.array([10.0, 10.0])
    controller.reset(y=[10.0], u=[4.0])
    twin.reset([10.0], [4.0])
    inputs = np.where(np.arange(150) < 145, 4.0, 11.0)
    for u in inputs:
        controller.observe(x[1:], [u])
        assert twin.observe(x[1:], [u]) == controller.status == Outcome.SOLVED
        x = A @ x + B[:, 0] * (u + LOAD)
    assert controller.u[0] == inputs[-1]
    exact, restarted = tanks(), tanks()
    memory = controller._memory
    assert memory.e is not None
    exact._memory = memory._replace(e=np.append(x, LOAD))
    restarted.reset(y=x[1:], u=inputs[-1:])
    best = automatic(exact, x)
    assert automatic(controller, x, twin) < 1.1 * best
    assert automatic(restarted, x) > 1.3 * best


@pytest.mark.parametrize("u", [[None], [np.nan], [3.4e38], [-np.inf]])
def test_the_last_input_stands_for_one_that_is_not_known(u):
    controller, twin = exported(tanks, missing=True)
    controller.reset(y=[10.0], u=[4.0])
    twin.reset([10.0], [4.0])
    numbers = [np.nan if x is None else x for x in u]
    for y, applied in ((10.0, [5.0]), (10.2, u), (np.nan, u), (10.4, [14.0]), (10.6, u)):
        controller.observe([y], applied)
        code = twin.observe([y], numbers if applied is u else applied)
        assert controller.status == code == (4 if np.isnan(y) else 0)
    assert controller.u[0] == 12.0, "the one above its bound, clipped"
    assert np.allclose(controller.step([10.8], [14.0]), twin.step([10.8], [14.0])[0], atol=1e-12)


def test_nothing_winds_up_while_a_set_point_is_out_of_reach_or_the_operator_out_of_bounds():
    paths = []
    for waiting in (200, 400):
        controller, x, path = tanks(), np.array([10.0, 10.0]), []
        controller.reset(y=[10.0], u=[4.0])
        for k in range(waiting + 40):
            x = A @ x + B @ controller.step(x[1:], [50.0 if k < waiting else 14.0])
            path.append(x[1])
        paths.append(path[waiting:])
    assert np.allclose(*paths, atol=1e-6)
    for u in (20.0, -5.0, 20.0, 30.0):  # by hand, and seen as it was
        controller.observe(x[1:], [u])
        x = A @ x + B[:, 0] * u
    assert np.abs(controller.w).max() < 1e-6
    assert controller.u[0] == 12.0


# Steps without a plan


@pytest.mark.parametrize("on_failure", ["raise", "warn", "mask"])
def test_a_step_without_a_plan_holds_the_input_whatever_the_mpc_does_on_failure(on_failure):
    hard = {"y_bounds": (-1.0, 1.0), "y_slack": np.inf, "u_bounds": (-1.0, 1.0)}
    model = ([[0.9, 0.1], [0.0, 0.8]], [[0.0], [0.5]], [[1.0, 0.0]])
    mpc = qm.LinearMPC(model, 10, Q=1.0, dR=0.1, on_failure=on_failure, **hard)
    controller = qm.Controller(mpc)
    controller.reset(u=[0.4])
    plan = controller.step([0.5], [0.5]), controller.p
    for y in (3.0, 3.0):
        assert controller.step([y]) == plan[0]
        assert controller.status == Outcome.INFEASIBLE
    assert torch.equal(controller.p, plan[1])


# New bounds


def test_new_bounds_keep_the_estimates_and_clip_the_input():
    controller = tanks()
    controller.reset(y=[10.0], u=[4.0])
    controller.step([10.5], [14.0])
    before = np.concatenate((controller.x, controller.w))
    controller.redesign(u_bounds=(0.0, 3.0))
    assert np.array_equal(before, np.concatenate((controller.x, controller.w)))
    assert controller.u[0] == 3.0
    assert controller.step([10.8], [14.0])[0] <= 3.0
    with pytest.raises(TypeError, match="unexpected keyword argument 'ubounds'; did you mea"):
        controller.redesign(ubounds=(0.0, 1.0))


# C beside Python


def test_c_and_python_do_the_same_in_all_bad_hours():
    pairs = (
        exported(two_by_two, missing=True, y_bounds=(-1.0, 1.0)),
        exported(two_signals, missing=True),
    )
    for i, pair in enumerate(pairs):
        difference, counts = soak(*pair, 400, 3, i)
        assert difference < 1e-9
        assert min(counts[x] for x in ("dropouts", "absurd values", "MISSING", "INVALID")) > 0
        assert counts["manual steps"] == 150


DRIVER = """#include <stdio.h>
#include "policy.h"
int main(void)
{
    static policy_state state;
    const policy_real huge = (policy_real)1e30, inf = huge * huge * huge * huge * huge * huge
        * huge * huge * huge * huge * huge, nan = inf - inf;
    policy_real y[2] = {0, 0}, r[2] = {(policy_real)0.5, 0}, u[2] = {0, 0};
    int k, codes = 0;
    policy_reset(&state, 0, 0, 0);
    for (k = 0; k < 400; k++) {
        y[0] = k % 7 == 3 ? nan : (policy_real)((k % 13) - 6);
        y[1] = k % 11 == 5 ? inf : (policy_real)(k % 5);
        codes |= 1 << (k % 50 < 40 ? policy_step(&state, k % 17 ? y : 0, k % 19 ? r : 0, 0, u)
                                   : policy_observe(&state, y, k % 3 ? u : 0, 0));
        if (k % 100 == 99) policy_reset(&state, y, u, 0);
    }
    printf("%d\\n", codes);
    return policy_selftest();
}
"""


@pytest.mark.parametrize(
    ("name", "dtype"), [*zip(compilers(), itertools.cycle(("float64", "float32")), strict=False)]
)
def test_compilers_and_sanitizers_say_nothing_of_a_controller(tmp_path, name, dtype):
    own = two_by_two(y_bounds=(-1.0, 1.0), y_slack=9.0)
    own.export_c(tmp_path, dtype=dtype, missing=dtype == "float64")
    (tmp_path / "main.c").write_text(DRIVER)
    files = [str(path) for path in sorted(tmp_path.glob("*.c"))]
    flags = ("-O0", "-Werror", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
    command = [*compilers()[name], *STRICT, *flags, *files, "-o", str(tmp_path / "run")]
    built = subprocess.run(command, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr
    ended = subprocess.run([tmp_path / "run"], capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stderr) == (0, "")
    assert int(ended.stdout) & 0b11001 == 0b11001
